"""From trained surfels to a finished model."""

"""The representation (paper Sec. 4.1): surfels and texture, and beyond the paper exposures and detail limits."""

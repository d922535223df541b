"""Input and output: atomic writes, JSON, pictures, video."""

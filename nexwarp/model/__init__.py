"""The trained scene and its file formats."""

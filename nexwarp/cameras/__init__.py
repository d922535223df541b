"""Cameras of a path or of a file."""

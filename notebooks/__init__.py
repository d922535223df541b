"""Notebooks that show what nexwarp does; `python -m notebooks` executes them."""

"""The trained scene: its value and its files."""

"""Trained scenes in any browser: scene files, and the web page that draws them."""

"""What is learned: surfels, texture, exposures."""

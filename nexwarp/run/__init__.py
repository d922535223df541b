"""What is done with a run folder."""

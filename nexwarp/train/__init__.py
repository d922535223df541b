"""The training loop of paper Sec. 4.3."""

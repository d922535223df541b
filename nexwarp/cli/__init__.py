"""What a person types and sees."""

__version__ = "0.2.0"

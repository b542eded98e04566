"""Data collection and supervised training of the networks."""

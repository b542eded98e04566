"""Planners for static targets, made to meet moving ones."""

__version__ = "0.1.0"

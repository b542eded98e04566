"""Planners for a static goal."""

"""Trained scenes in the formats of other programs."""

"""Accuracy of poses, masks and results, against known ones."""

"""Preparing footage before training: poses, masks of what moves, low-light twins, brightening."""

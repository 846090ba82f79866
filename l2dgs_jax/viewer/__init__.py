"""Runs in the browser: pictures are rendered here and streamed; a latest wish replaces those before it."""

from l2dgs_jax.viewer.server import serve

__all__ = ["serve"]

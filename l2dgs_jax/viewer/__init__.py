"""Viewing runs in the browser: pictures are rendered here and streamed; only the latest request of a client counts."""

from l2dgs_jax.viewer.server import serve

__all__ = ["serve"]

"""Bytes -> GaussianSequence: the thin Python face of the native decoder."""

from .scene import Scene, open_scene
from .stream import Stream, open_stream

__all__ = ["Scene", "Stream", "open_scene", "open_stream"]

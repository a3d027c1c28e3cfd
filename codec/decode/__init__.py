"""Bytes -> GaussianSequence: the thin Python face of the native decoder."""

from .stream import Stream, open_stream

__all__ = ["Stream", "open_stream"]

"""Gaussian splats on disk: one file per format, and folders of them as sequences."""

from .files import read_splat, write_splat
from .sequence import SplatSequence, detect_input, open_sequence
from .sequence_writer import SequenceWriter, write_sequence

__all__ = [
    "SequenceWriter",
    "SplatSequence",
    "detect_input",
    "open_sequence",
    "read_splat",
    "write_sequence",
    "write_splat",
]

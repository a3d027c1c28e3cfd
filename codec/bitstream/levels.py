"""Levels of the stream (spec 5): the caps that a decoder may rely on; the native decoder enforces them."""

from __future__ import annotations

from dataclasses import dataclass

from .. import _native
from ..errors import LimitError


@dataclass(frozen=True)
class Level:
    """Caps of one level, each for one group.

    Attributes:
        level: number in the stream.
        gaussians, frames, nodes: counts.
        pairs: Gaussians times nodes.
        symbols: integers, as counted by spec 5.
        bytes: size of the payload.
    """

    level: int
    gaussians: int
    frames: int
    nodes: int
    pairs: int
    symbols: int
    bytes: int


LEVELS = tuple(Level(**caps) for caps in _native.levels())


def smallest_level(*, gaussians: int = 0, frames: int = 1, nodes: int = 0, symbols: int = 0, bytes: int = 0) -> int:
    """The lowest level whose caps cover the largest group of a stream.

    Raises:
        LimitError: no level covers it; the message names the cap.
    """
    need = {"gaussians": gaussians, "frames": frames, "nodes": nodes, "symbols": symbols, "bytes": bytes}
    for level in LEVELS:
        if all(value <= getattr(level, name) for name, value in need.items()):
            return level.level
    name, value = next((n, v) for n, v in need.items() if v > getattr(LEVELS[-1], n))
    top = LEVELS[-1]
    raise LimitError(f"a group of {value} {name} exceeds level {top.level}, which allows {getattr(top, name)}")

"""Bits per second -> a quality for each group: tries until a group fits what the groups before it have left over.

Nothing ahead is looked at, so a live encoder can do the same; what a group takes too much or too little, the next one
gets less or more. The logarithm of the size is nearly linear in quality, so that two or three tries are enough.
"""

from __future__ import annotations

import copy
import math

from ..model.gaussians import Group
from .coder import CodedGroup, GroupCoder

SLOPE = 0.036  # of log size against quality, on statue and on trained captures
TOLERANCE = 0.02  # of a group's size
TRIES = 6
LEAST = 0.25  # of the mean budget of a group, however much those before it took


class RateControl:
    """Codes groups so that the file has `bitrate` bits per second at `fps`."""

    def __init__(self, bitrate: float, fps: float, quality: float = 50.0):
        self._bytes_per_frame, self.quality = bitrate / 8 / fps, quality  # that of the last group

    def code(self, coder: GroupCoder, group: Group, frames: int, size: int) -> tuple[GroupCoder, CodedGroup]:
        """Codes `group` behind `frames` frames that took `size` bytes.

        Returns:
            `coder` as it is after this group, and the group.
        """
        budget = max(self._bytes_per_frame * (frames + len(group)) - size, LEAST * self._bytes_per_frame * len(group))
        quality, tried = self.quality, []  # of (how far off, quality, log of size over budget, coder, group)
        while len(tried) < TRIES:
            after = copy.copy(coder)
            coded = after.code(group, quality, frames)
            off = math.log(len(coded.payload) / budget)
            tried.append((abs(off), quality, off, after, coded))
            if abs(off) < TOLERANCE:
                break
            quality = min(max(self._next(tried), 0.0), 100.0)
            if any(quality == t[1] for t in tried):
                break
        _, self.quality, _, after, coded = min(tried, key=lambda t: t[0])
        return after, coded

    @staticmethod
    def _next(tried: list) -> float:
        """The secant through the last two tries, or the usual slope through the last one."""
        _, quality, off, *_ = tried[-1]
        slope = SLOPE
        if len(tried) > 1 and tried[-2][1] != quality:
            slope = min(max((off - tried[-2][2]) / (quality - tried[-2][1]), SLOPE / 4), SLOPE * 4)
        return quality - off / slope

"""Frames side by side in threads: numpy lets go of the interpreter while it computes."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")


def each_frame(make: Callable[[int], Result], frames: int) -> list[Result]:
    """`make(t)` of every frame, in order; the calls must not depend on each other."""
    with ThreadPoolExecutor(min(frames, os.cpu_count() or 1)) as pool:
        return list(pool.map(make, range(frames)))

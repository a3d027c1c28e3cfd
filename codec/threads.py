"""Parallel work in threads: numpy and the native kernels release the interpreter lock while they compute."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")


def each_frame(make: Callable[[int], Result], frames: int) -> list[Result]:
    """Results of `make(t)` for every frame, in order; the calls must not depend on each other."""
    with ThreadPoolExecutor(max(1, min(frames, os.cpu_count() or 1))) as pool:
        return list(pool.map(make, range(frames)))


def prefetched(items: Iterable[Result]) -> Iterator[Result]:
    """Yields `items`; the next item is computed while the caller uses the current one."""
    items, end = iter(items), object()
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(next, items, end)
        while (item := coming.result()) is not end:
            coming = pool.submit(next, items, end)
            yield item

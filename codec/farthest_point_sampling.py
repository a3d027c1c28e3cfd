"""Farthest point sampling: places the nodes of a point set. The trainer and the encoder share it."""

import numpy as np


def farthest_points(points: np.ndarray, count: int, sizes: np.ndarray | float = 1.0) -> np.ndarray:
    """Indices [count] of `points` [N, 3]: each is the farthest point from those chosen before it, with distances
    divided by its own `sizes` ([N], any unit). The first is the point nearest to the centre."""
    points = points - points.mean(0)
    square = (points**2).sum(1)
    chosen, distance = [], np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        chosen.append(int((distance / sizes**2).argmax() if chosen else square.argmin()))
        p = points[chosen[-1]]
        np.minimum(distance, square - 2 * (points @ p) + p @ p, out=distance)
    return np.array(chosen)

"""Where to put the nodes of a point set; the trainer and the encoder choose alike."""

import numpy as np


def farthest_points(points: np.ndarray, count: int, sizes: np.ndarray | float = 1.0) -> np.ndarray:
    """[count] indices of `points` [N, 3], each the farthest from those before it, in its own `sizes` ([N], any unit);
    starts nearest to the centre."""
    points = points - points.mean(0)
    square = (points**2).sum(1)
    chosen, distance = [], np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        chosen.append(int((distance / sizes**2).argmax() if chosen else square.argmin()))
        p = points[chosen[-1]]
        np.minimum(distance, square - 2 * (points @ p) + p @ p, out=distance)
    return np.array(chosen)

"""Two rate-distortion curves -> Bjontegaard delta rate (VCEG-M33), piecewise cubic (PCHIP) as in JCT-VC.

PCHIP does not overshoot between points, as one cubic through all of them does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import UsageError, require

POINTS_MIN = 4


def bd_rate(
    anchor: Sequence[tuple[float, float]],
    test: Sequence[tuple[float, float]],
    *,
    within: tuple[float, float] = (-np.inf, np.inf),
) -> float:
    """Mean difference of rate at equal PSNR.

    Args:
        anchor, test: (rate, PSNR) points, any unit of rate, in any order.
        within: a range of PSNR; the mean is over the part of it that both curves reach.

    Returns:
        Per cent; negative where `test` needs fewer bits than `anchor`.

    Raises:
        UsageError: a curve has fewer than 4 points, is not rising, or the curves share no range of PSNR.
    """
    curves = [_curve("anchor", anchor), _curve("test", test)]
    low, high = shared_psnr(anchor, test, within)
    if high <= low:
        spans = " and ".join(f"{c[0][0]:.2f} to {c[0][-1]:.2f} dB" for c in curves)
        raise UsageError(f"the curves share no range of PSNR ({spans}); measure points that overlap")
    pchip = require("scipy.interpolate", "BD-rate").PchipInterpolator
    areas = [float(pchip(quality, log_rate).integrate(low, high)) for quality, log_rate in curves]
    return float(np.expm1((areas[1] - areas[0]) / (high - low)) * 100)


def shared_psnr(
    anchor: Sequence[tuple[float, float]], test: Sequence[tuple[float, float]], within: tuple[float, float]
) -> tuple[float, float]:
    """Lowest and highest PSNR that two curves both reach, inside `within`."""
    spans = [within, *((min(q), max(q)) for q in ([p[1] for p in points] for points in (anchor, test)))]
    return max(s[0] for s in spans), min(s[1] for s in spans)


def rising(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The (rate, PSNR) points without those that another point beats at the same or a lower rate, in rising order, as
    `bd_rate` takes them."""
    best: list[tuple[float, float]] = []
    for rate, quality in sorted(points, key=lambda p: (p[0], -p[1])):
        if not best or quality > best[-1][1]:
            best.append((rate, quality))
    return best


def _curve(name: str, points: Sequence[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """PSNR and log rate in rising order of PSNR."""
    if len(points) < POINTS_MIN:
        raise UsageError(f"BD-rate needs at least {POINTS_MIN} points, the {name} curve has {len(points)}")
    rate, quality = np.array(sorted(points, key=lambda p: p[1]), np.float64).T
    if not (np.isfinite(rate).all() and np.isfinite(quality).all() and rate.min() > 0):
        raise UsageError(f"the {name} curve has a rate that is not positive or a value that is not finite")
    if (np.diff(quality) <= 0).any() or (np.diff(rate) <= 0).any():
        raise UsageError(f"the {name} curve does not rise in both rate and PSNR; drop the points that lie below it")
    return quality, np.log(rate)

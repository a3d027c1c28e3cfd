"""Splat frames recoloured by another tool -> a group with these colours and its own geometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..errors import CaptureError
from ..model.gaussians import Gaussians, living
from ..model.parametric_group import ParametricGroup
from ..model.rotations import turned_harmonics
from ..model.temporal_transform import dct_basis

APART = 0.01  # of the extent of the positions; a Gaussian farther from its position in the stream is another one


def with_colors(
    group: ParametricGroup, frames: Sequence[Callable[[], Gaussians]], names: Sequence[str]
) -> ParametricGroup:
    """The group with the colours of its frames, which `gscodec decode` wrote and another tool has recoloured.

    Args:
        frames: for each frame of the group a function that reads its Gaussians in order: all, or the visible ones.
        names: name of each frame, for messages.

    Raises:
        CaptureError: the Gaussians are not those of the group, or have harmonics that it has no room for.
    """
    sh0, shN, turns = [], [], group.harmonics_turns()
    for t, (read, name) in enumerate(zip(frames, names, strict=True)):
        own, g = group.frame(t), read()
        shown = _shown(group, t)
        at = np.arange(len(own)) if len(g) == len(own) else np.flatnonzero(shown)
        if len(g) != len(at):
            raise CaptureError(f"{name}: {len(g)} Gaussians, expected the {len(own)} of the stream in their order")
        _check_places(g.means, own.means[at], name)
        sh0.append(_filled(own.sh0, g.sh0, at))
        harmonics = _filled(own.shN, _harmonics(g.shN, own.shN.shape[1], name), at)
        shN.append(harmonics if turns is None else turned_harmonics(harmonics, turns[t], back=True))
    return _with(group, {"sh0": np.stack(sh0), "shN": np.stack(shN)})


def _shown(group: ParametricGroup, t: int) -> np.ndarray:
    """[N] bool: visible Gaussians of frame `t`."""
    life = group.lifetimes
    return np.ones(len(group.canonical), bool) if life is None else living(life, t)


def _check_places(means: np.ndarray, expected: np.ndarray, name: str) -> None:
    if not len(expected):
        return
    size = float(np.ptp(expected, axis=0).max()) or 1.0
    far = np.abs(means - expected).max(1) > APART * size
    if far.any():
        raise CaptureError(
            f"{name}: Gaussian {int(far.argmax())} is not where the stream has it, and {int(far.sum())} of {len(far)} "
            f"are not; expected those of `gscodec decode` (of a placed track, with --track 1:transform=none) in their "
            f"order, with other colours alone"
        )


def _harmonics(shN: np.ndarray, count: int, name: str) -> np.ndarray:
    """[N, count, 3]; missing ones are 0."""
    if shN[:, count:].any():
        raise CaptureError(
            f"{name}: {shN.shape[1]} spherical harmonics besides the constant one, the stream has room for {count}"
        )
    shN = shN[:, :count]
    return np.pad(shN, ((0, 0), (0, count - shN.shape[1]), (0, 0)))


def _filled(before: np.ndarray, new: np.ndarray, at: np.ndarray) -> np.ndarray:
    out = before.copy()
    out[at] = new
    return out


def _with(group: ParametricGroup, colors: dict[str, np.ndarray]) -> ParametricGroup:
    """The group with colours [T, N, ...] of its frames; outside a lifetime, the colours of the nearest frame inside."""
    n, frames = len(group.canonical), len(group)
    canonical, trajectories = {}, {k: v for k, v in group.trajectories.items() if k not in colors}
    for name, values in colors.items():
        if group.lifetimes is not None:
            t = np.clip(np.arange(frames)[:, None], group.lifetimes[:, 0], group.lifetimes[:, 1] - 1)
            values = values[t, np.arange(n)]
        canonical[name] = values.mean(0).astype(np.float32)
        left = (values - canonical[name]).reshape(frames, -1)
        c = (dct_basis(frames) @ left).reshape(frames, n, int(np.prod(values.shape[2:]))).astype(np.float32)
        if c.size and np.abs(c).max() > 0:
            trajectories[name] = np.ascontiguousarray(c.transpose(0, 2, 1))
    return replace(group, canonical=replace(group.canonical, **canonical), trajectories=trajectories)

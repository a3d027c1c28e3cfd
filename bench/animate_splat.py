"""One static splat -> a tracked sequence, one 3DGS .ply per frame; index i is the same Gaussian in every frame.

usage: python -m bench.animate_splat IN.ply OUT [--frames N] [--fps F] [--amount A] [--jitter J] [--up=-y] [--seed S]

For measuring the codec without training. The subject bends, twists and swings one side, all growing with height; its
shading changes slowly, and each attribute has correlated noise from frame to frame, as after training of single frames.
Properties of the file that do not move are copied. Equal arguments give equal values, so that results can be compared:
neither the formulas nor the order of random numbers may change.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from gscodec.errors import CaptureError
from gscodec.model.rotations import quat_multiply, rotate
from gscodec.ply_table import read_table, write_table
from gscodec.splats.ply import FIELDS

AXES = ("x", "-x", "y", "-y", "z", "-z")
JITTER = {"quats": 0.004, "log_scales": 0.01, "logit_opacities": 0.03, "sh0": 0.004}
MEANS_JITTER = 0.02  # of the mean extent of a Gaussian
KEEP = 0.7  # share of the noise that stays from one frame to the next
LIGHT = np.array([0.6, 0.6, 0.5])


@dataclass(frozen=True)
class Motion:
    """How the subject moves.

    Attributes:
        fps: frames per second.
        amount: factor on the angles of the motion.
        jitter: factor on the noise.
        up: world axis that points away from the floor, one of AXES.
        seed: seed of the noise.
    """

    fps: float = 30.0
    amount: float = 1.0
    jitter: float = 1.0
    up: str = "-y"
    seed: int = 0


@dataclass(frozen=True)
class Attributes:
    """Attributes of N Gaussians, f64; noise is drawn in the order of the fields."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4] wxyz, unit
    log_scales: np.ndarray  # [N, 3]
    logit_opacities: np.ndarray  # [N, 1]
    sh0: np.ndarray  # [N, 3]


class Body:
    """The subject at rest: its box, its upward direction and the height of each Gaussian."""

    def __init__(self, rest: Attributes, up: str):
        low, high = (np.percentile(rest.means, p, 0) for p in (1, 99))
        axis = "xyz".index(up[-1])
        self.rest = rest
        self.up = np.eye(3)[axis] * (-1 if up[0] == "-" else 1)
        self.side = np.eye(3)[(axis + 1) % 3]
        self.size = (high - low)[axis]
        self.center = (low + high) / 2
        self.height = np.clip((rest.means - self.center) @ self.up / self.size + 0.5, 0, 1)  # [N] 0 foot, 1 top
        across = (rest.means - self.center) @ self.side / self.size
        self.arm = self.height / (1 + np.exp(-(across - 0.1) * 16))  # [N] a soft joint on one side

    def moved(self, seconds: float, amount: float) -> Attributes:
        """The attributes at a time, without noise."""
        bend = _turn(self.side, amount * 0.35 * np.sin(2.1 * seconds) * self.height**2)
        twist = _turn(self.up, amount * 0.8 * np.sin(1.4 * seconds + 0.5) * self.height)
        swing = _turn(self.side, amount * 0.45 * np.sin(3.3 * seconds) * self.arm)
        means = self.rest.means
        shoulder, floor = self.center + 0.2 * self.size * self.up, self.center - self.up * self.size / 2
        for quats, pivot in ((swing, shoulder), (twist, self.center), (bend, floor)):
            means = pivot + rotate(quats, means - pivot)
        quats = quat_multiply(bend, quat_multiply(twist, quat_multiply(swing, self.rest.quats)))
        normals = rotate(quats, np.eye(3)[np.argmin(self.rest.log_scales, 1)])  # along the shortest axis
        shade = 0.06 * np.sin(1.7 * seconds) * (normals @ LIGHT)[:, None]
        return replace(self.rest, means=means, quats=quats, sh0=self.rest.sh0 + shade)


def _turn(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] of rotations about one axis [3] by `angles` [N]."""
    return np.concatenate([np.cos(angles / 2)[:, None], np.sin(angles / 2)[:, None] * axis], 1)


def animated(rows: np.ndarray, frames: int, motion: Motion) -> Iterator[np.ndarray]:
    """Yields the rows of each frame; `rows` is the static splat, a structured array with a field per property."""
    rest = Attributes(**{f.name: _columns(rows, FIELDS[f.name]) for f in fields(Attributes)})
    rest = replace(rest, quats=_unit(rest.quats))
    body, rng = Body(rest, motion.up), np.random.default_rng(motion.seed)
    sigma = {"means": MEANS_JITTER * np.exp(rest.log_scales.mean(1, keepdims=True)), **JITTER}
    noise = {name: np.zeros_like(values) for name, values in vars(rest).items()}
    for t in range(frames):
        values = dict(vars(body.moved(t / motion.fps, motion.amount)))
        for name, drift in noise.items():
            drift *= KEEP
            drift += motion.jitter * sigma[name] * rng.standard_normal(drift.shape)
            values[name] = values[name] + drift
        values["quats"] = _unit(values["quats"])
        frame = rows.copy()
        for name, columns in values.items():
            for i, field in enumerate(FIELDS[name]):
                frame[field] = columns[:, i]
        yield frame


def _columns(rows: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([rows[name] for name in names], 1).astype(np.float64)


def _unit(quats: np.ndarray) -> np.ndarray:
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def animate_splat(source: Path, folder: Path, frames: int, motion: Motion = Motion()) -> None:
    """Writes the frames of the .ply `source` as 000000.ply, 000001.ply ... into `folder`.

    Raises:
        CaptureError: `source` is not a PLY file.
    """
    static = read_table(source)["vertex"]
    folder.mkdir(parents=True, exist_ok=True)
    for t, rows in enumerate(animated(static, frames, motion)):
        write_table(folder / f"{t:06d}.ply", {"vertex": rows})


def main() -> None:
    """Parses the arguments and writes the frames."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("source", type=Path, metavar="IN.ply")
    parser.add_argument("folder", type=Path, metavar="OUT")
    parser.add_argument("--frames", type=int, default=40)
    default = Motion()
    parser.add_argument("--fps", type=float, default=default.fps)
    parser.add_argument("--amount", type=float, default=default.amount, help="factor on the motion")
    parser.add_argument("--jitter", type=float, default=default.jitter, help="factor on the noise")
    parser.add_argument("--up", choices=AXES, default=default.up, help="axis away from the floor, e.g. --up=-y")
    parser.add_argument("--seed", type=int, default=default.seed)
    a = parser.parse_args()
    try:
        animate_splat(a.source, a.folder, a.frames, Motion(a.fps, a.amount, a.jitter, a.up, a.seed))
    except CaptureError as e:
        sys.exit(f"error: {e}")
    print(f"{a.folder}: {a.frames} frames")


if __name__ == "__main__":
    main()

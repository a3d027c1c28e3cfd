"""Clause 2.8 of gsv.md for the reference decoder: a file with tracks -> the Gaussians that a frame of the scene shows.

In float64. Spherical harmonics are rotated by definition: their coefficients are fitted to the values of f(R^-1 d) in
many directions.
"""

from fractions import Fraction

import numpy as np
from reference_decoder import decode
from reference_evaluation import evaluate, quaternion_product, rotate, turned_harmonics


def pose(placement, u):
    """The transform at time `u`: rotation (wxyz), translation, scale."""
    keys = placement.keys
    if not keys:
        return np.array([1.0, 0, 0, 0]), np.zeros(3), 1.0
    before = [key for key in keys if key[0] <= u]
    after = [key for key in keys if key[0] > u]
    if not before or not after:
        return (before[-1] if before else after[0])[1:]
    (a, p, from_t, from_s), (b, q, to_t, to_s) = before[-1], after[0]
    f = float(Fraction(u - a) / (b - a))
    d = p @ q
    q, d = (-q, -d) if d < 0 else (q, d)
    if d > 0.9995:
        turned = p + f * (q - p)
    else:
        h = np.arccos(d)
        turned = (np.sin((1 - f) * h) * p + np.sin(f * h) * q) / np.sin(h)
    return turned / np.linalg.norm(turned), from_t + f * (to_t - from_t), from_s + f * (to_s - from_s)


def place(frame, rotation, translation, scale):
    """The attributes of a frame (clause 13) with the transform."""
    everywhere = np.broadcast_to(rotation, frame["quats"].shape)
    return frame | {
        "means": scale * rotate(rotation, frame["means"]) + translation,
        "quats": quaternion_product(everywhere, frame["quats"]),
        "log_scales": frame["log_scales"] + np.log(scale),
        "shN": turned_harmonics(frame["shN"], everywhere),
    }


def shown_frame(config, frames, u):
    """The frame of a track of `frames` frames at time `u`; None: it shows nothing."""
    p = config.placement
    n = (u - p.offset) // config.frame_duration
    if p.hidden or n < 0 or frames == 0 or (p.repeats and n >= p.repeats * frames):
        return None
    return int(n % frames)


def scene_frame(data, index):
    """Frame `index` of the scene: the attributes of all Gaussians that are shown, track after track."""
    first, _ = decode(data)
    parts = []
    for k in range(first.tracks):
        config, groups = decode(data, k)
        u = Fraction(index * first.frame_duration * config.timescale, first.timescale)
        t = shown_frame(config, sum(sample.frames for sample, _ in groups), u)
        for sample, group in groups:
            if t is not None and 0 <= t < sample.frames:
                frame = place(evaluate(group, t), *pose(config.placement, u))
                shown = frame.pop("shown")
                parts.append({name: values[shown] for name, values in frame.items()})
            t = None if t is None else t - sample.frames
    most = max((part["shN"].shape[1] for part in parts), default=0)
    for part in parts:
        part["shN"] = np.pad(part["shN"], ((0, 0), (0, most - part["shN"].shape[1]), (0, 0)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}

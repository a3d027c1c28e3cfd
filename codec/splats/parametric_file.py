"""ParametricGroup <-> arrays of an .npz, beside the .ply frames of a sequence. They are exact, so that a stream made of
the file equals one made in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace

import numpy as np

from ..model.camera import Calibration
from ..model.gaussians import Gaussians
from ..model.parametric_group import NodeMotion, ParametricGroup
from ..model.rig import RigMotion

OPTIONAL = ("lifetimes", "parents")


def to_arrays(group: ParametricGroup) -> dict[str, np.ndarray]:
    """Everything in a group as named arrays."""
    arrays = {n: np.array(getattr(group, n)) for n in ("frame_count", "rate_optimized", "ended", "turned_harmonics")}
    parts = {"canonical": group.canonical, "nodes": group.nodes, "calibration": group.calibration}
    parts["rig"] = group.nodes and group.nodes.rig
    for part, value in parts.items():
        if value is not None:
            arrays |= {f"{part}.{f.name}": getattr(value, f.name) for f in fields(value) if f.name != "rig"}
    arrays |= {f"trajectories.{n}": c for n, c in group.trajectories.items()}
    return arrays | {n: getattr(group, n) for n in OPTIONAL if getattr(group, n) is not None}


def from_arrays(arrays: Mapping[str, np.ndarray]) -> ParametricGroup:
    """Inverse of `to_arrays`.

    Raises:
        KeyError: an array is missing.
    """

    def part(name: str, kind):
        own = {n.partition(".")[2]: a for n, a in arrays.items() if n.startswith(f"{name}.")}
        return kind(**{f.name: own[f.name] for f in fields(kind) if f.name != "rig"}) if own else None

    calibration = part("calibration", Calibration)
    if calibration is not None and calibration.gains.ndim == 2:  # of an earlier version: the same in all frames
        every = (np.repeat(a[None], int(arrays["frame_count"]), 0) for a in (calibration.gains, calibration.offsets))
        calibration = Calibration(calibration.corrections, *every)
    nodes, rig = part("nodes", NodeMotion), part("rig", RigMotion)
    return ParametricGroup(
        int(arrays["frame_count"]),
        part("canonical", Gaussians),
        replace(nodes, rig=rig) if rig else nodes,
        {n.partition(".")[2]: a for n, a in arrays.items() if n.startswith("trajectories.")},
        *(arrays.get(n) for n in OPTIONAL),
        calibration,
        bool(arrays["rate_optimized"]),
        str(arrays["ended"]),
        bool(arrays.get("turned_harmonics", False)),  # earlier versions had none
    )

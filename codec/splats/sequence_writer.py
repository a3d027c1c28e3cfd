"""GaussianSequence -> a folder with one .ply per frame and sequence.json; the mirror of sequence.py.

Other tools see plain 3DGS files. All frames of a group have the same indices: a Gaussian outside its lifetime is
written with an invisible opacity, and its true opacity is in the .npz of the group, beside the nodes. Groups are added
one by one. sequence.json is replaced after each group: finished groups can be used, and a stopped run can resume.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..atomic_write import part_file
from ..model.camera import Camera
from ..model.gaussian_sequence import DenseGroup, GaussianSequence
from ..model.parametric_group import ParametricGroup
from . import parametric_file
from .ply import write_ply

HIDDEN = -30.0  # logit opacity that no renderer shows
NAME = "sequence.json"


class SequenceWriter:
    """Adds groups to a folder.

    Attributes:
        groups: the complete groups, as in sequence.json; after a resume, also those of the earlier run.
        frame_count: frames of those groups.
    """

    def __init__(
        self,
        folder: str | Path,
        fps: float,
        cameras: Sequence[Camera] = (),
        *,
        training: dict | None = None,
        resume: bool = False,
    ):
        """
        Args:
            training: facts that `encode` needs about a trained sequence (JSON-able): capture, range, sh_degree,
                gaussians, frames.
            resume: continue after the groups of an existing sequence.json; otherwise it is removed.
        """
        self._folder = Path(folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        listed = self._folder / NAME
        if not resume:
            listed.unlink(missing_ok=True)  # its frames will be overwritten
        self.groups = json.loads(listed.read_text())["groups"] if listed.is_file() else []
        self._head = {"fps": fps, "cameras": [_camera(c) for c in cameras]}
        self._head |= {} if training is None else {"training": training}

    @property
    def frame_count(self) -> int:
        return sum(g["frames"] for g in self.groups)

    def add(self, group: DenseGroup | ParametricGroup, progress: Callable[[int], None] | None = None) -> None:
        """Writes a group; `progress` is called with the number of all frames written so far."""
        start, extra, digest = self.frame_count, {}, hashlib.sha256()
        for t in range(len(group)):
            g = group.frame(t)
            if group.lifetimes is not None:
                away = (group.lifetimes[:, 0] > t) | (t >= group.lifetimes[:, 1])
                if away.any():
                    extra[f"hidden_{t}"] = g.logit_opacities[away]
                    g = replace(g, logit_opacities=np.where(away, np.float32(HIDDEN), g.logit_opacities))
            path = self._folder / f"{start + t:06d}.ply"
            write_ply(path, g)
            digest.update(path.read_bytes())
            if progress:
                progress(start + t + 1)
        entry = {"start": start, "frames": len(group)}
        if isinstance(group, ParametricGroup):
            extra |= parametric_file.to_arrays(group)
            entry["sha256"] = digest.hexdigest()  # of the frames: edited frames are coded as they are
        else:
            extra |= {n: v for n in ("lifetimes", "parents") if (v := getattr(group, n)) is not None}
        if extra:
            entry["extra"] = f"group_{len(self.groups):04d}.npz"
            with part_file(self._folder / entry["extra"]) as part, part.open("wb") as f:
                np.savez(f, **extra)
        self.groups.append(entry)
        with part_file(self._folder / NAME) as part:
            part.write_text(json.dumps(self._head | {"groups": self.groups}, indent=1) + "\n")


def write_sequence(
    sequence: GaussianSequence, folder: str | Path, progress: Callable[[int], None] | None = None
) -> None:
    """Writes a whole sequence; `progress` is called with the number of frames written."""
    writer = SequenceWriter(folder, sequence.fps, sequence.cameras)
    for group in sequence.groups:
        writer.add(group, progress)


def _camera(c: Camera) -> dict:
    return {
        "name": c.name,
        "width": c.width,
        "height": c.height,
        "K": c.K.tolist(),
        "viewmat": c.viewmat.tolist(),
        "near": c.near,
        "low_pass": c.low_pass,
        "split": c.split,
    }

"""Trained groups from tests/data, the streams coded from them, and their figures.

`groups.npz` holds two groups of 3 frames of the bundled capture, the second one continuing the first: nodes,
trajectories, lifetimes and harmonics as training makes them, with few Gaussians. test_regression.py compares the
figures with those recorded; make_trained.py writes both.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gscodec.capture import open_capture
from gscodec.decode import open_stream
from gscodec.encode.encode import StreamOutput, encode_groups, stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.fit import fit_groups
from gscodec.metrics.evaluate import evaluate_capture, evaluate_splats
from gscodec.model.camera import LOW_PASS
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.parametric_group import ParametricGroup
from gscodec.splats.parametric_file import from_arrays, to_arrays
from gscodec.train.refinement import PictureRefinement

DATA = Path(__file__).parent / "data"
EXAMPLE = Path(__file__).parent.parent / "examples" / "lumberjack"
FRAMES, GOP = 6, 3
EXACT = ("canonical.means", "nodes.positions")  # arrays that need more than half precision
TOLERANCES = {  # largest difference from a recorded figure, as a share or in its unit
    "kb_per_frame": 0.02,
    "codec_psnr": 0.1,
    "codec_psnr_fg": 0.1,
    "psnr": 0.1,
    "psnr_fg": 0.1,
    "ssim": 0.002,
    "haze": 0.05,
    "flicker": 0.02,
}


def save_groups(groups: list[ParametricGroup]) -> None:
    """Writes groups.npz, in half precision where that is enough."""
    arrays = {}
    for i, group in enumerate(groups):
        for name, a in to_arrays(group).items():
            if a.dtype in (np.float32, np.float64) and name not in EXACT:
                a = a.astype(np.float32 if name.startswith("calibration") else np.float16)
            arrays[f"{i}.{name}"] = a.astype(np.int16) if a.dtype == np.int32 else a
    np.savez_compressed(DATA / "groups.npz", **arrays)


@functools.cache
def load_groups() -> tuple[ParametricGroup, ...]:
    """Inverse of `save_groups`: an independent group, and one that continues it."""
    found: dict[str, dict] = {}
    with np.load(DATA / "groups.npz") as z:
        for name, a in z.items():
            number, _, name = name.partition(".")
            wide = {"float16": np.float32, "int16": np.int32}.get(str(a.dtype))
            found.setdefault(number, {})[name] = a if wide is None else a.astype(wide)
    return tuple(_unit(from_arrays(found[number])) for number in sorted(found))


def _unit(group: ParametricGroup) -> ParametricGroup:
    """Normalizes quaternions and weights, which half precision has rounded."""
    q, w = group.canonical.quats, group.nodes.weights
    canonical = replace(group.canonical, quats=q / np.linalg.norm(q, axis=1, keepdims=True))
    return replace(group, canonical=canonical, nodes=replace(group.nodes, weights=w / w.sum(1, keepdims=True)))


@functools.cache
def capture():
    """Frames of the bundled capture that the groups show, with the low-pass of their training."""
    return open_capture(EXAMPLE).frames(0, FRAMES).with_low_pass(LOW_PASS)


def plain(group: ParametricGroup) -> ParametricGroup:
    """The group without harmonics."""
    g = group.canonical
    rest = {n: c for n, c in group.trajectories.items() if n != "shN"}
    return replace(group, canonical=replace(g, shN=g.shN[:, :0]), trajectories=rest)


def splats(groups) -> list[DenseGroup]:
    """The first group as splats of another tool, without motion."""
    return [DenseGroup([groups[0].frame(t) for t in range(GOP)], groups[0].lifetimes)]


def still(groups) -> list[DenseGroup]:
    """The first frame of the first group."""
    return [DenseGroup([groups[0].visible(0)])]


@dataclass(frozen=True)
class Case:
    """Input and settings of a coded stream; `layers`: number of decoded layers for the figures, None: all."""

    settings: dict
    make: Callable[[tuple[ParametricGroup, ...]], list] = list
    pictures: int = 0
    layers: int | None = None
    base: dict = field(default_factory=lambda: {"quality": 50.0, "refine": 0})

    def stream(self, path: Path) -> list:
        """Writes the stream; returns its input groups."""
        groups = self.make(load_groups())
        first = groups[0].frame(0)
        config = stream_config(fps=30, sh_degree=first.sh_degree, gaussians=len(first), frames=GOP)
        refine = PictureRefinement(capture(), views=self.pictures) if self.pictures else None
        settings = EncodeSettings(**{**self.base, **self.settings})
        fitted = functools.partial(fit_groups, groups, random_access=settings.random_access)
        encode_groups(lambda _, __: fitted(), StreamOutput(path, config), settings, refine_by_pictures=refine)
        return groups


CASES = {
    "independent": Case({}, lambda groups: list(groups[:1])),
    "predicted": Case({}),
    "coarse": Case({"quality": 30.0}),
    "fine": Case({"quality": 70.0}),
    "without harmonics": Case({}, lambda groups: list(map(plain, groups))),
    "single frame": Case({}, still),
    "splats": Case({}, splats),
    "layers": Case({"layers": 3}),
    "first of the layers": Case({"layers": 3}, layers=1),
    "refined": Case({"refine": 12}),
    "refined by pictures": Case({"refine": None}, pictures=48),
}


def measure(case: Case, path: Path) -> dict:
    """Figures of the stream of a case; it is written to `path`."""
    groups = case.stream(path)
    sequence, stream = GaussianSequence(30.0, groups), open_stream(path, layers=case.layers)
    size, count = path.stat().st_size, sequence.frame_count
    found = evaluate_splats(stream.frame, sequence, frames=sorted({0, count // 2, count - 1}), size=size)
    found |= {
        k: v
        for k, v in evaluate_capture(stream.frame, capture().frames(0, count), with_vmaf=False).items()
        if k in ("psnr", "psnr_fg", "ssim", "haze", "flicker")
    }
    return {k: round(found[k], 4) for k in TOLERANCES if found[k] is not None}

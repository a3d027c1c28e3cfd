"""Bytes saved by a rig: the walking figure of bench/articulated.py without and with its rig, and posed anew.

usage: python -m bench.rig [--cases splats,training,posed] [--out FILE]

splats: frames of the figure, coded at several qualities. training: a capture of it (pictures of 15 cameras, 3 of them
held out), trained with the preset fast, then coded at several qualities without refinement. bench/results/rig.json has
the entries and, for each case, the change of the size at equal PSNR (Bjontegaard) from no rig to the rig.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gscodec.capture.capture import Capture
from gscodec.capture.images import View
from gscodec.decode import open_scene, open_stream
from gscodec.encode.encode import StreamOutput, encode_groups, stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.encode.tracks import TrackPlan, write_tracks
from gscodec.fit import fit_groups
from gscodec.metrics.bd_rate import bd_rate
from gscodec.metrics.evaluate import evaluate_capture, evaluate_splats
from gscodec.model.camera import PIXEL_LOW_PASS, Camera, look_at
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.rig import Rig
from gscodec.render.image import render_rgba

from .articulated import Figure, figure, pose, skin, wave
from .machine import RESULTS, update_entries

CASES = ("splats", "training", "posed")
QUALITIES = (30.0, 40.0, 50.0, 60.0)
SPLATS, TRAINED = {"count": 6000, "frames": 60, "gop": 30}, {"count": 4000, "frames": 12, "gop": 12, "fps": 12.5}
CAMERAS, HELD_OUT, SIZE = 15, 3, 160
MEASURED = 6  # frames of a sequence in which PSNR is measured


def write_stream(path: Path, groups: list, quality: float, rig: Rig | None, random_access: int) -> dict:
    """Codes dense or trained groups; returns the bytes of the file and of its motion."""
    first = groups[0].frame(0)
    config = stream_config(fps=25, sh_degree=first.sh_degree, gaussians=len(first), frames=len(groups[0]), up="y")
    settings = EncodeSettings(quality, refine=0, random_access=random_access)

    def fitted(done, _):
        return fit_groups(groups, start=done, random_access=random_access, quality=quality, rig=rig)

    path.unlink(missing_ok=True)
    report = encode_groups(fitted, StreamOutput(path, config), settings)
    moving = ("node_positions", "node_trajectories", "rig", "joint_poses")
    return {"bytes": report.bytes, "units": {n: report.units.get(n, 0) for n in moving}}


def splats(work: Path) -> Iterator[dict]:
    """The frames of the figure."""
    f, frames = figure(**SPLATS), SPLATS["frames"]
    some = list(range(0, frames, frames // MEASURED))
    for rig in (None, f.rig):
        for quality in QUALITIES:
            own = write_stream(work / "splats.gsv", f.sequence.groups, quality, rig, frames)
            psnr = evaluate_splats(open_stream(work / "splats.gsv").frame, f.sequence, some)["codec_psnr_fg"]
            yield {"case": "splats", "rig": rig is not None, "quality": quality, **own, "psnr": round(psnr, 2)}


def posed(work: Path) -> Iterator[dict]:
    """The stream of the walk, posed by `wave`, compared with the figure in these poses."""
    f, frames = figure(**SPLATS), SPLATS["frames"]
    write_stream(work / "walk.gsv", f.sequence.groups, 50.0, f.rig, frames)
    g, weights = skin(SPLATS["count"])
    truth = GaussianSequence(25.0, [DenseGroup(pose(g, weights, wave(frames)))])
    plan = TrackPlan.of(open_scene(work / "walk.gsv").tracks[0])
    other = Rig(f.rig.joints, f.rig.parents, wave(frames))
    size = write_tracks(work / "wave.gsv", [replace(plan, rig=other)])
    some = list(range(0, frames, frames // MEASURED))
    psnr = lambda path, seq: round(evaluate_splats(open_stream(path).frame, seq, some)["codec_psnr_fg"], 2)  # noqa: E731
    yield {
        "case": "posed",
        "rig": True,
        "quality": 50.0,
        "bytes": size,
        "psnr": psnr(work / "wave.gsv", truth),
        "psnr_before": psnr(work / "walk.gsv", f.sequence),
    }


def capture_of(f: Figure) -> Capture:
    """Pictures of the figure by cameras all around it."""
    cameras = []
    for i in range(CAMERAS):
        angle, height = 2.4 * i, (0.3, 1.1, 1.9)[i % 3]
        eye = np.array([3.2 * np.cos(angle), height, 0.2 + 3.2 * np.sin(angle)])
        K = np.array([[1.35 * SIZE, 0, SIZE / 2], [0, 1.35 * SIZE, SIZE / 2], [0, 0, 1]])
        split = "test" if i >= CAMERAS - HELD_OUT else "train"
        viewmat = look_at(eye, np.array([0, 0.95, 0.2]), np.array([0, 1.0, 0]))
        cameras.append(Camera(f"cam{i}", K, viewmat, SIZE, SIZE, split=split))

    def read(camera: int, frame: int) -> View:
        rgba = render_rgba(f.sequence.frame(frame), cameras[camera])
        rgb = rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6)
        to_u8 = lambda x: np.rint(255 * np.clip(x, 0, 1)).astype(np.uint8)  # noqa: E731
        return View(to_u8(rgb), to_u8(rgba[..., 3]))

    return Capture("figure", 12.5, cameras, f.sequence.frame_count, True, read).with_low_pass(PIXEL_LOW_PASS)


def training(work: Path) -> Iterator[dict]:
    """A capture of a faster walk."""

    from gscodec.train.settings import train_settings
    from gscodec.train.train import train_groups

    f = figure(**TRAINED)
    capture = capture_of(f)
    settings = train_settings("fast", sh_degree=0, gop=TRAINED["gop"])
    for rig in (None, f.rig):
        groups = list(train_groups(capture, settings, rig=rig))
        for quality in QUALITIES:
            own = write_stream(work / "trained.gsv", groups, quality, None, TRAINED["frames"])
            found = evaluate_capture(open_stream(work / "trained.gsv").frame, capture, with_vmaf=False)
            entry = {"case": "training", "rig": rig is not None, "quality": quality, **own}
            yield entry | {"psnr": round(found["psnr_fg"], 2), "groups": [len(g) for g in groups]}


def whole(entries: list[dict]) -> dict:
    """The result file, with the change of the size at equal PSNR of each case with all entries, of one commit."""
    saved = {}
    for case in ("splats", "training"):
        own = [e for e in entries if e["case"] == case]
        if len(own) == 2 * len(QUALITIES) and len({e["measured"]["commit"] for e in own}) == 1:
            saved[case] = bd_rate(*([(e["bytes"], e["psnr"]) for e in own if e["rig"] == r] for r in (False, True)))
    figures = {"splats": SPLATS, "training": TRAINED | {"cameras": CAMERAS, "held_out": HELD_OUT, "size": SIZE}}
    return {"settings": figures, "size_at_equal_psnr_percent": saved, "entries": entries}


def main() -> None:
    """Runs the cases."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", default=",".join(CASES), help="some of " + ",".join(CASES))
    parser.add_argument("--out", type=Path, default=RESULTS / "rig.json")
    options = parser.parse_args()
    cases = {"splats": splats, "training": training, "posed": posed}
    if unknown := set(options.cases.split(",")) - set(cases):
        parser.error(f"--cases {','.join(sorted(unknown))}: expected some of {','.join(CASES)}")
    with tempfile.TemporaryDirectory() as work:
        found = (entry for case in options.cases.split(",") for entry in cases[case](Path(work)))
        for entry in update_entries(options.out, found, lambda e: (e["case"], e["rig"], e["quality"]), whole):
            print({k: v for k, v in entry.items() if k != "measured"}, flush=True)


if __name__ == "__main__":
    main()

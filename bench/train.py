"""Quality against time and size of training: our presets, every frame trained alone, and V3's recipe.

bench/results/train.json has one entry per case, recipe, preset, quality and frames, measured on the test cameras:
seconds_per_frame, psnr, psnr_fg, ssim, gaussians, kb_per_frame, flicker; psnr_of_frame and flicker_of_frame (of the
window that ends at the frame) allow comparing runs over different frames. Recipes in the file:

model         our training before coding, without a size
gscodec       the same decoded from the stream, with still_gaussians and still_bits (still.py)
alone         a keyframe for every frame with the keyframe budget of the preset: the reference for tracking
alone-coded   the same decoded from our stream, every frame a group of its own
full          a keyframe for every frame with all the steps and Gaussians that help (FULL): the limit of the pictures
v3            V3's recipe, with steps for about the time of our preset medium on lumberjack (baselines/v3.py)
v3-coded      the same through V3's packing (baselines/videogs.py)
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gscodec.capture import Capture
from gscodec.errors import UsageError
from gscodec.model.camera import Camera
from gscodec.model.gaussians import RANDOM_ACCESS, Gaussians
from gscodec.model.parametric_group import ParametricGroup

from .drawn import Rig, animated_capture
from .machine import peak_gib, update_entries
from .still import still_share

if TYPE_CHECKING:
    from gscodec.encode.encode import EncodeReport

RECIPES = ("gscodec", "alone", "full", "v3")
FULL = {"keyframe_steps": 12_000, "gaussians_max": 156_250}  # for any picture; a keyframe may have 125,000 Gaussians
FULL_PRICE = 2e-5  # `KeyframeSettings.price`
V3_PACKING = {"qp": 25, "raw": True}  # its default qp, and the better of its two scripts
V3_GOP = 20  # frames in a group of V3
KEYS = ("psnr", "psnr_fg", "psnr_corrected", "ssim", "vmaf", "gaussians", "kb_per_frame", "flicker")
WORK = Path("build/bench")  # where moving splats are kept
PORTRAIT = Rig(width=1080, height=1440)


@dataclass(frozen=True)
class Case:
    """A capture and its use.

    Attributes:
        folder: in the data folder.
        test: names of the test cameras instead of the capture's own, which are then left out.
        scale: factor on the size of the images.
        frames: number of frames, from the first; None: all.
        splat: a static splat of the data folder instead, which `animate_splat` moves and `drawn.py` draws.
        vmaf: VMAF is measured too.
        rig: the rig that draws the splat.
        rounds: number of repetitions of its frames: a walk that ends where it began.
        back: every second round goes backwards: a motion that does not end where it began.
    """

    folder: str
    test: tuple[str, ...] = ()
    scale: float = 1.0
    frames: int | None = None
    splat: str | None = None
    vmaf: bool = False
    rig: Rig = PORTRAIT
    rounds: int = 1
    back: bool = False

    def open(self, data: Path) -> Capture:
        """The capture.

        Raises:
            UsageError: it is not in the data folder, or a camera is not in it.
        """
        from gscodec.capture import open_capture

        folder = Path(data) / self.folder
        if self.splat:
            capture = animated_capture(Path(data) / self.splat, WORK, self.frames, self.rig)
        elif folder.is_dir():
            capture = open_capture(folder).frames(0, self.frames)
        else:
            raise UsageError(f"{folder} does not exist")
        capture = held_out(capture, self.test) if self.test else capture
        return repeated(capture.scaled(self.scale), self.rounds, back=self.back)


CASES = {
    "lumberjack": Case("lumberjack"),
    "lumberjack-150": Case("lumberjack", rounds=5),
    "lumberjack-upper": Case("lumberjack", test=("cam16", "cam17", "cam18", "cam19")),  # the upper ring left out
    "stage": Case("stage"),
    "basketball": Case("basketball", frames=60),
    "statue-drawn": Case("", splat="splats/statue.ply", frames=40, vmaf=True),
    "statue-hd-150": Case(  # 150 frames of 1920 x 1080
        "", splat="splats/statue.ply", frames=30, rig=Rig(train=10, val=0, width=1920, height=1080), rounds=5, back=True
    ),
    "pose2sim": Case("pose2sim", test=("cam04",), scale=0.25, frames=10),
}


def repeated(capture: Capture, rounds: int, *, back: bool = False) -> Capture:
    """The capture with its frames repeated `rounds` times; `back`: every second round runs backwards."""
    count = capture.frame_count

    def at(t: int) -> int:
        turn, frame = divmod(t, count)
        return capture.first_frame + (count - 1 - frame if back and turn % 2 else frame)

    return replace(
        capture,
        first_frame=0,
        frame_count=rounds * count,
        read=lambda camera, t: capture.read(camera, at(t)),
        poses=capture.poses and (lambda camera, t: capture.poses(camera, at(t))),
    )


def held_out(capture: Capture, names: tuple[str, ...]) -> Capture:
    """The capture with the test cameras `names`, and its other training cameras for training."""
    unknown = set(names) - {c.name for c in capture.cameras}
    if unknown:
        known = ", ".join(c.name for c in capture.cameras)
        raise UsageError(f"{capture.name}: no camera {', '.join(sorted(unknown))}, there are {known}")
    kept = [i for i, c in enumerate(capture.cameras) if c.name in names or c.split == "train"]
    cameras = [replace(c, split="test" if c.name in names else "train") for c in (capture.cameras[i] for i in kept)]
    poses = capture.poses and (lambda camera, t: capture.poses(kept[camera], t))
    return replace(capture, cameras=cameras, read=lambda camera, t: capture.read(kept[camera], t), poses=poses)


@dataclass(frozen=True)
class Run:
    """One recipe on one case.

    Attributes:
        case: name in CASES.
        recipe: name in RECIPES.
        frames: "A:B" or "A:B:STEP", None: all.
        quality: quality of the stream; None: the encoder finds it.
        also: further qualities at which the same training is coded (recipe gscodec).
    """

    case: str
    recipe: str
    preset: str
    frames: str | None
    quality: float | None
    also: tuple[float, ...] = ()


def run(runs: Iterable[Run], data: Path, out: Path) -> Iterator[dict]:
    """Yields the entries of all `runs` and puts them into the result file `out` as they come.

    Raises:
        UsageError: a capture is not in the data folder.
    """
    for each in runs:
        yield from update(out, measure(each, data))


def measure(run: Run, data: Path) -> Iterator[dict]:
    """Entries of one recipe on one case.

    Raises:
        UsageError: the capture is not in the data folder.
    """
    from gscodec.encode.settings import EncodeSettings
    from gscodec.train.settings import coding_loss, train_settings

    capture = CASES[run.case].open(data)
    chosen = range(capture.frame_count)[slice(*(int(x) if x else None for x in (run.frames or ":").split(":")))]
    settings = train_settings(run.preset, run.quality)
    encodings = [EncodeSettings(q, loss=coding_loss(run.preset, capture)) for q in (run.quality, *run.also)]
    recipe = {"gscodec": _ours, "alone": _alone, "full": _full, "v3": _v3}[run.recipe]
    for name, seconds, size, models, *more in recipe(capture, chosen, settings, encodings):
        result = evaluate(part(capture, chosen), models, vmaf=CASES[run.case].vmaf)
        yield {
            "capture": run.case,
            "recipe": name,
            "preset": run.preset,
            "quality": run.quality if name in ("gscodec", "alone-coded") else None,
            "frames": [chosen.start, chosen.stop, chosen.step],
            "seconds_per_frame": round(seconds / len(chosen), 2),
            **{k: result[k] for k in KEYS},
            "kb_per_frame": size / 1000 / len(chosen) if size else None,
            "psnr_of_frame": [r["psnr_fg"] and round(r["psnr_fg"], 2) for r in result["per_frame"]],
            "flicker_of_frame": [r["flicker"] and round(r["flicker"], 3) for r in result["per_frame"]],
            **dict(*more),
        }


def _ours(capture: Capture, frames: range, settings, encodings) -> Iterator[tuple]:
    if frames.step != 1:
        raise UsageError("gscodec follows what moves: it needs every frame, expected a range without a step")
    own = part(capture, frames)
    groups, seconds_of_group = sequence(own, settings)
    trained = sum(seconds_of_group)
    found = {"seconds_of_group": [round(s, 1) for s in seconds_of_group], "peak_gib": peak_gib()}
    yield "model", trained, None, shown(groups), found
    for encoding in encodings:
        size, decoded, seconds, report = coded(own, groups, settings, encoding)
        share, bits = still_share(groups[0], report.quality, training_cameras(own, len(groups[0]) // 2))
        first, later = report.group_rates()
        found = {
            "quality": encoding.quality,
            "still_gaussians": round(share, 3),
            "still_bits": round(bits, 4),
            "coded_quality": round(report.quality, 2),
            "kb_per_frame_of_first_group": round(first, 3),
            "kb_per_frame_of_later_groups": later and round(later, 3),
            "groups": report.group_list,
        }
        yield "gscodec", trained + seconds, size, decoded, found


def _alone(capture: Capture, frames: range, settings, encodings) -> Iterator[tuple]:
    alone, seconds = every_frame_alone(capture, frames, settings)
    yield "alone", seconds, None, shown(alone)
    size, decoded, more, _ = coded(part(capture, frames), alone, settings, encodings[0])
    yield "alone-coded", seconds + more, size, decoded


def _full(capture: Capture, frames: range, settings, _) -> Iterator[tuple]:
    keyframe, budget = replace(settings.keyframe, price=FULL_PRICE), replace(settings.budget, steps_most=1.0)
    settings = replace(settings, **FULL, keyframe=keyframe, budget=budget)
    alone, seconds = every_frame_alone(capture, frames, settings)
    yield "full", seconds, None, shown(alone)


def _v3(capture: Capture, frames: range, settings, _) -> Iterator[tuple]:
    from .baselines.v3 import train_v3

    start = time.perf_counter()
    models = train_v3(part(capture, frames), range(len(frames)), settings)
    yield "v3", time.perf_counter() - start, None, models
    size, decoded = v3_coded(models)
    yield "v3-coded", time.perf_counter() - start, size, decoded


def v3_coded(models: list[Gaussians]) -> tuple[int, list[Gaussians]]:
    """Bytes of frames in V3's packing, and the decoded frames."""
    from .baselines import videogs

    size, decoded = 0, []
    for first in range(0, len(models), V3_GOP):
        files = videogs.encode(models[first : first + V3_GOP], **V3_PACKING)
        size += sum(map(len, files.values()))
        decoded += videogs.decode(files)
    return size, decoded


def sequence(
    capture: Capture, settings, random_access: int = RANDOM_ACCESS
) -> tuple[list[ParametricGroup], list[float]]:
    """Trains the capture (`random_access`: see `train_groups`); returns the groups and the seconds of each."""
    from gscodec.train.train import train_groups

    groups, seconds, start = [], [], time.perf_counter()
    for group in train_groups(capture, settings, random_access=random_access):
        groups.append(group)
        seconds.append(time.perf_counter() - start - sum(seconds))
    return groups, seconds


def shown(groups: list[ParametricGroup]) -> list[Gaussians]:
    """The living Gaussians of each frame."""
    return [group.visible(t) for group in groups for t in range(len(group))]


def training_cameras(capture: Capture, t: int) -> list[Camera]:
    """The cameras for training, as they stand at frame `t`."""
    return [capture.camera(i, t) for i in capture.indices("train")]


def coded(
    capture: Capture, groups: list[ParametricGroup], settings, encoding
) -> tuple[int, list[Gaussians], float, EncodeReport]:
    """Codes the groups, refined by the pictures of the capture where training has calibrated its cameras.

    Returns:
        Bytes of the stream, its decoded frames, seconds of coding, the report.
    """
    from gscodec.decode import open_stream
    from gscodec.encode.encode import StreamOutput, encode_groups, stream_config
    from gscodec.train.refinement import PictureRefinement

    degree, most = settings.sh_degree, settings.gaussians_max
    config = stream_config(fps=capture.fps, sh_degree=degree, gaussians=most, frames=settings.gop)
    with tempfile.TemporaryDirectory() as folder:
        out, start = Path(folder) / "out.gsv", time.perf_counter()
        report = encode_groups(
            lambda done, _: iter(groups[done:]),
            StreamOutput(out, config),
            encoding,
            cameras=lambda t: training_cameras(capture, t),
            refine_by_pictures=PictureRefinement(capture, settings.refinement),
        )
        seconds, stream = time.perf_counter() - start, open_stream(out)
        return out.stat().st_size, [stream.frame(t) for t in range(stream.frame_count)], seconds, report


def every_frame_alone(capture: Capture, frames: Sequence[int], settings) -> tuple[list[ParametricGroup], float]:
    """Trains a keyframe for each of `frames`; returns them as groups, with the calibration that they have learned, and
    the seconds."""

    from gscodec.render.cpu import CpuBackend
    from gscodec.train.budget import keyframe_budget
    from gscodec.train.initialization import initial_model
    from gscodec.train.keyframe import train_keyframe
    from gscodec.train.views import Views

    settings = settings.of_capture(capture)
    groups, start = [], time.perf_counter()
    for frame in frames:
        views = Views(capture, settings, CpuBackend())
        budget = keyframe_budget(views, frame, settings)
        model, radius = initial_model(capture, frame, budget.points, settings)
        train_keyframe(model, views, frame, settings, steps=budget.steps, radius=radius)
        groups.append(ParametricGroup(1, model.gaussians(), calibration=views.calibration(range(frame, frame + 1))))
    return groups, time.perf_counter() - start


def part(capture: Capture, frames: range) -> Capture:
    """The capture with only these frames."""
    at = lambda t: capture.first_frame + frames[t]  # noqa: E731
    return replace(
        capture,
        cameras=[capture.camera(i, frames[0]) for i in range(len(capture.cameras))],
        first_frame=0,
        frame_count=len(frames),
        fps=capture.fps / frames.step,
        read=lambda camera, t: capture.read(camera, at(t)),
        poses=capture.poses and (lambda camera, t: capture.poses(camera, at(t))),
    )


def evaluate(capture: Capture, frames: list[Gaussians], *, vmaf: bool = False) -> dict:
    """Results on the test cameras (metrics/evaluate.py), with the mean count of Gaussians."""
    from gscodec.metrics.evaluate import evaluate_capture

    result = evaluate_capture(lambda t: frames[t], capture, "test", with_vmaf=vmaf)
    return result | {"gaussians": int(np.mean([len(g) for g in frames]))}


def update(out: Path, entries: Iterator[dict]) -> Iterator[dict]:
    """Yields entries and puts each into the result file, in place of an older one of the same run."""
    return update_entries(out, entries, lambda e: [e[k] for k in ("capture", "recipe", "preset", "quality", "frames")])

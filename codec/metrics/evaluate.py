"""Decoded frames and their reference, a capture or splats -> the figures of `gscodec eval`.

One pass over frames and cameras: one frame of each side is in memory. Views of a capture and rendered Gaussians are
composited over mid-grey, on which dark and bright haze have the same contrast. Each view is compared with the picture
of its camera in its frame, since cameras may move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack

import numpy as np

from ..capture import Capture, View, composite
from ..errors import UsageError
from ..model.camera import Camera, low_pass_of
from ..model.gaussian_sequence import GaussianSequence
from ..model.gaussians import Gaussians
from .codec_cameras import codec_cameras
from .image import foreground, haze, psnr, psnr_corrected, ssim
from .stability import TemporalMeter
from .vmaf import VmafMeter

BACKGROUND = (0.5, 0.5, 0.5)
FG_ALPHA = 0.02  # alpha of a rendered reference; above it is the foreground of codec_psnr_fg
FrameSource = Callable[[int], Gaussians]
Progress = Callable[[int, int], None]  # (images done, images)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def _report(
    frame_count: int, counts: list[int], size: int | None, rows: list[dict], encoded: float | None = None
) -> dict:
    """The keys of both evaluations; a key that does not apply is None.

    Args:
        frame_count: frames of the stream, whose bytes are `size`.
        counts: Gaussians of each measured frame.
        rows: measures of each measured frame.
        encoded: Gaussians per frame of the source, by which the bits are divided; None: those of the decoded frames.
    """
    gaussians = float(np.mean(counts))
    divisor = gaussians if encoded is None else encoded
    known = {k: _mean(r[k] for r in rows) for k in rows[0] if k != "frame"}
    return {
        "frames": frame_count,
        "gaussians": round(gaussians),
        "bytes": size,
        "kb_per_frame": None if size is None else size / 1000 / frame_count,
        "bits_per_gaussian_frame": None if size is None or not divisor else 8 * size / frame_count / divisor,
        **dict.fromkeys(("psnr", "psnr_fg", "ssim", "vmaf", "flicker", "codec_psnr", "codec_psnr_fg")),
        **known,
        "background": list(BACKGROUND),
        "per_frame": rows,
    }


def evaluate_capture(
    frame_source: FrameSource,
    capture: Capture,
    split: str = "test",
    *,
    size: int | None = None,
    stream_frames: int | None = None,
    with_vmaf: bool = True,
    progress: Progress | None = None,
) -> dict:
    """Measures Gaussians against the images of a capture.

    Args:
        frame_source: frame -> Gaussians as shown, for every frame of the capture.
        split: cameras to compare with, "test" or "train".
        size: bytes of the stream, for the rates.
        stream_frames: number of frames in the stream; None: as in the capture.
        with_vmaf: also VMAF, which takes about as long as all other measures.
        progress: called with (images done, images).

    Returns:
        frames, gaussians (mean per frame), bytes, kb_per_frame, bits_per_gaussian_frame, psnr, psnr_fg (of the subject,
        over the pictures that show it), psnr_corrected (the same after a gain and an offset for each view and channel),
        ssim, haze (8-bit levels), vmaf, vmaf_crop (one per camera), flicker (8-bit levels), stability (dB), per_frame,
        views, split.

    Raises:
        UsageError: the split has no cameras.
    """
    views = capture.indices(split)
    if not views:
        raise UsageError(f"{capture.name}: no {split} cameras to evaluate against; try another --split")
    rows, counts = [], []
    with ExitStack() as stack:
        temporal = [TemporalMeter() for _ in views]
        vmaf = [stack.enter_context(VmafMeter(capture.fps)) for _ in views] if with_vmaf else [None] * len(views)
        for t in range(capture.frame_count):
            gaussians, images = frame_source(t), []
            counts.append(len(gaussians))
            for n, index in enumerate(views):
                view, camera = capture.view(index, t), capture.camera(index, t)
                images.append(_compare(gaussians, camera, view, temporal[n], vmaf[n]))
                if progress:
                    progress(t * len(views) + n + 1, capture.frame_count * len(views))
            rows.append({"frame": t} | {k: _mean(i[k] for i in images) for k in images[0]})
        report = _report(stream_frames or capture.frame_count, counts, size, rows)
        report["vmaf"] = _mean(m.score() for m in vmaf if m)
        report["vmaf_crop"] = [m.crop() for m in vmaf if m]
    report["flicker"] = _mean(m.flicker for m in temporal)
    report["stability"] = _mean(m.stability for m in temporal)
    return report | {"views": [capture.cameras[i].name for i in views], "split": split}


def _compare(g: Gaussians, camera: Camera, view: View, temporal: TemporalMeter, vmaf: VmafMeter | None) -> dict:
    """The figures of one image, which is also added to the meters."""
    from ..render.image import render_image

    reference, image = composite(view, BACKGROUND), render_image(g, camera, background=BACKGROUND)
    inside = None if view.alpha is None else foreground(view.alpha)
    shown = inside is None or inside.any()
    flicker = temporal.add(reference, image, inside)
    if vmaf:
        vmaf.add(reference, image, view.alpha)
    return {
        "psnr": psnr(reference, image),
        "psnr_fg": psnr(reference, image, inside) if shown else None,
        "psnr_corrected": psnr_corrected(reference, image, inside) if shown else None,
        "ssim": ssim(reference, image),
        "haze": haze(reference, image, view.alpha),
        "flicker": flicker,
    }


def evaluate_splats(
    frame_source: FrameSource,
    sequence: GaussianSequence,
    frames: Sequence[int] | None = None,
    *,
    size: int | None = None,
    stream_frames: int | None = None,
    progress: Progress | None = None,
) -> dict:
    """Measures decoded Gaussians against the encoded ones, both rendered from the 16 codec cameras.

    Args:
        frame_source: frame -> Gaussians as shown.
        frames: the frames to compare; all by default.
        size: bytes of the stream, for the rates.
        stream_frames: number of frames in the stream; None: as in the sequence.

    Returns:
        The keys of evaluate_capture with codec_psnr and codec_psnr_fg instead of psnr, psnr_fg, ssim, vmaf and flicker,
        and gaussians_encoded, the mean number in a frame of `sequence`, by which bits_per_gaussian_frame divides.

    Raises:
        UsageError: a frame is outside the sequence.
    """
    picked = list(range(sequence.frame_count)) if frames is None else list(frames)
    outside = [t for t in picked if not 0 <= t < sequence.frame_count]
    if outside or not picked:
        raise UsageError(f"frames {outside or 'none'} to evaluate, the sequence has 0 to {sequence.frame_count - 1}")
    some = [sequence.frame(t) for t in sorted({picked[0], picked[len(picked) // 2], picked[-1]})]
    cameras = codec_cameras(some, low_pass_of(sequence.cameras))
    rows, counts, given = [], [], []
    for i, t in enumerate(picked):
        reference, decoded = sequence.frame(t), frame_source(t)
        counts.append(len(decoded))
        given.append(len(reference))
        images = []
        for n, camera in enumerate(cameras):
            expected, alpha = _draw(reference, camera)
            image, _ = _draw(decoded, camera)
            inside = alpha > FG_ALPHA
            fg = psnr(expected, image, inside) if inside.any() else None
            images.append({"codec_psnr": psnr(expected, image), "codec_psnr_fg": fg})
            if progress:
                progress(i * len(cameras) + n + 1, len(picked) * len(cameras))
        rows.append({"frame": t} | {k: _mean(x[k] for x in images) for k in images[0]})
    encoded = float(np.mean(given))
    report = _report(stream_frames or sequence.frame_count, counts, size, rows, encoded)
    return report | {"gaussians_encoded": round(encoded)}


def _draw(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] u8 over the background, and alpha [H, W] f32."""
    from ..render.image import render_rgba

    rgba = render_rgba(gaussians, camera)  # premultiplied
    image = rgba[..., :3] + np.asarray(BACKGROUND, np.float32) * (1 - rgba[..., 3:])
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8), rgba[..., 3]

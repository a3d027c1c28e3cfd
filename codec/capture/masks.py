"""Masks for a capture that has none: from an empty plate of each camera, or from what moves. Writes files, which the
reader of the layout finds and people may edit.

A plate is the picture of a camera without the subject. Without one, a pixel counts as moving that differs from the
mean of an earlier and a later frame: a lamp that is faded in does not, unlike in a background model (Zivkovic 2004 was
tried), and a figure that turns in place stays a figure. In both cases the pixels in question and their colours are
handed to GrabCut (Rother et al. 2004), which draws the border at `SIDE` pixels; a guided filter (He et al. 2013)
brings it to the size of the picture.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ..errors import CaptureError, UsageError, require
from .capture import Capture
from .images import SUFFIXES, read_image
from .rig import Feed, numbered

SIDE = 512  # pixels, longest side of the pictures in which masks are found
CHANGE = 10.0  # of 255, least difference of a pixel that has changed
NOISE = 5.0  # standard deviations of the noise that are no change either
LOUDEST = 40.0  # of 255, a change whatever the noise is
LAG = 0.04  # seconds from a frame to the earlier and the later one
WINDOW = 0.13  # seconds before and after a frame in which movement counts
CLOSE, GROW, SMALL = 0.03, 0.012, 0.002  # of the diagonal: gaps closed, margin; of the area: parts that are left out
SHADOW = (0.45, 0.97)  # brightness of a shadow, times that of the plate
SHADOW_TINT = 0.06  # difference of its channels, of that
BIN = 12  # levels of Lab in a bin of the colour histograms
ROUNDS = 3  # of GrabCut
MOVES_ALL = 0.6  # share of a picture; if more of it moves, the camera does


def make_masks(
    capture: Capture,
    plates: Path | None = None,
    *,
    overwrite: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Writes a mask for every camera and frame to where the capture's reader looks for them, all or none.

    Args:
        plates: folder with CAMERA.png (or another image) of each camera; None: what moves is the subject.
        overwrite: masks that are there may be replaced.
        on_progress: called with cameras done and in all.

    Returns:
        The number of files.

    Raises:
        UsageError: there are masks already.
        CaptureError: a plate is missing or does not fit, a camera moves, or there are too few frames.
    """
    _check(capture, plates, overwrite)
    find = [_plate_finder(capture, i, plates) if plates else None for i in range(len(capture.cameras))]
    parts: list[tuple[Path, Path]] = []

    def one(index: int) -> list[tuple[Path, Path]]:
        feed, written = capture.footage[index], []
        likely = find[index] or _moving_finder(feed, capture.frame_count, capture.fps)
        try:
            found = 0
            for t in range(capture.frame_count):
                alpha = _mask_of(feed.picture(t).rgb, *likely(t))
                found += bool(alpha.any())
                written.append(_write_part(feed.mask_files[t], alpha))
        except BaseException:
            _remove(written)
            raise
        if found < capture.frame_count:
            name, none = capture.cameras[index].name, capture.frame_count - found
            warnings.warn(f"camera {name}: nothing is found in {none} of {capture.frame_count} frames", stacklevel=2)
        return written

    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            for done, written in enumerate(pool.map(one, range(len(capture.cameras))), 1):
                parts += written
                on_progress(done, len(capture.cameras))
    except BaseException:
        _remove(parts)
        raise
    for part, path in parts:
        os.replace(part, path)
    return len(parts)


def _check(capture: Capture, plates: Path | None, overwrite: bool) -> None:
    if any(f.has_alpha and not f.masks for f in capture.footage):
        raise UsageError(f"{capture.name}: its images have an alpha channel, which is their mask; none is to be made")
    there = next((m for f in capture.footage for m in (*f.masks, *f.mask_files) if m.is_file()), None)
    if there is not None and not overwrite:
        raise UsageError(f"{there}: there are masks already; delete them, or say --overwrite to replace them")
    if capture.moves:
        raise CaptureError(f"{capture.name}: its cameras move, so that everything does; make masks with another tool")
    if plates is None and capture.frame_count < 3:
        raise CaptureError(
            f"{capture.name}: {capture.frame_count} frames, expected 3 or more to see what moves, or --plate DIR"
        )


def find_plate(folder: Path, camera: str) -> Path:
    """The picture of a camera in a folder of plates: CAMERA.png, or the first image in CAMERA/.

    Raises:
        CaptureError: there is none.
    """
    named = [folder / (camera + s) for s in SUFFIXES]
    found = [p for p in named if p.is_file()] or numbered(folder / camera)
    if not found:
        raise CaptureError(f"{folder}: no picture of camera {camera} without the subject, expected {camera}.png")
    return found[0]


Likely = tuple[np.ndarray, np.ndarray]  # [h, w] bool at `SIDE`: surely or likely the subject, and possibly


def _plate_finder(capture: Capture, index: int, plates: Path) -> Callable[[int], Likely]:
    """t -> what differs from the plate of camera `index`, without its shadow."""
    feed, path = capture.footage[index], find_plate(plates, capture.cameras[index].name)
    plate = read_image(path).rgb
    if plate.shape[:2] != (feed.height, feed.width):
        height, width = plate.shape[:2]
        raise CaptureError(f"{path}: {width}x{height}, expected {feed.width}x{feed.height} as the images of its camera")
    empty = _small(plate)

    def likely(t: int) -> Likely:
        seen = _small(feed.picture(t).rgb)
        ratio = (seen + 1) / (empty + 1)
        ratio /= np.median(ratio.reshape(-1, 3), 0)  # exposure
        change = np.abs(ratio - 1) * (empty + 1)
        dark = ratio.mean(-1)
        shadow = (dark > SHADOW[0]) & (dark < SHADOW[1]) & (np.ptp(ratio, -1) < SHADOW_TINT * dark)
        return _likely((_changed(change.max(-1)) & ~shadow).astype(np.uint8))

    return likely


def _moving_finder(feed: Feed, frames: int, fps: float) -> Callable[[int], Likely]:
    """t -> what moves around frame t, as far as its colours are not those of what does not."""
    lag, window = max(1, round(LAG * fps)), max(1, round(WINDOW * fps))
    lag = min(lag, (frames - 1) // 2)
    kept: dict[int, np.ndarray] = {}

    def picture(t: int) -> np.ndarray:
        t = min(max(t, 0), frames - 1)
        if t not in kept:
            kept[t] = _small(feed.picture(t).rgb)
            for old in [k for k in kept if k < t - 2 * lag - 1]:
                del kept[old]
        return kept[t]

    moving = []
    for t in range(frames):
        middle = min(max(t, lag), frames - 1 - lag)
        change = np.abs(picture(middle) - (picture(middle - lag) + picture(middle + lag)) / 2).max(-1)
        moving.append(_without_specks(_changed(change).astype(np.uint8), 0.05 * SMALL))
    if np.mean([m.mean() for m in moving]) > MOVES_ALL:
        raise CaptureError(f"{feed.path}: nearly everything changes, expected a camera that stands still")

    def likely(t: int) -> Likely:
        _, possible = _likely(np.max(moving[max(0, t - window) : t + window + 1], 0))
        return _unlike_background(feed.picture(t).rgb, possible) & possible, possible

    return likely


def _small(rgb: np.ndarray) -> np.ndarray:
    """[h, w, 3] f32 at `SIDE`, smoothed."""
    cv2 = require("cv2", "making masks")
    scale = min(1.0, SIDE / max(rgb.shape[:2]))
    size = max(1, round(scale * rgb.shape[1])), max(1, round(scale * rgb.shape[0]))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    return cv2.GaussianBlur(small, (5, 5), 0).astype(np.float32)


def _changed(change: np.ndarray) -> np.ndarray:
    """[h, w] bool, by more than noise: the median of a picture that mostly stands still is noise."""
    return change > np.clip(NOISE * 1.4826 * float(np.median(change)), CHANGE, LOUDEST)


def _disc(radius: float) -> np.ndarray:
    cv2 = require("cv2", "making masks")
    r = max(1, round(radius))
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * r + 1, 2 * r + 1))


def _without_specks(mask: np.ndarray, share: float) -> np.ndarray:
    """A u8 mask without parts that are smaller than a share of the picture."""
    cv2 = require("cv2", "making masks")
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    kept = stats[:, cv2.CC_STAT_AREA] >= share * mask.size
    kept[0] = False
    return kept[labels].astype(np.uint8)


def _likely(changed: np.ndarray) -> Likely:
    """What has changed ([h, w] u8), and the same with its gaps closed and its holes filled."""
    cv2 = require("cv2", "making masks")
    diagonal = float(np.hypot(*changed.shape))
    changed = _without_specks(changed, 0.05 * SMALL)
    closed = np.pad(cv2.morphologyEx(changed, cv2.MORPH_CLOSE, _disc(CLOSE * diagonal)), 1)
    outside = closed.copy()
    cv2.floodFill(outside, None, (0, 0), 1)
    filled = (closed | (1 - outside))[1:-1, 1:-1]
    opened = cv2.morphologyEx(filled, cv2.MORPH_OPEN, _disc(0.5 * GROW * diagonal))
    possible = _without_specks(opened, SMALL) > 0
    likely = cv2.morphologyEx(changed, cv2.MORPH_CLOSE, _disc(0.3 * CLOSE * diagonal)) > 0
    return likely & possible, possible


def _unlike_background(rgb: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """[h, w] bool: the colour is commoner where the subject may be than elsewhere, around a pixel."""
    import cv2
    from scipy.ndimage import gaussian_filter

    small = cv2.resize(rgb, possible.shape[::-1], interpolation=cv2.INTER_AREA)
    bins = 255 // BIN + 1
    lab = (cv2.cvtColor(small, cv2.COLOR_RGB2LAB) // BIN).astype(np.int64)
    key = (lab[..., 0] * bins + lab[..., 1]) * bins + lab[..., 2]
    density = []
    for where in (possible, ~possible):
        counts = np.bincount(key[where], minlength=bins**3).reshape(bins, bins, bins) / max(where.sum(), 1)
        density.append(gaussian_filter(counts.astype(np.float32), 1).ravel())
    subject = density[0] / (density[0] + density[1] + 1e-9)
    return cv2.blur(subject[key].astype(np.float32), (7, 7)) > 0.5


def _mask_of(rgb: np.ndarray, likely: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """[H, W] u8 mask of a picture."""
    cv2 = require("cv2", "making masks")
    if not likely.any():
        return np.zeros(rgb.shape[:2], np.uint8)
    small = cv2.resize(rgb, likely.shape[::-1], interpolation=cv2.INTER_AREA)
    margin = cv2.dilate(possible.astype(np.uint8), _disc(GROW * float(np.hypot(*likely.shape)))) > 0
    labels = np.where(margin, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    labels[likely] = cv2.GC_PR_FGD
    if (labels == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), labels, None, *models, ROUNDS, cv2.GC_INIT_WITH_MASK)
    cut = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
    cut = _without_specks(cv2.morphologyEx(cut, cv2.MORPH_OPEN, _disc(1)), SMALL)
    scale = max(rgb.shape[:2]) / max(cut.shape)
    large = cv2.resize(255 * cut, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return cv2.ximgproc.guidedFilter(rgb, large, max(1, round(scale)), (0.02 * 255) ** 2)


def _write_part(path: Path, alpha: np.ndarray) -> tuple[Path, Path]:
    """Writes NAME.part; returns it and the name that it will have."""
    cv2 = require("cv2", "making masks")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_bytes(cv2.imencode(".png", alpha)[1].tobytes())
    return part, path


def _remove(parts: list[tuple[Path, Path]]) -> None:
    for part, _ in parts:
        part.unlink(missing_ok=True)

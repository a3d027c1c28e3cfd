"""Likely pixels of the subject, for masks.py: pixels that differ from a picture of the empty scene (a plate), or move.

Without a plate, a pixel moves if it differs from the mean of an earlier and a later frame. So a lamp that is faded in
does not count as motion, unlike in a background model (Zivkovic 2004 was tried), and a figure that turns in place stays
a figure. Where a pixel is away from motion in enough frames, their mean is its plate, and the pixel is compared with
it; elsewhere colours decide.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from ..errors import CaptureError, require
from .capture import Capture
from .images import SUFFIXES, View, read_image
from .rig import numbered

SIDE = 512  # pixels, longest side of the pictures in which masks are found
CHANGE = 10.0  # of 255, least difference of a changed pixel
SURE = 2.0  # times CHANGE; a pixel that differs by more is surely the subject, whatever its colour
NOISE = 5.0  # standard deviations of the noise; a smaller difference is no change either
LOUDEST = 40.0  # of 255; a larger difference is a change, whatever the noise
LAG = 0.04  # seconds from a frame to the earlier and the later one
WINDOW = 0.13  # seconds before and after a frame in which motion counts
UNCOVERED = 0.15  # least share of the frames in which a pixel is away from motion, to be known as background
UNCOVERED_LEAST = 3  # least number of these frames
CLOSE, GROW, SMALL = 0.03, 0.012, 0.002  # of the diagonal: gaps closed, margin; of the area: parts left out
SHADOW = (0.45, 0.97)  # least and largest brightness of a shadow, as a share of the plate's
SHADOW_TINT = 0.06  # largest difference between the channels of a shadow, as a share of its brightness
BIN = 12  # levels of Lab in a bin of the colour histograms
MOVES_ALL = 0.6  # share of a picture; if more pixels move, the camera moves


class Footage(Protocol):
    """The pictures of one camera, such as a `Feed`.

    Attributes:
        path: for messages.
    """

    path: Path

    def picture(self, t: int) -> View:
        """Frame `t`, without the mask of a mask file."""


class Likely(NamedTuple):
    """[h, w] bool each, at `SIDE`: pixels that are likely, possibly and surely the subject."""

    likely: np.ndarray
    possible: np.ndarray
    sure: np.ndarray


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


def plate_finder(capture: Capture, index: int, plates: Path) -> Callable[[int], Likely]:
    """t -> pixels that differ from the plate of camera `index`, without the subject's shadow.

    Raises:
        CaptureError: the plate is missing or does not fit.
    """
    feed, path = capture.footage[index], find_plate(plates, capture.cameras[index].name)
    plate = read_image(path).rgb
    if plate.shape[:2] != (feed.height, feed.width):
        height, width = plate.shape[:2]
        raise CaptureError(f"{path}: {width}x{height}, expected {feed.width}x{feed.height} as the images of its camera")
    return unlike_finder(feed, plate)


def unlike_finder(feed: Footage, plate: np.ndarray) -> Callable[[int], Likely]:
    """t -> pixels that differ from `plate`, [H, W, 3] u8 of the same camera, without the subject's shadow."""
    empty = _small(plate)

    def find(t: int) -> Likely:
        seen = _small(feed.picture(t).rgb)
        ratio = (seen + 1) / (empty + 1)
        ratio /= np.median(ratio.reshape(-1, 3), 0)  # exposure
        change = np.abs(ratio - 1) * (empty + 1)
        likely, possible = _regions((_changed(change.max(-1)) & ~_shadow(ratio)).astype(np.uint8))
        return Likely(likely, possible, np.zeros_like(likely))

    return find


def _shadow(ratio: np.ndarray) -> np.ndarray:
    """[h, w] bool: all channels are darker by a similar factor. `ratio`: [h, w, 3] brightness over the plate's."""
    dark = ratio.mean(-1)
    return (dark > SHADOW[0]) & (dark < SHADOW[1]) & (np.ptp(ratio, -1) < SHADOW_TINT * dark)


def moving_finder(feed: Footage, frames: int, fps: float) -> Callable[[int], Likely]:
    """t -> pixels that move around frame t and do not look like the background.

    Raises:
        CaptureError: the camera moves.
    """
    moving, window = _moving(feed, frames, fps), max(1, round(WINDOW * fps))

    def near_movement(t: int) -> np.ndarray:
        return _regions(np.max(moving[max(0, t - window) : t + window + 1], 0))[1]

    plate, known = _uncovered(feed, [near_movement(t) for t in range(frames)])

    def find(t: int) -> Likely:
        picture, possible = feed.picture(t).rgb, near_movement(t)
        seen = _small(picture)
        change = np.abs(seen - plate).max(-1)
        changed = known & (change > CHANGE) & ~_shadow((seen + 1) / (plate + 1))
        likely = np.where(known, changed, _unlike_background(picture, possible))
        return Likely(likely & possible, possible & (changed | ~known), changed & (change > SURE * CHANGE) & possible)

    return find


def _moving(feed: Footage, frames: int, fps: float) -> list[np.ndarray]:
    """[h, w] u8 of each frame: moving pixels."""
    lag = min(max(1, round(LAG * fps)), (frames - 1) // 2)
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
        moving.append(without_specks(_changed(change).astype(np.uint8), 0.05 * SMALL))
    if np.mean([m.mean() for m in moving]) > MOVES_ALL:
        raise CaptureError(f"{feed.path}: nearly everything changes, expected a camera that stands still")
    return moving


def _uncovered(feed: Footage, possible: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """[h, w, 3] f32 mean over the frames in which a pixel is away from motion; [h, w] bool: these are enough."""
    count = np.sum([~p for p in possible], 0)
    total = np.zeros((*count.shape, 3), np.float32)
    for t, p in enumerate(possible):
        total += np.where(p[..., None], 0, _small(feed.picture(t).rgb))
    known = count >= max(UNCOVERED_LEAST, UNCOVERED * len(possible))
    return total / np.maximum(count, 1)[..., None], known


def _small(rgb: np.ndarray) -> np.ndarray:
    """[h, w, 3] f32 at `SIDE`, smoothed."""
    cv2 = require("cv2", "making masks")
    scale = min(1.0, SIDE / max(rgb.shape[:2]))
    size = max(1, round(scale * rgb.shape[1])), max(1, round(scale * rgb.shape[0]))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    return cv2.GaussianBlur(small, (5, 5), 0).astype(np.float32)


def _changed(change: np.ndarray) -> np.ndarray:
    """[h, w] bool: change by more than noise, estimated by the median, since most of a picture stands still."""
    return change > np.clip(NOISE * 1.4826 * float(np.median(change)), CHANGE, LOUDEST)


def disc(radius: float) -> np.ndarray:
    """A round structuring element, radius in pixels."""
    cv2 = require("cv2", "making masks")
    r = max(1, round(radius))
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * r + 1, 2 * r + 1))


def without_specks(mask: np.ndarray, share: float) -> np.ndarray:
    """A u8 mask without parts that are smaller than a share of the picture."""
    cv2 = require("cv2", "making masks")
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    kept = stats[:, cv2.CC_STAT_AREA] >= share * mask.size
    kept[0] = False
    return kept[labels].astype(np.uint8)


def _regions(changed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Likely and possible subject, [h, w] bool, of changed pixels, u8: small gaps closed; large gaps and holes, too."""
    cv2 = require("cv2", "making masks")
    diagonal = float(np.hypot(*changed.shape))
    changed = without_specks(changed, 0.05 * SMALL)
    closed = np.pad(cv2.morphologyEx(changed, cv2.MORPH_CLOSE, disc(CLOSE * diagonal)), 1)
    outside = closed.copy()
    cv2.floodFill(outside, None, (0, 0), 1)
    filled = (closed | (1 - outside))[1:-1, 1:-1]
    opened = cv2.morphologyEx(filled, cv2.MORPH_OPEN, disc(0.5 * GROW * diagonal))
    possible = without_specks(opened, SMALL) > 0
    likely = cv2.morphologyEx(changed, cv2.MORPH_CLOSE, disc(0.3 * CLOSE * diagonal)) > 0
    return likely & possible, possible


def _unlike_background(rgb: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """[h, w] bool: colours around a pixel are more frequent in the possible subject than elsewhere."""
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

"""Masks for a capture without masks: from an empty plate of each camera, or from motion. Writes mask files, which the
reader of the layout finds and people may edit.

mask_finders.py finds pixels that may be the subject. GrabCut (Rother et al. 2004) segments the subject from these
pixels and their colours, at `SIDE` pixels; a guided filter (He et al. 2013) scales the mask to the size of the picture.
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
from .mask_finders import GROW, SMALL, Likely, disc, moving_finder, plate_finder, without_specks

ROUNDS = 3  # iterations of GrabCut
FRAMES_LEAST = 3  # frames; fewer do not show motion


def make_masks(
    capture: Capture,
    plates: Path | None = None,
    *,
    overwrite: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Writes a mask for every picture of every camera, also of frames that `capture` leaves out, in the place where its
    reader looks for it; all or none.

    Args:
        plates: folder with CAMERA.png (or another image) of each camera; None: moving pixels are the subject.
        overwrite: existing masks may be replaced.
        on_progress: called with (cameras done, all cameras).

    Returns:
        The number of files.

    Raises:
        UsageError: there are masks already.
        CaptureError: a plate is missing or does not fit, a camera moves, or there are too few frames.
    """
    _check(capture, plates, overwrite)
    find = [plate_finder(capture, i, plates) if plates else None for i in range(len(capture.cameras))]
    parts: list[tuple[Path, Path]] = []  # NAME.part and NAME

    def one(index: int) -> None:
        feed, found = capture.footage[index], 0
        likely = find[index] or moving_finder(feed, len(feed), capture.fps)
        for t in range(len(feed)):
            alpha = mask_of(feed.picture(t).rgb, likely(t))
            found += bool(alpha.any())
            path = feed.mask_files[t]
            part = path.with_name(path.name + ".part")
            parts.append((part, path))
            _write(part, alpha)
        if found < len(feed):
            name, none = capture.cameras[index].name, len(feed) - found
            warnings.warn(f"camera {name}: nothing is found in {none} of {len(feed)} frames", stacklevel=2)

    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            for done, _ in enumerate(pool.map(one, range(len(capture.cameras))), 1):
                on_progress(done, len(capture.cameras))
    except BaseException:  # all cameras have stopped
        for part, _ in parts:
            part.unlink(missing_ok=True)
        raise
    for part, path in parts:
        os.replace(part, path)
    return len(parts)


def _check(capture: Capture, plates: Path | None, overwrite: bool) -> None:
    if any(f.subject_alone and f.background is None for f in capture.footage):
        raise UsageError(f"{capture.name}: its images have an alpha channel, which is their mask; none is to be made")
    there = next((m for f in capture.footage for m in (*f.masks, *f.mask_files) if m.is_file()), None)
    if there is not None and not overwrite:
        raise UsageError(f"{there}: there are masks already; delete them, or say --overwrite to replace them")
    if capture.moves:
        raise CaptureError(f"{capture.name}: its cameras move, so that everything does; make masks with another tool")
    if plates is None and capture.frame_count < FRAMES_LEAST:
        raise CaptureError(
            f"{capture.name}: {capture.frame_count} frames, expected {FRAMES_LEAST} or more to see what moves, "
            f"or --plate DIR"
        )


def mask_of(rgb: np.ndarray, found: Likely) -> np.ndarray:
    """[H, W] u8 mask of a picture."""
    cv2 = require("cv2", "making masks")
    likely, possible, sure = found
    if not likely.any():
        return np.zeros(rgb.shape[:2], np.uint8)
    small = cv2.resize(rgb, likely.shape[::-1], interpolation=cv2.INTER_AREA)
    margin = cv2.dilate(possible.astype(np.uint8), disc(GROW * float(np.hypot(*likely.shape)))) > 0
    labels = np.where(margin, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    labels[likely] = cv2.GC_PR_FGD
    labels[sure] = cv2.GC_FGD
    if (labels == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), labels, None, *models, ROUNDS, cv2.GC_INIT_WITH_MASK)
    cut = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
    cut = without_specks(cv2.morphologyEx(cut, cv2.MORPH_OPEN, disc(1)), SMALL)
    scale = max(rgb.shape[:2]) / max(cut.shape)
    large = cv2.resize(255 * cut, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return cv2.ximgproc.guidedFilter(rgb, large, max(1, round(scale)), (0.02 * 255) ** 2)


def _write(path: Path, alpha: np.ndarray) -> None:
    cv2 = require("cv2", "making masks")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", alpha)[1].tobytes())

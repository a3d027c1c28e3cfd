"""Report on a capture, for people and scripts: its content as the reader has recognised it, the error of its
calibration, the colour differences between its cameras, and missing parts."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ..errors import require
from ..model.camera import meeting_point
from .capture import Capture
from .detect import find_capture, open_capture
from .epipolar import LEAST
from .matching import Matches, matched_features

GOOD = 0.75  # pixels, median distance from the epipolar lines; up to it, a calibration is used unchanged
SURE = 2.0  # pixels; a match closer than this to its epipolar line shows the same point
PATCH = 5  # pixels, side of the square whose mean colour is compared
DARKEST, BRIGHTEST = 10, 245  # of 255; a value outside is noise or clipped
FEW = 8  # training cameras; with fewer, the space between their views is hardly constrained


def describe_capture(path: Path, frame: int = 0) -> tuple[Capture, dict]:
    """Opens a capture and describes it.

    Args:
        frame: the frame whose pictures are compared.

    Returns:
        The capture, and its facts (JSON-able): name, path, layout, fps, frames, moves, masks (None, "background",
        "files" or "alpha"), points (number; None: there are none), depth (number of cameras with depth images),
        epipolar_error (pixels, None: too few matches), matches (number), colour_ratio (largest to smallest gain of a
        camera), left_out and missing (sentences), cameras (a dictionary each).

    Raises:
        CaptureError, UsageError: see `open_capture`.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        capture = open_capture(path)
    every = list(range(len(capture.cameras)))
    matches = matched_features(capture, frame, every) if len(every) > 1 else []
    distances = np.concatenate([np.zeros(0), *(m.distances for m in matches)])
    gains, shares, depths = _looks(capture, frame, matches)
    known = gains[np.isfinite(gains).all(1)]
    gain_of = lambda g: [round(float(x), 3) for x in np.exp(g)] if np.isfinite(g).all() else None  # noqa: E731
    looks = zip(gains, shares, depths, strict=True)
    seen = [{"gain": gain_of(g), "subject": share, "depth": depth} for g, share, depth in looks]
    facts = {
        "name": capture.name,
        "path": str(path),
        "layout": find_capture(path),
        "fps": capture.fps,
        "frames": capture.frame_count,
        "moves": capture.moves,
        "masks": _masks(capture),
        "points": None if capture.points is None else len(capture.points),
        "depth": sum(c["depth"] is not None for c in seen),
        "epipolar_error": round(float(np.median(distances)), 3) if len(distances) >= LEAST else None,
        "matches": len(distances),
        "colour_ratio": round(float(np.exp(np.ptp(known.mean(1)))), 3) if len(known) > 1 else None,
        "left_out": [str(w.message) for w in caught],
        "cameras": [_camera(capture, frame, i, matches) | looks for i, looks in enumerate(seen)],
    }
    return capture, facts | {"missing": _missing(capture, path, facts)}


def _masks(capture: Capture) -> str | None:
    if not capture.has_alpha:
        return None
    if any(f.background is not None for f in capture.footage):
        return "background"
    return "files" if any(f.masks for f in capture.footage) else "alpha"


def _camera(capture: Capture, frame: int, i: int, matches: list[Matches]) -> dict:
    c = capture.camera(i, frame)
    own = np.concatenate([np.zeros(0), *(m.distances for m in matches if i in (m.first, m.second))])
    depth = float(c.viewmat[2] @ [*meeting_point(capture.cameras), 1])
    return {
        "name": c.name,
        "split": c.split,
        "width": c.width,
        "height": c.height,
        "focal": [round(float(f), 2) for f in (c.K[0, 0], c.K[1, 1])],
        "angle": round(float(np.degrees(2 * np.arctan(c.width / (2 * c.K[0, 0])))), 1),
        "near": round(float(c.near), 4),
        "distance": round(depth, 4),
        "matches": len(own),
        "epipolar_error": round(float(np.median(own)), 3) if len(own) >= LEAST // 2 else None,
    }


def colour_gains(count: int, matches: list[Matches], colours: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """[C, 3] log gain of each camera and channel, mean 0: its brightness relative to the other cameras at matched
    points. NaN: too few matches.

    Args:
        count: number of cameras.
        colours: for each of `matches`, [M, 3] colours in the first and in the second camera, 0..255.
    """
    rows, values = [], []
    for m, (a, b) in zip(matches, colours, strict=True):
        good = (m.distances < SURE) & ((a > DARKEST) & (a < BRIGHTEST) & (b > DARKEST) & (b < BRIGHTEST)).all(1)
        if good.sum() < LEAST // 4:
            continue
        row = np.zeros(count)
        row[[m.first, m.second]] = 1, -1
        weight = np.sqrt(good.sum())
        rows.append(weight * row)
        values.append(weight * np.median(np.log(a[good] / b[good]), 0))
    gains = np.full((count, 3), np.nan)
    if rows:
        seen = np.any(rows, axis=0)
        solved = np.linalg.lstsq(np.stack(rows)[:, seen], np.stack(values), rcond=None)[0]
        gains[seen] = solved - solved.mean(0)
    return gains


def _looks(capture: Capture, frame: int, matches: list[Matches]) -> tuple[np.ndarray, list, list]:
    """`colour_gains`; for each camera the share of its picture inside its mask; and its nearest and farthest depth (1st
    and 99th percentile) and the share of pixels with a known depth. None: no mask, or no depth."""
    cv2 = require("cv2", "comparing colours")
    colours = [[np.zeros((0, 3))] * 2 for _ in matches]
    shares: list[float | None] = []
    depths: list[dict | None] = []
    for i in range(len(capture.cameras)):
        view = capture.view(i, frame)
        shares.append(None if view.alpha is None else round(float((view.alpha > 0).mean()), 4))
        depths.append(None if view.depth is None else _depth(view.depth))
        smooth = cv2.blur(view.rgb.astype(np.float32), (PATCH, PATCH))
        if view.alpha is not None:  # colours beyond the edge of the subject are undefined
            smooth[cv2.erode(view.alpha, np.ones((PATCH, PATCH), np.uint8)) < 255] = 0
        for m, pair in zip(matches, colours, strict=True):
            for side, (camera, pixels) in enumerate(((m.first, m.p), (m.second, m.q))):
                if camera == i:
                    pair[side] = _at(smooth, pixels)
    return colour_gains(len(capture.cameras), matches, [tuple(pair) for pair in colours]), shares, depths


def _depth(depth: np.ndarray) -> dict:
    """Nearest and farthest depth (1st and 99th percentile, world units) and share of the pixels with a known depth."""
    known = depth[depth > 0]
    near, far = (round(float(d), 4) for d in np.percentile(known, (1, 99))) if known.size else (None, None)
    return {"near": near, "far": far, "known": round(known.size / depth.size, 4)}


def _at(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """[M, 3] colours of an image at pixels [M, 2]."""
    x, y = np.floor(pixels).astype(int).T
    return image[y.clip(0, image.shape[0] - 1), x.clip(0, image.shape[1] - 1)]


def _missing(capture: Capture, path: Path, facts: dict) -> list[str]:
    """Missing or wrong parts of the capture and their consequences, one sentence each."""
    root, trained, out = path if path.is_dir() else path.parent, len(capture.indices("train")), []
    unmasked = [c.name for c, f in zip(capture.cameras, capture.footage, strict=True) if not f.has_alpha]
    if facts["masks"] is None:
        more = "; seg/ is not read, copy it to masks/ to train only what it marks" if (root / "seg").is_dir() else ""
        out.append(f"no masks: whole pictures are trained (gscodec masks makes some){more}")
    elif unmasked:
        out.append(f"no masks of {', '.join(unmasked)}: their whole pictures are trained")
    start = "the visual hull" if facts["masks"] else "matched features and a plane sweep"
    start = "depth images" if facts["depth"] else start
    if facts["points"] is None:
        out.append(f"no sparse points: training starts from {start}")
    if 0 < facts["depth"] < len(facts["cameras"]):
        out.append(f"depth images of {facts['depth']} of {len(facts['cameras'])} cameras only")
    empty = [c["name"] for c in facts["cameras"] if c["depth"] and not c["depth"]["known"]]
    if empty:
        out.append(f"the depth images of {', '.join(empty)} are empty: 0 says that a depth is unknown")
    if not capture.indices("test"):
        out.append("no test cameras: quality can only be measured on pictures that were trained on")
    if trained < FEW:
        count = "1 training camera: what its view does not show" if trained == 1 else None
        out.append(f"{count or f'{trained} training cameras: what lies between their views'} is hardly constrained")
    error = facts["epipolar_error"]
    if error is None and len(capture.cameras) > 1:
        out.append(f"{facts['matches']} features match between neighbours, too few to check the calibration")
    elif error is not None and error > GOOD:
        out.append(f"the calibration is {error:.2f} pixels off: training corrects the poses")
    off = [c["name"] for c in facts["cameras"] if error and (c["epipolar_error"] or 0) > max(GOOD, 2 * error)]
    if off:
        out.append(f"the calibration of {', '.join(off)} is worse than that of the others")
    return out

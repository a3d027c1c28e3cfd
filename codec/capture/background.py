"""Masks of pictures without masks but with a background of one colour, which was rendered or painted over.

Sensor noise makes neighbouring pixels differ, so a border of one colour in nearly all cameras is artificial. Pixels of
that colour are background if they are connected to the border or form a larger patch. A pixel at the rim of the subject
is a mix of that colour and of the subject's colour beside it; the share of the subject is its alpha.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import require

SAME = 1.0  # of 255: differences within a background of one colour
ALIKE, LOSSY = 8.0, 20.0  # of 255: largest difference of a background pixel; the same after lossy compression
BORDER_MIN = 0.1  # least share of a picture's border within SAME of that colour
PURE_MIN = 0.9  # the same, as a share of the border pixels within ALIKE: the others have noise
PICTURES_MIN = 0.9  # least share of the pictures with such a border
PATCH = 2e-4  # of the picture: least area of a background patch that does not touch the border
SHARE_MIN = 0.1  # alpha; below it, the subject's colour beside the pixel is the better estimate
RIM = 2  # pixels on each side, in which a pixel of the rim finds the colour of the subject


def background_of(pictures: Sequence[np.ndarray]) -> np.ndarray | None:
    """[3] f32 background colour that pictures of different cameras, [H, W, 3] u8, have in common; None: there is none,
    or the pictures show nothing else."""
    color = border_color(pictures)
    if color is None or not any((np.abs(p - color) > ALIKE).any() for p in pictures):
        return None
    return color


def border_color(pictures: Sequence[np.ndarray]) -> np.ndarray | None:
    """[3] f32 colour that the borders of pictures, [H, W, 3] u8, have in common; None: they have none."""
    borders = [np.concatenate([p[0], p[-1], p[:, 0], p[:, -1]]) for p in pictures]
    colors, counts = np.unique(np.concatenate(borders), axis=0, return_counts=True)
    color = colors[counts.argmax()].astype(np.float32)

    def plain(border: np.ndarray) -> bool:
        difference = np.abs(border - color).max(1)
        same, alike = (difference <= SAME).mean(), (difference <= ALIKE).mean()
        return bool(same >= max(BORDER_MIN, PURE_MIN * alike))

    return color if np.mean([plain(b) for b in borders]) >= PICTURES_MIN else None


def cut_out(rgb: np.ndarray, color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H, W, 3] u8, not premultiplied, and alpha [H, W] u8 of the subject before a background of `color`."""
    behind = _background(rgb, color)
    alpha, rgb = np.where(behind, 0, 255).astype(np.uint8), rgb.copy()
    rows, columns = (np.nonzero(~behind.all(axis))[0] for axis in (1, 0))
    if behind.any() and len(rows):
        box = (slice(max(rows[0] - RIM, 0), rows[-1] + 1 + RIM), slice(max(columns[0] - RIM, 0), columns[-1] + 1 + RIM))
        _unmix(rgb[box], alpha[box], color)
    return rgb, alpha


def _background(rgb: np.ndarray, color: np.ndarray) -> np.ndarray:
    """[H, W] bool: background pixels. If more of them are disturbed than lie next to the subject, compression was
    lossy; then a wider margin applies."""
    cv2 = require("cv2", "masks from the background")
    behind = _patches(rgb, color, ALIKE)
    disturbed = behind & (cv2.inRange(rgb, *_around(color, SAME)) == 0)
    rim = behind & (cv2.dilate((~behind).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    return behind if np.count_nonzero(disturbed) <= np.count_nonzero(rim) else _patches(rgb, color, LOSSY)


def _patches(rgb: np.ndarray, color: np.ndarray, most: float) -> np.ndarray:
    """[H, W] bool: patches that differ by `most` from the colour, and touch the border or are large."""
    cv2 = require("cv2", "masks from the background")
    _, labels, stats, _ = cv2.connectedComponentsWithStats(cv2.inRange(rgb, *_around(color, most)), connectivity=4)
    chosen = stats[:, cv2.CC_STAT_AREA] >= PATCH * labels.size
    chosen[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    chosen[0] = False  # pixels unlike the background
    return chosen[labels]


def _around(color: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest colour that differ by `most`."""
    return np.clip(np.rint(color - most), 0, 255), np.clip(np.rint(color + most), 0, 255)


def _unmix(rgb: np.ndarray, alpha: np.ndarray, color: np.ndarray) -> None:
    """Alpha and colour of the pixels next to the background, in place."""
    cv2 = require("cv2", "masks from the background")
    inner = cv2.erode(alpha, np.ones((3, 3), np.uint8), borderValue=255)
    y, x = np.nonzero(alpha != inner)
    side = 2 * RIM + 1
    weight = cv2.blur((inner > 0).astype(np.float32), (side, side))[y, x, None]
    near = cv2.blur(np.where(inner[..., None] > 0, rgb, 0).astype(np.float32), (side, side))[y, x]
    near = np.where(weight > 1e-4, near / np.maximum(weight, 1e-4), rgb[y, x])  # thin parts have no inner pixels
    mixed, whole = rgb[y, x] - color, near - color
    share = np.clip((mixed * whole).sum(1) / np.maximum((whole * whole).sum(1), 1), 0, 1)
    alpha[y, x] = np.rint(255 * share)
    share = share[:, None]
    rgb[y, x] = np.rint(np.where(share < SHARE_MIN, near, color + mixed / np.maximum(share, SHARE_MIN)).clip(0, 255))

"""Contact sheet of a capture: the picture of each camera at one frame, and the rig from above and from the side.

Masks are shown as they will be used: pixels outside are dark, and the border is drawn. Depth images are shown below the
pictures, near is bright, on one scale for all cameras; black is unknown. Training cameras are blue, test cameras
orange. The sparse points of the capture are drawn into the rig.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import require
from ..model.camera import Camera, meeting_point
from .capture import Capture
from .images import View

WIDTH, PANEL, LINE, GAP = 1600, 620, 18, 6  # pixels
THUMBNAIL = 400  # pixels, largest width
PAPER, INK, FAINT = (250, 250, 248), (40, 40, 40), (205, 205, 205)
COLOURS = {"train": (46, 98, 180), "test": (222, 120, 20), "val": (120, 120, 120)}
BORDER = (235, 30, 120)
FRUSTUM = 0.22  # length of a drawn frustum over the median distance of the cameras from the scene
PATH_FRAMES = 60  # drawn positions of a moving camera, at most
POINTS = 20_000  # drawn points, at most


def contact_sheet(capture: Capture, frame: int = 0) -> np.ndarray:
    """[H, WIDTH, 3] u8 RGB.

    Raises:
        CaptureError: a picture cannot be read.
    """
    cameras = [capture.camera(i, frame) for i in range(len(capture.cameras))]
    aspect = max(c.height / c.width for c in cameras)
    columns = _columns(len(cameras), 2 * aspect if capture.has_depth else aspect)
    width = min((WIDTH - GAP) // columns - GAP, THUMBNAIL)
    height = round(width * aspect)
    shown = [_thumbnail(capture.view(i, frame), width, height) for i in range(len(cameras))]
    shown = _with_depth(shown)
    tallest = max(len(picture) for picture in shown)
    rows = -(-len(cameras) // columns)
    top = GAP + rows * (tallest + LINE + GAP)
    sheet = np.full((top + PANEL + GAP, WIDTH, 3), PAPER, np.uint8)
    for i, (camera, picture) in enumerate(zip(cameras, shown, strict=True)):
        x, y = GAP + i % columns * (width + GAP), GAP + i // columns * (tallest + LINE + GAP)
        sheet[y + LINE : y + LINE + picture.shape[0], x : x + picture.shape[1]] = picture
        _text(sheet, f"{camera.name}  {camera.width}x{camera.height}", (x, y + 13), COLOURS[camera.split])
    half = (WIDTH - 3 * GAP) // 2
    rig = _Rig.of(capture, cameras)
    scale = min(rig.scale(view, half) for view in rig.views())
    for k, view in enumerate(rig.views()):
        x = GAP + k * (half + GAP)
        sheet[top : top + PANEL, x : x + half] = _panel(capture, rig, view, half, scale)
    return sheet


def _columns(count: int, aspect: float) -> int:
    """Columns of thumbnails: enough that each is `THUMBNAIL` wide at most, and up to about 40 cameras fill a screen."""
    least = -(-WIDTH // (THUMBNAIL + GAP))
    wanted = round(np.sqrt(count * aspect * WIDTH / 1000))
    return int(max(min(count, least), min(wanted, count), 1))


Thumbnail = tuple[np.ndarray, np.ndarray | None]  # picture [h, w, 3] u8, depth [h, w] f32 or None


def _with_depth(shown: list[Thumbnail]) -> list[np.ndarray]:
    """The pictures, each with its depth image below: inverse depth in grey, on one scale for all."""
    known = [depth[depth > 0] for _, depth in shown if depth is not None]
    known = np.concatenate([*known, np.ones(1 if not sum(map(len, known)) else 0)])
    far, near = np.percentile(1 / known, (1, 99))
    out = []
    for picture, depth in shown:
        if depth is None:
            out.append(picture)
            continue
        share = (1 / np.where(depth > 0, depth, 1) - far) / max(near - far, 1e-12)
        grey = np.where(depth > 0, 40 + 215 * share.clip(0, 1), 0).astype(np.uint8)
        out.append(np.concatenate([picture, np.repeat(grey[..., None], 3, 2)]))
    return out


def _thumbnail(view: View, width: int, height: int) -> Thumbnail:
    cv2 = require("cv2", "drawing contact sheets")
    scale = min(width / view.rgb.shape[1], height / view.rgb.shape[0])
    size = max(1, int(scale * view.rgb.shape[1])), max(1, int(scale * view.rgb.shape[0]))
    picture = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA)
    depth = None if view.depth is None else cv2.resize(view.depth, size, interpolation=cv2.INTER_NEAREST)
    if view.alpha is None:
        return picture, depth
    alpha = cv2.resize(view.alpha, size, interpolation=cv2.INTER_AREA)
    share = (alpha / 255)[..., None]
    picture = np.rint(picture * share + (0.35 * picture + 20) * (1 - share)).astype(np.uint8)
    lines, _ = cv2.findContours((alpha > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(picture, lines, -1, BORDER, 1), depth


@dataclass(frozen=True)
class _Projection:
    """A parallel projection. `axes`: [2, 3], right and up on the sheet; `title`: the viewpoint in words."""

    title: str
    axes: np.ndarray


@dataclass(frozen=True)
class _Rig:
    """The drawn parts of a rig, in the world.

    Attributes:
        middle: [3], where the optical axes meet.
        frusta: for each camera [5, 3], its position and the corners of its image.
        paths: for each camera [F, 3], its positions over the frames.
    """

    cameras: list[Camera]
    middle: np.ndarray
    frusta: list[np.ndarray]
    paths: list[np.ndarray]

    @staticmethod
    def of(capture: Capture, cameras: list[Camera]) -> _Rig:
        middle = meeting_point(cameras)
        length = FRUSTUM * float(np.median([np.linalg.norm(c.center - middle) for c in cameras]))
        paths = [_path(capture, i) for i in range(len(cameras))]
        return _Rig(cameras, middle, [_frustum(c, length) for c in cameras], paths)

    def views(self) -> list[_Projection]:
        """From above, and from the side where the rig extends most."""
        up = -np.mean([c.viewmat[1, :3] for c in self.cameras], axis=0)
        up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.1 else np.array([0, 0, 1.0])
        rays = np.stack([c.center for c in self.cameras]) - self.middle
        right = np.linalg.svd(rays - np.outer(rays @ up, up), full_matrices=False)[2][0]
        right = right - (right @ up) * up
        if np.linalg.norm(right) < 1e-6:  # e.g. a single camera that looks down
            right = np.cross(up, np.roll(up, 1))
        right /= np.linalg.norm(right)
        above = _Projection("from above", np.stack([right, np.cross(up, right)]))
        return [above, _Projection("from the side", np.stack([right, up]))]

    def box(self, view: _Projection) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest coordinates on the sheet, [2] each, world units."""
        flat = np.concatenate([self.middle[None], *self.frusta, *self.paths]) @ view.axes.T
        return flat.min(0), flat.max(0)

    def scale(self, view: _Projection, width: int) -> float:
        """Pixels per world unit with which the rig fits a panel."""
        low, high = self.box(view)
        return 0.86 * float((np.array([width, PANEL]) / np.maximum(high - low, 1e-9)).min())


def _panel(capture: Capture, rig: _Rig, view: _Projection, width: int, scale: float) -> np.ndarray:
    cv2 = require("cv2", "drawing contact sheets")
    panel = np.full((PANEL, width, 3), 255, np.uint8)
    offset = np.array([width / 2, PANEL / 2]) - scale * np.array([1, -1]) * np.add(*rig.box(view)) / 2

    def at(points: np.ndarray) -> np.ndarray:
        """[N, 2] pixels of the panel, int32."""
        return np.rint(points @ view.axes.T * [scale, -scale] + offset).clip(-9999, 9999).astype(np.int32)

    if capture.points is not None:
        chosen = np.random.default_rng(0).permutation(len(capture.points))[:POINTS]
        x, y = at(capture.points.means[chosen]).T
        on = (x >= 0) & (y >= 0) & (x < width) & (y < PANEL)
        panel[y[on], x[on]] = capture.points.colors[chosen][on]
    cv2.drawMarker(panel, at(rig.middle[None])[0].tolist(), INK, cv2.MARKER_CROSS, 14, 1, cv2.LINE_AA)
    for camera, corners, path in zip(rig.cameras, rig.frusta, rig.paths, strict=True):
        colour = COLOURS[camera.split]
        cv2.polylines(panel, [at(path)], False, FAINT, 1, cv2.LINE_AA)
        apex, *rim = at(corners).tolist()
        cv2.polylines(panel, [np.array(rim)], True, colour, 1, cv2.LINE_AA)
        for corner in rim:
            cv2.line(panel, apex, corner, colour, 1, cv2.LINE_AA)
        cv2.circle(panel, apex, 3, colour, -1, cv2.LINE_AA)
        _text(panel, camera.name, (apex[0] + 5, apex[1] - 5), colour, 0.36)
    _scale_bar(panel, scale)
    _text(panel, view.title, (10, 20), INK, 0.5)
    return panel


def _path(capture: Capture, index: int) -> np.ndarray:
    """[F, 3] positions of a camera over the frames, a single one where it stands still."""
    if capture.poses is None:
        return capture.cameras[index].center[None]
    frames = np.linspace(0, capture.frame_count - 1, min(capture.frame_count, PATH_FRAMES)).astype(int)
    return np.stack([capture.camera(index, t).center for t in frames.tolist()])


def _frustum(camera: Camera, length: float) -> np.ndarray:
    """[5, 3] the camera's position and the corners of its image at depth `length`."""
    w, h = camera.width, camera.height
    rays = np.array([(0, 0, 1), (w, 0, 1), (w, h, 1), (0, h, 1)]) @ np.linalg.inv(camera.K).T
    corners = (length * rays - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    return np.concatenate([camera.center[None], corners])


def _scale_bar(panel: np.ndarray, scale: float) -> None:
    """A round length in world units, about a fifth of the panel."""
    cv2 = require("cv2", "drawing contact sheets")
    wanted = panel.shape[1] / 5 / scale
    power = 10.0 ** np.floor(np.log10(wanted))
    unit = max(m * power for m in (1, 2, 5) if m * power <= wanted)
    y, x = panel.shape[0] - 14, 12
    cv2.line(panel, (x, y), (x + round(unit * scale), y), INK, 2, cv2.LINE_AA)
    _text(panel, f"{unit:g} in world units", (x, y - 7), INK, 0.42)


def _text(image: np.ndarray, text: str, at: tuple[int, int], colour: tuple, size: float = 0.42) -> None:
    cv2 = require("cv2", "drawing contact sheets")
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)

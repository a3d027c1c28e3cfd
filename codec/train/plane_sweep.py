"""Initial points of a keyframe without masks: depth by plane sweep, kept where views agree.

In: views of one frame. Out: points and colours. Each view is compared with its neighbours over planes parallel to its
image (Collins 1996) by normalised cross-correlation in small windows, so that exposure does not matter. The score is
the mean of the better half of the neighbours, because the others may not see the surface (Kang et al. 2001). Between
planes the depth is at the vertex of a parabola through three scores. It is kept where the correlation is high and
another depth map agrees.

Two views that look from directions far apart see a surface at such different slants that windows parallel to one image
never match. A view without near neighbours is compared with the nearest views over planes of several directions (Gallup
et al. 2007): level planes (floor, table) and upright planes. A depth is kept if no other depth matches as well. Tiny
pictures and pictures with little texture are left out, since the points found would leave the rest bare.
"""

from __future__ import annotations

import numpy as np

from ..model.camera import working_distance
from .settings import PlaneSweepSettings
from .visual_hull import project


def sweep(
    views, count: int, seed: int, settings: PlaneSweepSettings, masks: list[np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Points on the surfaces that several views see.

    Args:
        views: (camera, rgb u8 [H, W, 3], alpha or None) of each training camera.
        count: bound on the number of points.
        masks: [H, W] bool of each view, at any size: pixels whose depth is searched; None: all.

    Returns:
        points [P, 3], colours [P, 3] in 0..1. P is 0 where no two views agree anywhere.
    """
    import cv2

    cameras, images, where = [], [], []
    for i, (camera, rgb, _) in enumerate(views):
        scale = min(1.0, settings.width / camera.width)
        size = (round(scale * camera.width), round(scale * camera.height))
        cameras.append(camera.resized(*size))
        images.append(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
        mask = np.ones((1, 1), np.uint8) if masks is None else masks[i].astype(np.uint8)
        where.append(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0)
    greys = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY).astype(np.float32) for p in images]
    distance = working_distance(cameras)
    inverse = np.linspace(1 / (settings.far * distance), 1 / (settings.near * distance), settings.planes)
    near, depths = [], []
    for i, camera in enumerate(cameras):
        s, neighbours, normals = settings, _neighbours(cameras, i, settings), [camera.viewmat[2, :3]]
        if len(neighbours) < s.scored_neighbours and _textured(greys[i], s):
            s = s.of_lone_view()
            neighbours = _neighbours(cameras, i, s)
            normals += world_normals(cameras, s.upright_planes)
        near.append(neighbours)
        depths.append(_depth(cameras, greys, where[i], i, neighbours, normals, inverse, s))
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for i, camera in enumerate(cameras):
        y, x = np.nonzero(depths[i])
        found = unproject(camera, x, y, depths[i][y, x])
        sure = np.any(
            [_agree(found, cameras[j], depths[j], settings.depth_tolerance) for j in near[i]]
            or [np.zeros(len(found), bool)],
            axis=0,
        )
        points.append(found[sure])
        colors.append(images[i][y, x][sure] / 255)
    points, colors = np.concatenate(points), np.concatenate(colors)
    chosen = np.random.default_rng(seed).permutation(len(points))[:count]
    return points[chosen], colors[chosen]


def _neighbours(cameras, i: int, settings: PlaneSweepSettings) -> list[int]:
    """Indices of the nearest cameras that look in about the same direction as camera `i`."""
    axis = [c.viewmat[2, :3] for c in cameras]
    away = [np.linalg.norm(c.center - cameras[i].center) for c in cameras]
    order = [j for j in np.argsort(away) if j != i and axis[j] @ axis[i] > settings.axis_cosine_min]
    return order[: settings.neighbours]


def _textured(grey: np.ndarray, settings: PlaneSweepSettings) -> bool:
    """Whether most of a picture has texture, so that the points of a sweep cover it. False for tiny pictures, in which
    a window covers most of the image."""
    if min(grey.shape) < settings.sides_min * settings.window:
        return False
    return float(np.mean(_windows(grey, settings.window)[1] >= settings.contrast_min)) > 0.5


def world_normals(cameras, upright: int) -> list[np.ndarray]:
    """Unit normals of level planes and of `upright` upright planes, evenly around; up is that of the mean image."""
    up = -np.mean([c.viewmat[1, :3] for c in cameras], axis=0)
    up /= max(np.linalg.norm(up), 1e-9)
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= max(np.linalg.norm(side), 1e-9)
    angles = np.pi * np.arange(upright) / max(upright, 1)
    return [up, *(np.cos(a) * side + np.sin(a) * np.cross(up, side) for a in angles)]


def _facing(camera, normals: list[np.ndarray]) -> list[np.ndarray]:
    """Both directions [3] of each normal, in the camera's axes."""
    return [side * (camera.viewmat[:3, :3] @ n) for n in normals for side in (1, -1)]


def unproject(camera, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Points [N, 3] of pixels at a depth."""
    rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1) @ np.linalg.inv(camera.K).T
    return (rays * depth[:, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


def _agree(points: np.ndarray, camera, depths: np.ndarray, tolerance: float) -> np.ndarray:
    """[N] bool: the depth map of `camera` has a surface at the point."""
    p, depth = project(camera, points)
    x, y = np.floor(p).astype(np.int64).T
    on = (depth > 0) & (x >= 0) & (y >= 0) & (x < depths.shape[1]) & (y < depths.shape[0])
    there = depths[y.clip(0, depths.shape[0] - 1), x.clip(0, depths.shape[1] - 1)]
    return on & (there > 0) & (np.abs(there - depth) < tolerance * depth)


def _ray_map(camera, other, plane: np.ndarray) -> np.ndarray:
    """[3, 3], maps rays of `camera` to those of `other` through the plane n . x = 1 in the axes of `camera`."""
    R = other.viewmat[:3, :3] @ camera.viewmat[:3, :3].T
    return R + np.outer(other.viewmat[:3, 3] - R @ camera.viewmat[:3, 3], plane)


def _homography(camera, other, ray_map: np.ndarray) -> np.ndarray:
    """Homography [3, 3] from `camera` to `other`, on OpenCV's pixel grids (centres at whole numbers)."""
    H = other.K @ ray_map @ np.linalg.inv(camera.K)
    centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.linalg.inv(centre) @ H @ centre


def _windows(grey: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the window around each pixel."""
    import cv2

    mean = cv2.blur(grey, (side, side))
    return mean, np.sqrt(np.maximum(cv2.blur(grey * grey, (side, side)) - mean * mean, 1e-6))


class _Best:
    """The best score of each pixel over planes, [H, W], and the inverse depth there; `second` is the best score at
    another depth.

    Planes come in order of their distance, so that the scores on both sides of the best one are known.
    """

    def __init__(self, shape: tuple[int, int], other_depth: float):
        self.score, self.second, self._before, self._behind = (np.full(shape, -1, np.float32) for _ in range(4))
        self._at, self._step = (np.zeros(shape, np.float32) for _ in range(2))
        self._other = other_depth
        self.start()

    def start(self) -> None:
        """Starts a new sequence of planes: the next plane is not beside the last one."""
        self._last, self._better = np.float32(-1), None

    def add(self, score: np.ndarray, inverse_depth: np.ndarray, step: np.ndarray) -> None:
        """Adds the scores of the next plane, its inverse depth, and its step from that of the plane before; [H, W]."""
        if self._better is not None:
            self._behind[self._better] = score[self._better]
        better = score > self.score
        other = np.abs(inverse_depth - self._at) > self._other * self._at
        self.second = np.maximum(self.second, np.where(other, np.minimum(score, self.score), -1))
        before = np.broadcast_to(self._last, score.shape)
        new = ((self.score, score), (self._before, before), (self._at, inverse_depth), (self._step, step))
        for own, values in new:
            own[better] = values[better]
        self._behind[better] = -1
        self._last, self._better = score, better

    def depth(self) -> np.ndarray:
        """[H, W] depth at the vertex of the parabola through the best score and its two neighbours; infinite where no
        plane has a score."""
        bend = self._before - 2 * self.score + self._behind
        known = (self._before > -1) & (self._behind > -1) & (bend < 0)
        vertex = np.where(known, 0.5 * (self._before - self._behind) / np.where(known, bend, -1), 0)
        with np.errstate(divide="ignore"):
            return 1 / (self._at + vertex.clip(-0.5, 0.5) * self._step)


class _Part:
    """The part of a view whose depth is searched.

    Attributes:
        camera, grey: of this part.
        deviation: [H, W], standard deviation in the window around each pixel.
        rays: [H, W, 3], at unit depth.
    """

    def __init__(self, camera, grey: np.ndarray, settings: PlaneSweepSettings):
        self.camera, self.grey, self._settings = camera, grey, settings
        self._mean, self.deviation = _windows(grey, settings.window)
        y, x = np.mgrid[: grey.shape[0], : grey.shape[1]] + 0.5
        self.rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.K).T
        self._slant = settings.slant_cosine_min * np.linalg.norm(self.rays, axis=2)

    def depth(self, neighbours: list[tuple], directions: list[np.ndarray], inverse: np.ndarray) -> np.ndarray:
        """[H, W] depth, 0 where unknown.

        Args:
            neighbours: (camera, grey) of each neighbour.
            directions: normals [3] of the planes in the axes of the camera.
            inverse: [P], 1 / distance of the planes of each direction.
        """
        s, best = self._settings, _Best(self.grey.shape, self._settings.other_depth)
        for direction in directions:
            best.start()
            along = self.rays @ direction
            for d in inverse:
                faces = (along > self._slant) & (d * along * self.camera.near < 1)
                if np.count_nonzero(faces) >= s.window**2:
                    scores = np.stack([self._correlation(*n, d * direction, faces) for n in neighbours])
                    score = np.sort(scores, 0)[-s.scored_neighbours :].mean(0)
                    best.add(score, d * along, (inverse[1] - inverse[0]) * along)
        depth = best.depth()
        unsure = (best.score < s.correlation_min) | (best.score - best.second < s.unique_min)
        depth[unsure | (self.deviation < s.contrast_min)] = 0
        return depth

    def _correlation(self, other, grey: np.ndarray, plane: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """[H, W], correlation with the picture `grey` of the camera `other` through a plane n . x = 1; -1 where `other`
        does not see the plane."""
        import cv2

        ray_map, size = _ray_map(self.camera, other, plane), (self._settings.window, self._settings.window)
        H, flags = _homography(self.camera, other, ray_map), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        seen = cv2.warpPerspective(grey, H, self.grey.shape[::-1], flags=flags, borderValue=-1)
        inside = (seen >= 0) & faces & (self.rays @ ray_map[2] > 0)
        if not inside.any():
            return np.full(self.grey.shape, -1, np.float32)
        mean, deviation = _windows(seen, self._settings.window)
        score = cv2.blur(self.grey * seen, size) - self._mean * mean
        score /= self.deviation * np.maximum(deviation, self._settings.contrast_min)
        score[~inside] = -1
        return score


def _depth(
    cameras, greys, where: np.ndarray, i: int, near: list[int], normals: list[np.ndarray], inverse: np.ndarray, settings
) -> np.ndarray:
    """Depth of view `i` on the pixels `where` [H, W] bool, 0 where it is unknown, by its neighbours `near` over planes
    of the `normals` at 1 / `inverse`."""
    whole = np.zeros(greys[i].shape, np.float32)
    rows, cols = np.flatnonzero(where.any(1)), np.flatnonzero(where.any(0))
    if not near or not len(rows):
        return whole
    top, bottom, left, right = rows[0], rows[-1] + 1, cols[0], cols[-1] + 1
    box = (slice(top, bottom), slice(left, right))
    part = _Part(cameras[i].cropped(left, top, right - left, bottom - top), greys[i][box], settings)
    depth = part.depth([(cameras[j], greys[j]) for j in near], _facing(part.camera, normals), inverse)
    whole[box] = np.where(where[box], depth, 0)
    return whole

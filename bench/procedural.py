"""Small captures with exact ground truth: balls and boxes that move, traced ray by ray, without Gaussians.

A `Scene` has the shapes and the light of each frame, and the errors and the motion of its cameras. `Scene.capture`
makes it a Capture whose images are traced on demand, `write_transforms` writes a capture to files. Metres, z upwards,
the subject about 1.3 m tall around the origin.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from gscodec.capture import Capture, View
from gscodec.capture.background import background_of, cut_out
from gscodec.model.camera import PIXEL_LOW_PASS, Camera, look_at

SAMPLES = 3  # rays along each side of a pixel
FOCAL = 1.9  # image widths
DISTANCE = 3.0
HEIGHTS = (-0.3, 0.5, 1.3)  # of the rings of cameras, metres
AMBIENT = 0.45
OPENGL = np.diag([1.0, -1, -1, 1])  # OpenCV camera axes -> OpenGL's
WAVES = 3  # sines in the motion of a handheld camera
PERIODS = (7.0, 30.0)  # frames, of these sines
ROLL = 20  # frames, the period of the rolling exposure
BACKDROP = 0.35  # grey behind the subject, if masks have errors
EXPOSURES = 5  # moments that are averaged while the shutter is open


@dataclass(frozen=True)
class Shape:
    """A unit ball or a cube of side 2 under x -> A x + b; a pattern of waves varies its colour.

    Attributes:
        ball: a ball, else a box.
        A: [3, 3], with b local to world.
        b: [3].
        color: [3] 0..1.
        pattern: amplitude of the texture, 0 for none.
    """

    ball: bool
    A: np.ndarray
    b: np.ndarray
    color: Sequence[float]
    pattern: float = 0.6


@dataclass(frozen=True)
class Light:
    """Parallel light from `direction` (any length) and ambient light, both of `color`."""

    direction: Sequence[float] = (0.5, -0.6, 0.8)
    color: Sequence[float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Scene:
    """One capture.

    Attributes:
        shapes: frame, or moment between two frames -> the shapes.
        light: frame -> the light.
        exposure: range (lowest, highest) of the gains of the training cameras.
        rolling: amplitude of a gain of each training camera that oscillates over `ROLL` frames, each by its own phase.
        shutter: share of a frame's time for which the shutter is open: moving shapes are blurred.
        pose_noise: degrees and metres by which the calibration of each training camera is wrong.
        handheld: degrees and metres (root mean square) by which each camera shakes, independently of the others.
        orbit: degrees per frame by which all cameras go around the subject.
        masks: the views have alpha. False: a background of one colour is cut out, as from files.
        noise: standard deviation of the noise of the sensor, over a black level of three times that; 0: no noise.
        mask_errors: share of the training cameras' masks with a missing disc, and share with an extra disc; all masks
            are grown or shrunk by up to a pixel, before a grey background.
        depth_noise: standard deviation of the noise of the depth images, a share of the depth; None: no depth images.
    """

    shapes: Callable[[float], list[Shape]]
    light: Callable[[float], Light] = lambda t: Light()
    frames: int = 30
    train: int = 12
    test: int = 2
    size: int = 128
    exposure: tuple[float, float] = (1.0, 1.0)
    rolling: float = 0.0
    shutter: float = 0.0
    pose_noise: tuple[float, float] = (0.0, 0.0)
    handheld: tuple[float, float] = (0.0, 0.0)
    orbit: float = 0.0
    masks: bool = True
    noise: float = 0.0
    mask_errors: float = 0.0
    depth_noise: float | None = None

    def capture(self, name: str) -> Capture:
        """The capture of the scene by its cameras."""
        rig = _rig(self.train, self.test, self.size)
        rng = np.random.default_rng(0)
        wrong = [_error(*self.pose_noise, rng) if c.split == "train" else np.eye(4) for c in rig]
        gains = np.where([c.split == "train" for c in rig], rng.uniform(*self.exposure, len(rig)), 1)
        shaken = [_shake(*self.handheld, np.random.default_rng([1, i])) for i in range(len(rig))]
        phases = np.random.default_rng(2).uniform(0, 2 * np.pi, len(rig))

        @cache
        def true(camera: int, frame: int) -> Camera:
            around = np.eye(4)
            around[:3, :3] = rotation((0, 0, 1), np.radians(self.orbit * frame))
            return replace(rig[camera], viewmat=shaken[camera](frame) @ rig[camera].viewmat @ around)

        def told(camera: int, frame: int) -> Camera:
            there = true(camera, frame)
            return replace(there, viewmat=wrong[camera] @ there.viewmat)

        def gain(camera: int, frame: int) -> float:
            rolled = self.rolling * np.sin(2 * np.pi * frame / ROLL + phases[camera])
            return gains[camera] * (1 + rolled if rig[camera].split == "train" else 1)

        @cache
        def read(camera: int, frame: int) -> View:
            rgba, depth = self._exposed(true(camera, frame), frame)
            rgb, alpha = rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6), rgba[..., 3]
            seed = np.random.default_rng([2, camera, frame])
            depth = None if self.depth_noise is None else _sensed(depth, self.depth_noise, seed)
            if not self.masks:
                seen = gain(camera, frame) * rgba[..., :3]
                if self.noise:
                    seen = seen + seed.normal(3 * self.noise, self.noise, seen.shape)
                return View(_u8(seen), depth=depth)
            if self.mask_errors and rig[camera].split == "train":
                rgb = rgba[..., :3] + BACKDROP * (1 - alpha[..., None])
                alpha = _wrong(alpha, self.mask_errors, seed)
            return View(_u8(gain(camera, frame) * rgb), _u8(alpha), depth)

        poses = told if self.orbit or any(self.handheld) else None
        cameras = [told(i, 0) for i in range(len(rig))]
        has_depth = self.depth_noise is not None
        capture = Capture(name, 25.0, cameras, self.frames, self.masks, read, has_depth=has_depth, poses=poses)
        return capture if self.masks else before_background(capture)

    def _exposed(self, camera: Camera, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """[H, W, 4] f32, premultiplied, the mean over the time for which the shutter is open, and the depth [H, W] in
        the middle of that time."""
        count = EXPOSURES if self.shutter else 1
        times = frame + self.shutter * (np.arange(count) - (count - 1) / 2) / count
        traced = [trace(self.shapes(t), self.light(t), camera) for t in times]
        return np.mean([rgba for rgba, _ in traced], 0), traced[count // 2][1]


def _wrong(alpha: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """A mask with errors of masking tools: a shifted rim, and, each at random, a missing disc and an extra disc."""
    import cv2

    size = int(rng.integers(-1, 2))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(size) + 1,) * 2)
    out = (cv2.dilate if size > 0 else cv2.erode)(alpha, kernel)
    inside, rim = alpha > 0.5, (cv2.dilate(alpha, np.ones((15, 15))) > 0.5) & (alpha < 0.5)
    for where, value in ((inside, 0.0), (rim, 1.0)):
        radius, wrong = rng.uniform(0.06, 0.12) * len(alpha), rng.random() < share
        if wrong and where.any():
            y, x = rng.choice(np.argwhere(where)).tolist()
            cv2.circle(out, (x, y), round(radius), value, -1)
    return out


def before_background(capture: Capture) -> Capture:
    """A capture without masks, whose background is cut out if it has one colour."""
    color = background_of([capture.view(i, 0).rgb for i in range(len(capture.cameras))])
    if color is None:
        return capture

    @cache
    def read(camera: int, frame: int) -> View:
        view = capture.read(camera, frame)
        rgb, alpha = cut_out(view.rgb, color)
        return replace(view, rgb=rgb, alpha=alpha)

    return replace(capture, has_alpha=True, read=read)


def write_transforms(capture: Capture, folder: Path) -> None:
    """Writes a capture as transforms.json and PNG files, depth in millimetres, with the pose and the intrinsics of each
    frame."""
    import cv2

    entries = []
    for i, reference in enumerate(capture.cameras):
        for t in range(capture.frame_count):
            view, camera, name = capture.view(i, t), capture.camera(i, t), f"{reference.name}_{t}.png"
            rgb = view.rgb[..., ::-1]
            cv2.imwrite(str(folder / name), rgb if view.alpha is None else np.dstack([rgb, view.alpha]))
            (fl_x, _, cx), (_, fl_y, cy) = camera.K[:2].tolist()
            entry = {"file_path": name, "camera": camera.name, "frame": t, "split": camera.split}
            entry |= {"w": camera.width, "h": camera.height, "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}
            if view.depth is not None:
                entry["depth_file_path"] = f"depth_{name}"
                cv2.imwrite(str(folder / entry["depth_file_path"]), np.rint(1000 * view.depth).astype(np.uint16))
            pose = np.linalg.inv(camera.viewmat) @ OPENGL
            entries.append(entry | {"transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"fps": capture.fps, "frames": entries}))


def _u8(x: np.ndarray) -> np.ndarray:
    return np.rint(255 * x.clip(0, 1)).astype(np.uint8)


def _sensed(depth: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """A depth image as a sensor gives it: noise that grows with the depth, in steps of a millimetre."""
    noisy = depth * (1 + noise * rng.standard_normal(depth.shape))
    return (np.rint(1000 * noisy) / 1000).astype(np.float32)


def _rig(train: int, test: int, size: int) -> list[Camera]:
    """Training cameras on three rings, test cameras between them."""
    K = np.array([[FOCAL * size, 0, size / 2], [0, FOCAL * size, size / 2], [0, 0, 1]])

    def camera(name: str, angle: float, z: float, split: str) -> Camera:
        across = np.sqrt(DISTANCE**2 - z**2)
        eye = np.array([across * np.cos(angle), across * np.sin(angle), z])
        viewmat = look_at(eye, np.zeros(3), (0, 0, 1))
        return Camera(name, K, viewmat, size, size, split=split, low_pass=PIXEL_LOW_PASS)

    turn = 2 * np.pi / train
    cameras = [camera(f"cam{i:02}", i * turn, HEIGHTS[i % len(HEIGHTS)], "train") for i in range(train)]
    for i in range(test):
        angle = (0.5 + i * train / test) * turn
        cameras.append(camera(f"test{i}", angle, 0.2 + 0.4 * i, "test"))
    return cameras


def _error(degrees: float, metres: float, rng: np.random.Generator) -> np.ndarray:
    """[4, 4]: a rotation and a translation of these sizes, in random directions, in the camera's axes."""
    axis, shift = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    wrong = np.eye(4)
    wrong[:3, :3] = rotation(axis, np.radians(degrees))
    wrong[:3, 3] = metres * shift
    return wrong


def _shake(degrees: float, metres: float, rng: np.random.Generator) -> Callable[[int], np.ndarray]:
    """The motion of a handheld camera: frame -> [4, 4], smooth, in the camera's axes; of these sizes on average (root
    mean square)."""
    period = rng.uniform(*PERIODS, (6, WAVES))
    phase = rng.uniform(0, 2 * np.pi, (6, WAVES))

    def at(frame: int) -> np.ndarray:
        waves = np.sin(2 * np.pi * frame / period + phase).sum(1) / np.sqrt(1.5 * WAVES)  # [6], each of power 1/3
        angle = np.linalg.norm(waves[:3])
        moved = np.eye(4)
        moved[:3, :3] = rotation(waves[:3] / max(angle, 1e-9), np.radians(degrees) * angle)
        moved[:3, 3] = metres * waves[3:]
        return moved

    return at


def rotation(axis: Sequence[float], angle: float) -> np.ndarray:
    """[3, 3] about a unit `axis`, radians (Rodrigues)."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def trace(shapes: Sequence[Shape], light: Light, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The view of a camera: [H, W, 4] f32, premultiplied, 0..1, the mean of `SAMPLES`^2 rays per pixel; and [H, W] f32
    depth along the optical axis of the middle ray, 0 where nothing is there."""
    w, h, R = camera.width, camera.height, camera.viewmat[:3, :3].astype(np.float32)
    x = ((np.arange(SAMPLES * w) + 0.5) / SAMPLES - camera.K[0, 2]) / camera.K[0, 0]
    y = ((np.arange(SAMPLES * h) + 0.5) / SAMPLES - camera.K[1, 2]) / camera.K[1, 1]
    rays = x[:, None].astype(np.float32) * R[0] + (y[:, None].astype(np.float32) * R[1] + R[2])[:, None]
    rays = rays.reshape(-1, 3)  # [P, 3], of depth 1
    squares = np.einsum("ij,ij->i", rays, rays)
    nearest = np.full(len(rays), np.inf, np.float32)
    out = np.zeros((len(rays), 4), np.float32)
    for shape in shapes:
        index, depth, color = _intersect(shape, light, camera.center, rays, squares)
        closer = depth < nearest[index]
        index = index[closer]
        nearest[index] = depth[closer]
        out[index, :3], out[index, 3] = color[closer], 1
    middle = nearest.reshape(h, SAMPLES, w, SAMPLES)[:, SAMPLES // 2, :, SAMPLES // 2]
    depth = np.where(np.isfinite(middle), middle, 0).astype(np.float32)
    return out.reshape(h, SAMPLES, w, SAMPLES, 4).mean(3).mean(1), depth


def _intersect(shape: Shape, light: Light, eye: np.ndarray, rays: np.ndarray, squares: np.ndarray) -> tuple:
    """Index [R], depth [R] and colour [R, 3] of the rays ([P, 3], squared lengths [P]) that hit a shape."""
    into = np.linalg.inv(shape.A)
    radius = np.linalg.norm(shape.A, 2) * (1 if shape.ball else np.sqrt(3))
    to = shape.b - eye
    along = rays @ to.astype(np.float32)
    near = along**2 >= np.float32(to @ to - radius**2) * squares  # rays that pass the bounding sphere
    index = np.flatnonzero(near)
    o, d = (-into @ to).astype(np.float32), rays[index] @ into.T.astype(np.float32)
    depth, normal = (_ball if shape.ball else _box)(o, d)
    hit = np.isfinite(depth) & (depth > 0)
    index, depth, normal = index[hit], depth[hit], normal[hit]
    local = o + depth[:, None] * d[hit]
    normal = normal @ into
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    toward = np.asarray(light.direction) / np.linalg.norm(light.direction)
    shade = AMBIENT + (1 - AMBIENT) * (normal @ toward).clip(0)
    color = np.asarray(shape.color) * _pattern(local, shape.pattern) * shade[:, None] * light.color
    return index, depth, color.clip(0, 1).astype(np.float32)


def _ball(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth t (inf: no hit) and normal of the rays o + t d on the unit ball."""
    a, b, c = (d * d).sum(1), d @ o, o @ o - 1
    root = b * b - a * c
    depth = np.where(root >= 0, (-b - np.sqrt(root.clip(0))) / a, np.inf).astype(np.float32)
    return depth, o + np.where(np.isfinite(depth), depth, 0)[:, None] * d


def _box(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Like `_ball`, on the cube from -1 to 1."""
    d = np.where(np.abs(d) < 1e-9, np.float32(1e-9), d)
    a, b = (-1 - o) / d, (1 - o) / d
    enter, leave = np.minimum(a, b), np.maximum(a, b)
    depth = np.where(enter.max(1) < leave.min(1), enter.max(1), np.inf)
    normal = np.zeros_like(d)
    face = enter.argmax(1)
    rows = np.arange(len(d))
    normal[rows, face] = -np.sign(d[rows, face])
    return depth, normal


def _pattern(x: np.ndarray, depth: float) -> np.ndarray:
    """[R, 3] gains around 1: waves across the shape, different ones for each colour."""
    if not depth:
        return np.ones_like(x)
    waves = [np.sin(5 * x[:, 0] + 3 * x[:, 2] + c) * np.sin(6 * x[:, 1] - 4 * x[:, 2] + 2 * c) for c in range(3)]
    return 1 + depth * np.stack(waves, 1)


def placed(ball: bool, half: Sequence[float], at: Sequence[float], color: Sequence[float], **options) -> Shape:
    """An upright shape of half sizes `half`, centred at `at`."""
    return Shape(ball, np.diag(np.asarray(half, float)), np.asarray(at, float), color, **options)


def moved(shapes: Sequence[Shape], turn: np.ndarray, shift: Sequence[float] = (0, 0, 0)) -> list[Shape]:
    """The shapes, turned about the origin, then shifted."""
    return [replace(s, A=turn @ s.A, b=turn @ s.b + np.asarray(shift, float)) for s in shapes]

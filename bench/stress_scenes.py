"""Stress cases: small captures, each with one condition under which 4D methods fail.

All but one are procedural, and most show the same subject."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gscodec.capture import Capture

from .data import data_folder
from .procedural import Light, Scene, Shape, moved, placed, rotation

UP = (0, 0, 1)
SKIN, SHIRT, BELT = (0.8, 0.55, 0.4), (0.25, 0.4, 0.75), (0.8, 0.7, 0.2)


def figure(swing: float = 0.0, pattern: float = 0.6) -> list[Shape]:
    """A torso with a belt, a head, and two arms that swing by +-`swing` radians."""
    shapes = [
        placed(True, (0.27, 0.19, 0.42), (0, 0, 0), SHIRT, pattern=pattern),
        placed(False, (0.12, 0.12, 0.13), (0, 0, 0.52), SKIN, pattern=pattern),
        placed(True, (0.28, 0.2, 0.08), (0, 0, -0.18), BELT, pattern=pattern),
    ]
    for side in (-1, 1):
        arm = placed(True, (0.07, 0.07, 0.3), (0, 0, -0.25), SKIN, pattern=pattern)
        shapes += moved([arm], rotation((1, 0, 0), side * swing), (0.34 * side, 0, 0.25))
    return shapes


def turned(shapes: list[Shape], angle: float, shift=(0, 0, 0)) -> list[Shape]:
    """The shapes, turned about the vertical axis by `angle` radians, then shifted."""
    return moved(shapes, rotation(UP, angle), shift)


def walking(t: int, speed: float = 1.0) -> list[Shape]:
    """The figure turns by 4 degrees and drifts by 1.5 cm per frame, and its arms swing."""
    shift = (0.015 * speed * t - 0.09 * speed, 0.01 * np.sin(0.8 * t), 0)
    return turned(figure(0.5 * np.sin(0.5 * speed * t)), 0.07 * speed * t, shift)


def racing(t: int) -> list[Shape]:
    """The figure turns by 35 degrees and moves by up to 30 cm per frame."""
    place = (0.4 * np.cos(0.7 * t), 0.4 * np.sin(0.7 * t), 0.15 * np.sin(1.9 * t))
    return turned(figure(1.2 * np.sin(1.4 * t)), 0.61 * t, place)


def visited(t: int) -> list[Shape]:
    """From frame 10 to 19 a crate stands beside the figure."""
    crate = placed(False, (0.18, 0.18, 0.18), (-0.55, 0.35, -0.2), (0.75, 0.3, 0.25))
    return walking(t) + ([crate] if 10 <= t < 20 else [])


def dimmed(t: int) -> Light:
    """The light fades from white to a dim red and changes its direction."""
    s = t / 29
    return Light((0.5 - 1.2 * s, -0.6 + s, 0.8), (1 - 0.55 * s, 1 - 0.75 * s, 1 - 0.8 * s))


def rods(t: int) -> list[Shape]:
    """A lattice of rods turns; they are 1.6 cm thick, about a pixel."""
    shapes = [placed(True, (0.07, 0.07, 0.07), (0, 0, 0), BELT)]
    for i in range(6):
        angle = np.pi * i / 6
        lying = placed(False, (0.008, 0.008, 0.55), (0, 0, 0), SKIN if i % 2 else SHIRT)
        shapes += moved([lying], rotation((np.cos(angle), np.sin(angle), 0), 1.0))
    return turned(shapes, 0.07 * t)


def sometimes(t: int) -> list[Shape]:
    """The figure, absent in the first two frames and in frames 14 to 17."""
    return [] if t < 2 or 14 <= t < 18 else walking(t)


def cut(t: int) -> list[Shape]:
    """Another subject from frame 15 on."""
    if t < 15:
        return walking(t)
    colors = ((0.3, 0.7, 0.35), (0.75, 0.35, 0.6), (0.85, 0.8, 0.7))
    stack = [placed(i == 1, (0.3 - 0.08 * i,) * 3, (0, 0, 0.45 * i - 0.4), c) for i, c in enumerate(colors)]
    return turned(stack, 0.07 * t)


def on_a_floor(t: int) -> list[Shape]:
    """The figure on a floor."""
    return [*turned(figure(), 0.07 * t), placed(False, (1.5, 1.5, 0.02), (0, 0, -0.45), (0.5, 0.5, 0.45))]


def leaving(t: float) -> list[Shape]:
    """The figure walks out of all pictures to the side, stays away from frame 11 to 17, and comes back."""
    since = abs(t - 14)
    away = 1.7 * np.clip((10 - since) / 6.5, 0, 1)
    return [] if since < 3.5 else turned(figure(0.5 * np.sin(0.5 * t)), 0.04 * t, (0.0, away, 0.0))


def flag(t: float) -> list[Shape]:
    """A cloth of 0.9 by 0.6 m on a pole, of plates that overlap: waves run through it and grow towards its free edge,
    so that no two places move alike."""
    shapes = [placed(True, (0.02, 0.02, 0.6), (-0.47, 0, 0), BELT, pattern=0)]
    columns, rows = 15, 10
    for i, j in np.ndindex(columns, rows):
        u, v = 0.9 * (i + 0.5) / columns, 0.6 * (j + 0.5) / rows  # from the pole, from below
        phase = 8.0 * u + 3.0 * v - 0.35 * t
        y, along = 0.2 * u * np.sin(phase), 0.2 * np.sin(phase) + 1.6 * u * np.cos(phase)
        axes = np.array([(1, along, 0), (0, 0.6 * u * np.cos(phase), 1)])  # tangents
        axes = np.stack([*axes, np.cross(*axes)], 1)
        half = (0.55 * 0.9 / columns, 0.55 * 0.6 / rows, 0.006 / np.linalg.norm(axes[:, 2]))
        color = (1 + 0.25 * np.sin(2.1 * i + 1.3 * j)) * np.array(SHIRT if (i // 3 + j // 3) % 2 else SKIN)
        shapes.append(Shape(False, axes * half, np.array([u - 0.45, y, v - 0.2]), color, pattern=0))
    return turned(shapes, 0.02 * t)


def tunnels(t: float) -> list[Shape]:
    """Two balls go around the figure, 6 degrees per frame, and pass through a block each: each is hidden from all
    cameras for seven frames."""
    shapes = turned(figure(0.5 * np.sin(0.5 * t)), 0.02 * t)
    for side, color in ((0, (0.85, 0.75, 0.2)), (np.pi, (0.3, 0.65, 0.4))):
        ball = placed(True, (0.09, 0.09, 0.09), (0.58, 0, -0.2), color)
        block = placed(False, (0.12, 0.3, 0.12), (0.58, 0, -0.2), (0.55, 0.5, 0.45))
        shapes += turned([ball], side + np.radians(6 * t - 90)) + turned([block], side)
    return shapes


def basketball(frames: int) -> Capture:
    """A real room: two men in a dome (CMU Panoptic Sports), of the data folder, at half the size.

    Raises:
        UsageError: it is not there.
    """
    from .train import CASES as CAPTURES

    return CAPTURES["basketball"].open(data_folder()).frames(0, frames).scaled(0.5)


def drawn(capture: Capture) -> Capture:
    """The capture with its pictures drawn and kept, so that training times do not include drawing."""
    for camera in range(len(capture.cameras)):
        for t in range(capture.frame_count):
            capture.view(camera, t)
    return capture


@dataclass(frozen=True)
class Stress:
    """A case.

    Attributes:
        capture: frames -> the capture.
        frames: number of measured frames.
        floor: least mean PSNR of the subject, coded, on the test cameras, dB. A useful picture of such a capture needs
            30 dB; the floor is lower if the condition itself prevents them (`why`).
        why: reason for a floor below 30.
        still: nothing moves.
    """

    capture: Callable[[int], Capture]
    frames: int = 30
    floor: float = 30.0
    why: str = ""
    still: bool = False


def _procedural(name: str, scene: Scene, floor: float = 30.0, why: str = "", still: bool = False) -> Stress:
    return Stress(partial(_capture, name, scene), scene.frames, floor, why, still)


def _capture(name: str, scene: Scene, frames: int) -> Capture:
    return replace(scene, frames=frames).capture(name)


SCENES = {
    "plain": Scene(walking),
    "fast motion": Scene(racing),
    "appears and disappears": Scene(visited),
    "leaves and comes back": Scene(leaving),
    "light change": Scene(lambda t: walking(t, 0.3), dimmed),
    "exposure by camera": Scene(walking, exposure=(0.7, 1.3)),
    "rolling exposure": Scene(walking, rolling=0.2),
    "motion blur": Scene(lambda t: walking(t, 2.0), shutter=1.0),
    "rig that moves": Scene(walking, orbit=1.0, handheld=(0.5, 0.01)),
    "4 cameras": Scene(walking, train=4, test=2),
    "noisy poses": Scene(walking, pose_noise=(0.5, 0.005)),
    "wrong masks": Scene(walking, mask_errors=0.2),
    "thin structure": Scene(rods),
    "cloth": Scene(flag),
    "hidden parts": Scene(tunnels),
    "no texture": Scene(lambda t: turned(figure(0.5 * np.sin(0.5 * t), pattern=0), 0.07 * t)),
    "empty frames": Scene(sometimes),
    "one frame": Scene(walking, frames=1),
    "scene cut": Scene(cut),
    "300 frames": Scene(lambda t: walking(t % 100, 0.2), frames=300, size=64),
    "static": Scene(lambda t: figure()),
    "no masks": Scene(on_a_floor, masks=False),
    "no masks with noise": Scene(on_a_floor, masks=False, noise=0.01),
}
FLOORS = {  # floors below 30 dB: PSNR, and the reason
    "exposure by camera": (27.0, "test cameras have a brightness that no training camera has"),
    "rolling exposure": (28.0, "what all cameras share of it cannot be told from light"),
    "motion blur": (27.0, "the pictures themselves are blurred by another motion in each view"),
    "rig that moves": (27.0, "every pixel of every camera changes in every frame"),
    "4 cameras": (19.0, "most of the subject is seen by two cameras at most"),
    "noisy poses": (27.0, "half a degree are two pixels"),
    "thin structure": (26.0, "a rod is a pixel wide"),
    "300 frames": (25.0, "64 x 64 pixels, and a third of the Gaussians"),
}
CASES = {
    name: _procedural(name, scene, *FLOORS.get(name, ()), still=name == "static") for name, scene in SCENES.items()
} | {"real room": Stress(basketball, floor=25.0, why="28 to 30 dB are the best that is published, at twice the size")}

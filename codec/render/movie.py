"""Frames of a stream -> images: camera path -> CPU rasterizer -> .mp4, with the stream's sound, or a folder of .png."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import UsageError, require
from ..model.camera import NEAR, Camera, look_at, low_pass_of
from ..model.gaussians import Gaussians
from .image import render_image
from .png import write_png

ORBIT_SECONDS = 8.0  # one turn
FIELD_OF_VIEW = 40.0  # degrees, orbit camera


def up_vector(axis: str) -> np.ndarray:
    """ "z" or "-y" -> [3] unit vector."""
    v = np.zeros(3)
    v["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return v


def orbit_camera(g: Gaussians, up: str, turn: float, width: int, height: int, near: float, low_pass: float) -> Camera:
    """A camera around the 1-99 % box of `g` with its bounding sphere in frame; `turn` in turns, `near` plane in world
    units, at most half of the distance, `low_pass` in px^2."""
    low, high = np.percentile(g.means, [1, 99], axis=0) if len(g) else (np.zeros(3), np.ones(3))
    centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    u = up_vector(up)
    side = np.roll(u, 1)
    ahead = np.cross(u, side)
    half = np.radians(FIELD_OF_VIEW) / 2
    angle = 2 * np.pi * turn
    direction = np.cos(angle) * side + np.sin(angle) * ahead + 0.2 * u
    distance = radius / np.sin(half)
    eye, near = centre + direction / np.linalg.norm(direction) * distance, min(near, distance / 2)
    f = min(width, height) / 2 / np.tan(half)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    return Camera("orbit", K, look_at(eye, centre, u), width, height, near=near, low_pass=low_pass)


def load_camera(path: Path, near: float = NEAR) -> Camera:
    """A camera from a .json file with K [3, 3], viewmat [4, 4] (world-to-camera, OpenCV), width, height and near (world
    units; `near` if the file has none).

    Raises:
        UsageError: it is not such a file.
    """
    try:
        c = json.loads(Path(path).read_text())
        K, viewmat, near = np.array(c["K"], float), np.array(c["viewmat"], float), float(c.get("near", near))
        return Camera("file", K, viewmat, int(c["width"]), int(c["height"]), near=near)
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise UsageError(f"--camera {path}: expected a JSON object with K, viewmat, width and height ({e})") from None


def camera_path(stream, camera: str, size: str | None, frames: range) -> Iterator[Camera]:
    """One camera per frame. That of an orbit is placed by the first frame with Gaussians.

    Raises:
        UsageError: the camera or the size makes no sense.
    """
    wanted, low_pass = parse_size(size), low_pass_of(stream.cameras)
    near = min((c.near for c in stream.cameras), default=NEAR)
    if camera == "orbit":
        width, height = wanted or (512, 512)
        first = next((g for g in map(stream.frame, frames) if len(g)), Gaussians.none())
        for t in frames:
            turn = t / (stream.fps * ORBIT_SECONDS)
            yield orbit_camera(first, stream.config["up"], turn, width, height, near, low_pass)
        return
    known = {c.name: c for c in stream.cameras}
    if camera in known:
        fixed = known[camera]
    elif camera.endswith(".json"):
        fixed = replace(load_camera(Path(camera), near), low_pass=low_pass)
    else:
        names = ", ".join(known) or "none in this file"
        raise UsageError(
            f"--camera {camera} does not exist, expected orbit, a .json file or a reference camera ({names})"
        )
    fixed = fixed.resized(*wanted) if wanted else fixed
    for _ in frames:
        yield fixed


def parse_size(size: str | None) -> tuple[int, int] | None:
    """ "640x480" -> (640, 480).

    Raises:
        UsageError: not of that form, or outside 1 to 16384.
    """
    if size is None:
        return None
    try:
        w, h = (int(v) for v in size.lower().split("x"))
    except ValueError:
        raise UsageError(f"--size {size} is not a size, expected WxH such as 640x480") from None
    if not (1 <= w <= 16384 and 1 <= h <= 16384):
        raise UsageError(f"--size {size} is out of range, expected 1 to 16384 pixels a side")
    return w, h


def render_stream(stream, dest: Path, *, camera: str, size: str | None, frames: range, bar) -> int:
    """Renders `frames` of a stream to `dest`, a .mp4 file or a folder; returns how many."""
    dest = Path(dest)
    movie = dest.suffix.lower() == ".mp4"
    if dest.suffix and not movie and not dest.is_dir():
        raise UsageError(f"{dest}: expected a name that ends in .mp4, or a folder for .png images")
    background = tuple(stream.config["background"])
    cameras = camera_path(stream, camera, size, frames)
    images = (render_image(stream.frame(t), c, background) for t, c in zip(frames, cameras, strict=True))
    sound = Path(stream.name) if any("audio" in g for g in stream.groups) else None
    written = _write_movie(images, dest, stream.fps, frames, sound) if movie else _write_images(images, dest, frames)
    for done in written:
        bar.update("render", done, len(frames))
    return len(frames)


def _write_images(images, folder: Path, frames: range) -> Iterator[int]:
    for done, (t, image) in enumerate(zip(frames, images, strict=True), 1):
        folder.mkdir(parents=True, exist_ok=True)  # not before there is an image for it
        write_png(folder / f"{t:06d}.png", image)
        yield done


def _write_movie(images, path: Path, fps: float, frames: range, sound: Path | None) -> Iterator[int]:
    """Writes an .mp4; `sound`: the .gsv file with its audio track."""
    ffmpeg = require("imageio_ffmpeg", "writing .mp4 (a folder of .png needs nothing)")
    part = path.with_name(path.stem + ".part.mp4")
    first = next(images)
    h, w = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2  # yuv420p has even sides
    if not h or not w:
        raise UsageError(f"{path}: a .mp4 has at least 2 x 2 pixels, expected a larger --size")
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = ffmpeg.write_frames(
        str(part), (w, h), fps=fps, codec="libx264", quality=None, macro_block_size=1, output_params=["-crf", "16"]
    )
    writer.send(None)
    try:
        writer.send(np.ascontiguousarray(first[:h, :w]))
        yield 1
        for done, image in enumerate(images, 2):
            writer.send(np.ascontiguousarray(image[:h, :w]))
            yield done
        writer.close()
        if sound:
            _add_sound(ffmpeg.get_ffmpeg_exe(), part, sound, frames.start / fps, len(frames) / fps)
        os.replace(part, path)
    finally:
        writer.close()
        part.unlink(missing_ok=True)


def _add_sound(ffmpeg: str, movie: Path, stream: Path, start: float, seconds: float) -> None:
    """Adds the sound of a .gsv file, which ffmpeg reads as any MP4, to a movie of its frames from second `start` on."""
    both = movie.with_name(movie.stem + ".sound.mp4")
    inputs = ["-i", movie, "-ss", f"{start:.6f}", "-i", stream.resolve()]
    how = ["-map", "0:v", "-map", "1:a", "-c", "copy", "-t", f"{seconds:.6f}", both]
    try:
        done = subprocess.run(
            [ffmpeg, "-v", "error", "-nostdin", "-y", *inputs, *how], capture_output=True, check=False
        )
        if done.returncode:
            raise UsageError(f"{stream}: ffmpeg cannot add the sound: {done.stderr.decode(errors='replace').strip()}")
        os.replace(both, movie)
    finally:
        both.unlink(missing_ok=True)

"""Makes examples/lumberjack, the small capture that `make demo` and the tests use, out of the full one.

    python examples/make_lumberjack.py SRC DST

SRC is the rendered capture: 22 cameras (0-7, 8-15 and 16-19 on three rings, 20 and 21 for tests), 512 x 512 RGBA,
30 frames. DST gets 12 training and the 2 test cameras, 256 x 256, 20 frames. The area filter works on premultiplied
colours. Colour under alpha 0 is zeroed, which no view shows, and the lowest bit of the others dropped, which is
noise of the path tracer: 10.1 MiB as PNG and 6.5 MiB as lossless WebP become 5.5 MiB.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from gscodec.capture import open_capture

# Every other camera of the two lower rings, staggered between them, and the upper ring whole: neighbours are 22 to 45
# degrees of azimuth apart, at three heights.
TRAIN = (0, 2, 4, 6, 9, 11, 13, 15, 16, 17, 18, 19)
TEST = (20, 21)
FRAMES = 20
SCALE = 0.5
MIB = 1 << 20
LIMIT = 6 * MIB

README = """\
# Lumberjack

A capture of an animated character walking on the spot: {train} training and {test} test cameras, {frames} frames at
{fps:g} frames a second, {width} x {height} RGBA, metres, exact calibration in transforms.json.

Credit: "Low Poly Lumberjack" by Daz (sketchfab.com/Darren.Hogan), licensed under CC BY 4.0
(https://creativecommons.org/licenses/by/4.0/); rendered and downscaled by us with `make_lumberjack.py`, which lies
beside this folder. Images are lossless WebP; colours are even numbers, since the last bit was noise.
"""


def write_webp(path: Path, view) -> None:
    """Lossless RGBA WebP."""
    rgb = np.minimum((view.rgb.astype(np.int32) + 1) // 2 * 2, 255) * (view.alpha > 0)[..., None]
    rgba = np.dstack([rgb.astype(np.uint8), view.alpha])
    spec = oiio.ImageSpec(rgba.shape[1], rgba.shape[0], 4, "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("compression", "lossless:100")
    image = oiio.ImageOutput.create(str(path))
    if not (image.open(str(path), spec) and image.write_image(rgba) and image.close()):
        sys.exit(f"{path}: {image.geterror()}")


def opengl_pose(camera) -> list[list[float]]:
    """Camera-to-world matrix in OpenGL axes, as transforms.json has it."""
    return (np.linalg.inv(camera.viewmat) * [1, -1, -1, 1]).round(9).tolist()


def make(source: Path, target: Path) -> int:
    """Writes the example and returns its size in bytes."""
    capture = open_capture(source).frames(0, FRAMES).scaled(SCALE)
    cameras = [(i, capture.cameras[i]) for i in (*TRAIN, *TEST)]
    first = cameras[0][1]
    shutil.rmtree(target, ignore_errors=True)
    frames = []
    for i, camera in cameras:
        (target / "images" / camera.name).mkdir(parents=True)
        for t in range(FRAMES):
            name = f"images/{camera.name}/{t:06d}.webp"
            write_webp(target / name, capture.view(i, t))
            entry = {"file_path": name, "camera": camera.name, "frame": t, "split": camera.split}
            frames.append(entry | {"transform_matrix": opengl_pose(camera)})
    K = first.K.round(6).tolist()
    head = {"camera_model": "PINHOLE", "w": first.width, "h": first.height, "fps": capture.fps}
    head |= {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    lines = ",\n  ".join(json.dumps(f) for f in frames)
    (target / "transforms.json").write_text(f'{json.dumps(head)[:-1]}, "frames": [\n  {lines}\n]}}\n')
    counts = {"train": len(TRAIN), "test": len(TEST), "frames": FRAMES, "fps": capture.fps}
    (target / "README.md").write_text(README.format(**counts, width=first.width, height=first.height))
    return sum(p.stat().st_size for p in target.rglob("*") if p.is_file())


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python examples/make_lumberjack.py SRC DST")
    size = make(Path(sys.argv[1]), Path(sys.argv[2]))
    print(f"{sys.argv[2]}: {size / MIB:.2f} MiB")
    if size > LIMIT:
        sys.exit(f"{sys.argv[2]}: {size / MIB:.2f} MiB, expected at most {LIMIT / MIB:g}; drop frames or cameras")

"""One picture for visual comparison: a row per frame, on the left the reference, on the right the decoded stream.

usage: python -m bench.picture STREAM.gsv CAPTURE PICTURE.png [CAMERA [FRAME ...]]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from gscodec.capture import composite, open_capture
from gscodec.decode import open_stream
from gscodec.render.image import render_image
from gscodec.render.png import write_png

BACKGROUND = (0.5, 0.5, 0.5)


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("stream", type=Path, metavar="STREAM.gsv")
    parser.add_argument("capture", type=Path, metavar="CAPTURE")
    parser.add_argument("picture", type=Path, metavar="PICTURE.png")
    parser.add_argument("camera", nargs="?", metavar="CAMERA", help="name; the first test camera by default")
    parser.add_argument("frames", nargs="*", type=int, metavar="FRAME", help="first, middle and last by default")
    a = parser.parse_args()
    stream, capture = open_stream(a.stream), open_capture(a.capture)
    names = [c.name for c in capture.cameras]
    camera = names.index(a.camera) if a.camera else capture.indices("test")[0]
    frames = a.frames or [0, stream.frame_count // 2, stream.frame_count - 1]
    rows = []
    for t in frames:
        reference = composite(capture.view(camera, t), BACKGROUND)
        decoded = render_image(stream.frame(t), capture.camera(camera, t), BACKGROUND)
        rows.append(np.concatenate([reference, decoded], 1))
    write_png(a.picture, np.concatenate(rows, 0))


if __name__ == "__main__":
    main()

"""Reference beside what a stream decodes to, for the eye: rows are frames, the columns reference and render.

usage: python bench/picture.py STREAM.gsv CAPTURE PICTURE.png [CAMERA [FRAME ...]]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from gscodec.capture import composite, open_capture
from gscodec.decode import open_stream
from gscodec.render.image import render_image
from gscodec.render.png import write_png

BACKGROUND = (0.5, 0.5, 0.5)


def main() -> None:
    """Writes the picture."""
    stream, capture, picture = open_stream(sys.argv[1]), open_capture(sys.argv[2]), Path(sys.argv[3])
    names = [c.name for c in capture.cameras]
    camera = names.index(sys.argv[4]) if len(sys.argv) > 4 else capture.indices("test")[0]
    frames = [int(a) for a in sys.argv[5:]] or [0, stream.frame_count // 2, stream.frame_count - 1]
    rows = []
    for t in frames:
        reference = composite(capture.view(camera, t), BACKGROUND)
        rows.append(
            np.concatenate([reference, render_image(stream.frame(t), capture.camera(camera, t), BACKGROUND)], 1)
        )
    write_png(picture, np.concatenate(rows, 0))


if __name__ == "__main__":
    main()

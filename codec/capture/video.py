"""One video file -> frames by number, decoded in order where possible.

Training asks for frames nearly in order, and decoding forward is far cheaper than seeking. So the decoder stays open at
its position: for a frame a short way ahead it decodes and drops those between, otherwise it seeks. The last frames are
kept for threads that are a little behind.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path

import numpy as np

from ..errors import CaptureError, require

SKIP = 48  # frames that are decoded and dropped rather than seeking, about two GOPs of a camera
KEEP = 4  # decoded frames that stay in memory, per camera


class Video:
    """Random access to a video file; thread-safe.

    Attributes:
        path: path of the file.
        frame_count, fps, width, height: from the header of the container.
    """

    def __init__(self, path: Path):
        """Raises CaptureError if the file is missing or not a video."""
        cv2 = require("cv2", "reading videos")
        self._cv2, self.path = cv2, path
        if not path.is_file():
            raise CaptureError(f"{path}: video is missing")
        self._decoder = cv2.VideoCapture(str(path))
        if not self._decoder.isOpened():
            raise CaptureError(f"{path}: not a readable video")
        self.frame_count = int(self._decoder.get(cv2.CAP_PROP_FRAME_COUNT))
        self.fps = float(self._decoder.get(cv2.CAP_PROP_FPS))
        self.width = int(self._decoder.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(self._decoder.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self._next = 0  # frame that the decoder gives next
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def frame(self, t: int) -> np.ndarray:
        """Frame `t`, [H, W, 3] u8 RGB.

        Raises:
            CaptureError: the video ends before `t` or is damaged there.
        """
        with self._lock:
            if t not in self._kept:
                self._kept[t] = self._decode(t)
                while len(self._kept) > KEEP:
                    self._kept.popitem(last=False)
            return self._kept[t]

    def _decode(self, t: int) -> np.ndarray:
        if not self._next <= t <= self._next + SKIP:
            self._decoder.set(self._cv2.CAP_PROP_POS_FRAMES, t)
            self._next = t
        ok = True
        while ok and self._next <= t:
            ok = self._decoder.grab()
            self._next += 1
        ok, bgr = self._decoder.retrieve() if ok else (False, None)
        if not ok:
            self._next = -SKIP - 1  # the position is unknown now: the next read seeks
            raise CaptureError(f"{self.path}: frame {t} cannot be decoded, the header promises {self.frame_count}")
        return np.ascontiguousarray(bgr[..., ::-1])

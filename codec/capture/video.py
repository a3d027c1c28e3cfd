"""One video file -> frames by number, decoded in order where possible.

Training asks for frames nearly in order, and decoding forward is far cheaper than seeking. So the decoder stays open at
its position: for a frame a short way ahead it decodes and drops those between, otherwise it seeks. OpenCV seeks by
time, so a video whose frames are not evenly spaced, or whose header has another number of frames, is decoded from its
start instead. The last frames are kept for threads that are a little behind.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from pathlib import Path

import numpy as np

from ..errors import CaptureError, require

SKIP = 48  # frames that are decoded and dropped rather than seeking, about two GOPs of a camera
EVEN = 0.25  # of the time from frame to frame, largest error of the time of an evenly spaced frame
KEEP = 4  # decoded frames that stay in memory, per camera


class Video:
    """Random access to a video file; thread-safe.

    Attributes:
        path: path of the file.
        frame_count: number of frames that can be decoded.
        fps, width, height: from the header of the container.
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
        self.fps = float(self._decoder.get(cv2.CAP_PROP_FPS))
        self.width = int(self._decoder.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(self._decoder.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self._next: float = 0  # frame that the decoder gives next
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()
        times = self._times()
        grid = np.arange(len(times)) / self.fps if self.fps > 0 else np.zeros(0)
        self.frame_count = int(self._decoder.get(cv2.CAP_PROP_FRAME_COUNT))
        self._seeks = 0 < self.frame_count == len(grid) and bool(np.abs(times - grid).max() * self.fps < EVEN)
        if not self._seeks or not self._has_last():
            self.frame_count = self._counted()

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

    def _times(self) -> np.ndarray:
        """[N] seconds from the first frame to each frame, in order, from the packets of the file, without decoding."""
        raw, times = self._cv2.VideoCapture(str(self.path), self._cv2.CAP_FFMPEG, [self._cv2.CAP_PROP_FORMAT, -1]), []
        while raw.grab():
            times.append(raw.get(self._cv2.CAP_PROP_POS_MSEC) / 1000)
        return np.sort(times) - min(times, default=0)

    def _has_last(self) -> bool:
        """Whether the last frame that the header promises can be decoded: videos that were cut may lack some."""
        try:
            self._decode(self.frame_count - 1)
        except CaptureError:
            return False
        return True

    def _counted(self) -> int:
        """The number of frames, by decoding all."""
        decoder, count = self._cv2.VideoCapture(str(self.path)), 0
        while decoder.grab():
            count += 1
        return count

    def _decode(self, t: int) -> np.ndarray:
        if self._seeks and not self._next <= t <= self._next + SKIP:
            self._decoder.set(self._cv2.CAP_PROP_POS_FRAMES, t)
            self._next = t
        elif self._next > t:
            self._decoder = self._cv2.VideoCapture(str(self.path))
            self._next = 0
        ok = True
        while ok and self._next <= t:
            ok = self._decoder.grab()
            self._next += 1
        ok, bgr = self._decoder.retrieve() if ok else (False, None)
        if not ok:
            self._next = math.inf  # the position is unknown now: the next read seeks or starts again
            raise CaptureError(f"{self.path}: frame {t} cannot be decoded, the video has {self.frame_count} frames")
        return np.ascontiguousarray(bgr[..., ::-1])

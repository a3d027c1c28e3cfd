"""A .gsv file as frames: demux (headers only), decode groups on demand, evaluate the frame that is asked for.

Any frame is one evaluation away from its group's coefficients, so seeking costs at most one group. Needs numpy only.
"""

from __future__ import annotations

import mmap
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gscodec import _native
from gscodec.camera import Camera
from gscodec.errors import BitstreamError
from gscodec.gaussians import Gaussians, GaussianSequence, Group

GROUPS_HELD = 2  # decoded groups in memory: the one that plays and the next


class Stream:
    """Random access to the frames of a .gsv file (finished, growing or cut short).

    Attributes:
        config: the config box: fps, level, sh_degree, up, background, cameras, ...
        groups: list of {offset, size, start_frame, frames, sync}.
        complete: false if the file ends inside a group (that group is left out).
    """

    def __init__(self, data, name: str = "stream"):
        self.name, self._data = name, data
        index = _native.demux(data)
        self.config, self.groups, self.complete = index["config"], index["groups"], index["complete"]
        self._held: OrderedDict[int, object] = OrderedDict()

    @property
    def fps(self) -> float:
        """Frames a second."""
        fps = self.config["fps"]
        return fps[0] / fps[1] if isinstance(fps, tuple | list) else float(fps)

    @property
    def frame_count(self) -> int:
        """Frames in whole groups."""
        return sum(g["frames"] for g in self.groups)

    @property
    def byte_count(self) -> int:
        """Size of the file in bytes."""
        return len(self._data)

    @property
    def cameras(self) -> list[Camera]:
        """Reference cameras of the capture."""
        return [
            Camera(c["name"], np.array(c["K"]), np.array(c["viewmat"]), c["width"], c["height"])
            for c in self.config["cameras"]
        ]

    def payload(self, i: int) -> bytes:
        """Bytes of group `i`."""
        g = self.groups[i]
        return bytes(self._data[g["offset"] : g["offset"] + g["size"]])

    def group(self, i: int):
        """Group `i`, decoded (`_native.DecodedGroup`).

        Raises:
            BitstreamError: a unit of it is damaged.
        """
        if i not in self._held:
            try:
                self._held[i] = _native.DecodedGroup(self.payload(i), self.config["level"])
            except BitstreamError as e:
                raise BitstreamError(f"{self.name}: group {i} (frames {self._span(i)}): {e}") from None
            if self._held[i].frames != self.groups[i]["frames"]:
                told, got = self.groups[i]["frames"], self._held.pop(i).frames
                raise BitstreamError(f"{self.name}: group {i}: its header says {got} frames, its sample {told}")
            while len(self._held) > GROUPS_HELD:
                self._held.popitem(last=False)
        self._held.move_to_end(i)
        return self._held[i]

    def _span(self, i: int) -> str:
        g = self.groups[i]
        return f"{g['start_frame']}-{g['start_frame'] + g['frames'] - 1}"

    def frame(self, t: int) -> Gaussians:
        """Frame `t` as shown: the visible Gaussians.

        Raises:
            IndexError: `t` is not in the file.
        """
        for i, g in enumerate(self.groups):
            if 0 <= t < g["frames"]:
                return self._frame_of_group(i, t)
            t -= g["frames"]
        raise IndexError(f"{self.name} has {self.frame_count} frames")

    def _frame_of_group(self, i: int, t: int) -> Gaussians:
        group = self.group(i)
        frame = Gaussians(**group.frame(t))
        visible = group.visible(t)
        return frame if visible is None else frame.take(visible)

    def sequence(self) -> GaussianSequence:
        """The whole file as a sequence with the groups of the stream; groups and frames are decoded when read."""
        return GaussianSequence(self.fps, _Groups(self), self.cameras)


class _Groups(Sequence):
    def __init__(self, stream: Stream):
        self.stream = stream

    def __len__(self) -> int:
        return len(self.stream.groups)

    def __getitem__(self, i: int) -> Group:
        group = self.stream.group(i)
        if group.visible(0) is None:
            return Group(_Frames(self.stream, i))
        shown = np.stack([group.visible(t) for t in range(group.frames)])  # [T, N], one run of frames each
        start = shown.argmax(0)
        return Group(_Frames(self.stream, i), np.stack([start, start + shown.sum(0)], 1).astype(np.int32))


class _Frames(Sequence):
    def __init__(self, stream: Stream, i: int):
        self.stream, self.i = stream, i

    def __len__(self) -> int:
        return self.stream.groups[self.i]["frames"]

    def __getitem__(self, t: int) -> Gaussians:
        if not 0 <= t < len(self):
            raise IndexError(t)
        return Gaussians(**self.stream.group(self.i).frame(t))


def open_stream(path: str | Path) -> Stream:
    """Opens a .gsv file.

    Raises:
        FileNotFoundError: nothing is there.
        BitstreamError: it is not a .gsv file.
    """
    path = Path(path)
    with open(path, "rb") as f:
        if path.stat().st_size == 0:
            raise BitstreamError(f"{path}: the file is empty, expected a .gsv stream")
        data = mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ)
    try:
        return Stream(data, str(path))
    except BitstreamError as e:
        raise BitstreamError(f"{path}: {e}") from None

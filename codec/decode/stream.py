""".gsv file -> frames: demux (headers only), decode groups on demand, evaluate the requested frame.

A frame is evaluated directly from the coefficients of its group, so seeking decodes at most one group and, if that is
predicted, its reference. Needs numpy only.
"""

from __future__ import annotations

import mmap
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np

from .. import _native
from ..errors import BitstreamError, LimitError
from ..model.camera import Camera
from ..model.gaussian_sequence import GaussianSequence
from ..model.gaussians import Gaussians
from ..model.parametric_group import ParametricGroup
from ..model.placement import Pose
from .parametric import parametric_group

GROUPS_HELD = 3  # decoded groups in memory: the playing one, the next one, and their reference


class Stream:
    """Random access to the frames of one track of a .gsv file (finished, growing or cut short); `Scene` has all tracks.

    Attributes:
        config: the config box: fps, level, sh_degree, up, background, cameras, ...
        groups: list of {offset, size, start_frame, frames, sync}.
        complete: false if the file ends inside a group (that group is left out).
        strict: damage is an error; otherwise undamaged parts are decoded, and `damage` lists the damaged parts.
        layers: how many layers of each group are decoded; None: all.
        track: index in a scene, where damaged boxes cost only their groups, even if strict. None: the first track.
    """

    def __init__(
        self,
        data,
        name: str = "stream",
        *,
        strict: bool = True,
        layers: int | None = None,
        track: int | None = None,
    ):
        self.name, self._data, self.strict, self.layers, self.track = name, data, strict, layers, track
        index = _native.demux(data, strict and track is None, track or 0)
        self.config, self.groups, self.complete = index["config"], index["groups"], index["complete"]
        self._held: OrderedDict[int, object] = OrderedDict()
        blank = {"unit": None, "type": "fragment", "layer": 0, "tile": None}
        self._damage: dict[int, list[dict]] = {i: [blank | {"message": m}] for i, m in index["damage"]}
        self._ends: list[int] = list(accumulate(g["frames"] for g in self.groups))  # frames up to the end of each group

    @property
    def fps(self) -> float:
        """Frames a second."""
        fps = self.config["fps"]
        return fps[0] / fps[1] if isinstance(fps, tuple | list) else float(fps)

    @property
    def frame_count(self) -> int:
        """Frames in whole groups."""
        return self._ends[-1] if self._ends else 0

    @property
    def damage(self) -> list[dict]:
        """Damage in the groups decoded so far: dicts of group, unit, type, layer, tile, message.

        The Gaussians of a damaged tile are missing. If it is the first tile of its layer, the Gaussians of all tiles of
        the layer are missing, since their models start from it. Without the nodes or their motion, Gaussians do not
        move. Groups that refer to a damaged group show its damage, which is listed once, for that group. A group with a
        damaged header or first tile stays an error. A group with damaged boxes (type: fragment) stays an error, too;
        the groups after it are not affected if the file has an index.
        """
        return [{"group": i, **d} for i, found in sorted(self._damage.items()) for d in found]

    @property
    def byte_count(self) -> int:
        """Bytes of the file; for a track of a scene, bytes of its groups."""
        return self.file_size if self.track is None else sum(g["size"] for g in self.groups)

    @property
    def file_size(self) -> int:
        """Size of the file in bytes."""
        return len(self._data)

    @property
    def cameras(self) -> list[Camera]:
        """Reference cameras of the capture."""
        return [
            Camera(
                c["name"],
                np.array(c["K"]),
                np.array(c["viewmat"]),
                c["width"],
                c["height"],
                near=c["near"],
                low_pass=c["low_pass"],
            )
            for c in self.config["cameras"]
        ]

    def payload(self, i: int) -> bytes:
        """Bytes of group `i`."""
        return self.bytes_at(self.groups[i]["offset"], self.groups[i]["size"])

    def sound(self, i: int) -> bytes:
        """Concatenated sound samples of group `i`."""
        offset, _, samples = self.groups[i].get("audio", (0, 0, []))
        return bytes(self._data[offset : offset + sum(size for size, _ in samples)])

    def group(self, i: int):
        """Group `i`, decoded (`_native.DecodedGroup`).

        Raises:
            BitstreamError: the group has a damaged unit (not strict: header or first tile) or contradicts the file.
            LimitError: the group exceeds the level of the file.
        """
        if i not in self._held:
            where = f"{self.name}: group {i} (frames {self._span(i)})"
            try:
                if i in self._damage and self._damage[i][0]["type"] == "fragment":
                    raise BitstreamError(self._damage[i][0]["message"])
                payload = self.payload(i)
                reference = self._reference(i, _native.reference_of(payload))
                options = {"reference": reference} | ({} if self.layers is None else {"layers": self.layers})
                group = _native.DecodedGroup(payload, self.config["level"], self.strict, **options)
            except (BitstreamError, LimitError) as e:
                raise type(e)(f"{where}: {e}") from None
            self._check(i, group)
            if found := group.damage():
                self._damage[i] = found
            self._held[i] = group
            while len(self._held) > GROUPS_HELD:
                self._held.popitem(last=False)
        self._held.move_to_end(i)
        return self._held[i]

    def _reference(self, i: int, back: int):
        """The reference of group `i`, `back` groups before it; None if group `i` is independent."""
        if back == 0:
            return None
        if back > i or self.groups[i]["sync"]:
            raise BitstreamError(
                f"predicted from the group {back} before it: expected one of the file, and this to be no sync sample"
            )
        return self.group(i - back)

    def _check(self, i: int, group) -> None:
        """Checks the header of a group against the file (spec 4); the decoder of a group does not know the file."""
        frames, degree = self.groups[i]["frames"], self.config["sh_degree"]
        if group.frames != frames or group.sh_degree > degree:
            raise BitstreamError(
                f"{self.name}: group {i}: the file says {frames} frames and an SH degree of at most {degree}, "
                f"the header of the group {group.frames} frames and degree {group.sh_degree}"
            )

    def _span(self, i: int) -> str:
        g = self.groups[i]
        return f"{g['start_frame']}-{g['start_frame'] + g['frames'] - 1}"

    def bytes_at(self, offset: int, size: int) -> bytes:
        """`size` bytes of the file from `offset` on."""
        return bytes(self._data[offset : offset + size])

    def frame(self, t: int, pose: Pose | None = None) -> Gaussians:
        """Frame `t` as shown: the visible Gaussians, placed by `pose`.

        Raises:
            IndexError: `t` is not in the file.
        """
        if not 0 <= t < self.frame_count:
            raise IndexError(f"{self.name} has {self.frame_count} frames")
        i = bisect_right(self._ends, t)
        return self._frame_of_group(i, t - self._ends[i] + self.groups[i]["frames"], pose)

    def _frame_of_group(self, i: int, t: int, pose: Pose | None) -> Gaussians:
        group = self.group(i)
        frame = Gaussians(**group.frame(t, pose))
        visible = group.visible(t)
        return frame if visible is None else frame.take(visible)

    def sequence(self) -> GaussianSequence:
        """The whole file as a sequence with the groups of the stream; groups and frames are decoded when read."""
        return GaussianSequence(self.fps, _Groups(self), self.cameras)

    def identities(self) -> list[np.ndarray]:
        """Identities [N] int of each group: equal numbers are one Gaussian, in groups predicted from each other."""
        found, known = [], 0
        for i in range(len(self.groups)):
            q = self.group(i).quantized()
            own = np.arange(known, known + len(q))
            if q.reference:
                own = np.where(q.parents >= 0, found[i - q.reference][np.maximum(q.parents, 0)], own)
            found.append(own)
            known += len(q)
        _, numbers = np.unique(np.concatenate(found) if found else np.zeros(0, int), return_inverse=True)
        return np.split(numbers, np.cumsum([len(f) for f in found])[:-1]) if found else []


class _Groups(Sequence):
    """Groups of a stream as ParametricGroups, decoded when read."""

    def __init__(self, stream: Stream):
        self.stream = stream

    def __len__(self) -> int:
        return len(self.stream.groups)

    def __getitem__(self, i: int) -> ParametricGroup:
        return parametric_group(self.stream.group(range(len(self))[i]))


def open_bytes(path: str | Path) -> mmap.mmap:
    """The bytes of a .gsv file.

    Raises:
        FileNotFoundError: the file does not exist.
        BitstreamError: a folder, an empty file, or not an ISO base media file.
    """
    path = Path(path)
    if path.is_dir():
        raise BitstreamError(f"{path}: a folder, expected a .gsv file")
    with open(path, "rb") as f:
        if path.stat().st_size == 0:
            raise BitstreamError(f"{path}: the file is empty, expected a .gsv stream")
        data = mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ)
    if len(data) >= 8 and data[4:8] != b"ftyp":
        raise BitstreamError(f"{path}: not a .gsv file, expected it to start with an ftyp box")
    return data


def open_stream(path: str | Path, *, strict: bool = True, layers: int | None = None) -> Stream:
    """Opens a .gsv file; of a scene, its first track.

    Args:
        strict: damage is an error; otherwise undamaged parts are decoded, and `Stream.damage` lists the damaged parts.
        layers: how many layers of each group are decoded; None: all.

    Raises:
        FileNotFoundError: the file does not exist.
        BitstreamError: it is not a .gsv file, or a folder.
    """
    data = open_bytes(path)
    try:
        return Stream(data, str(path), strict=strict, layers=layers)
    except BitstreamError as e:
        raise BitstreamError(f"{path}: {e}") from None

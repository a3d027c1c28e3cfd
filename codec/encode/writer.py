"""The growing file: group payloads -> OUT.gsv.part, playable at any moment, then OUT.gsv with its index.

OUT.gsv.part holds the init segment and whole fragments. OUT.gsv.part.json holds the fingerprint: a second run continues
where the first one stopped only if input and settings are the same. OUT.gsv.part.N.npz holds the coder's state after N
groups; it exists from before group N is written until group N + 1 is written, so that a run killed at any moment can
continue. `finish` writes the indexed file beside it and renames; a file under the final name is always complete.
"""

from __future__ import annotations

import json
import mmap
import os
import shutil
import warnings
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import _native
from ..atomic_write import part_file, read_arrays, write_arrays
from ..errors import BitstreamError
from ..fingerprint import sentence

if TYPE_CHECKING:
    from .audio import AudioTrack


class StreamWriter:
    """Appends groups to a .gsv file.

    Args:
        out: final path.
        config: as `_native.init_segment` takes it (fps, level, cameras, ...).
        fingerprint: data that must be equal for two runs to make the same groups (JSON-able).
        audio: sound; its samples are written in front of the group in whose frames they begin.
    """

    def __init__(self, out: Path, config: dict, fingerprint: dict, audio: AudioTrack | None = None):
        if audio:
            config, fingerprint = config | {"audio": audio.config}, fingerprint | {"audio": audio.digest}
        self.out, self.config, self._audio = Path(out), config, audio
        self.part = self.out.with_name(self.out.name + ".part")
        self._made_by = self.out.with_name(self.out.name + ".part.json")
        self.init = _native.init_segment(config)
        self._fps = _native.demux(self.init)["config"]["fps"]  # as an exact fraction
        self.fragments: list[tuple[int, int, bool, list[int]]] = []  # size, frames, sync, bytes up to each layer's end
        fingerprint = json.loads(json.dumps(fingerprint))
        if not self._resume(fingerprint):
            self._forget()
            self.part.write_bytes(self.init)
            with part_file(self._made_by) as part:
                part.write_text(json.dumps(fingerprint))
        self._file = open(self.part, "ab")

    def _resume(self, fingerprint: dict) -> bool:
        if not (self.part.exists() and self._made_by.exists()):
            return False
        try:
            before = json.loads(self._made_by.read_text())
            if before != fingerprint:
                changed = sentence(before, fingerprint)
                warnings.warn(f"{self.part} starts anew, it was made differently: {changed}", stacklevel=4)
                return False
            with open(self.part, "rb") as f, mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ) as data:
                if data[: len(self.init)] != self.init:
                    return False
                index = _native.demux(data)
                ends = [layer_ends(_native.units(data[g["offset"] : g["offset"] + g["size"]])) for g in index["groups"]]
        except (OSError, ValueError, BitstreamError):
            return False
        end = len(self.init)
        for g, own in zip(index["groups"], ends, strict=True):  # a fragment of ours ends with its payload
            start, end = end, g["offset"] + g["size"]
            self.fragments.append((end - start, g["frames"], g["sync"], [end - start - g["size"] + e for e in own]))
        os.truncate(self.part, end)  # a fragment cut short by kill -9
        return True

    @property
    def groups(self) -> int:
        """Groups written so far."""
        return len(self.fragments)

    @property
    def frames(self) -> int:
        """Frames written so far."""
        return sum(f for _, f, *_ in self.fragments)

    @property
    def bytes(self) -> int:
        """Size of the file so far, without its index."""
        return len(self.init) + sum(s for s, *_ in self.fragments)

    def _state(self, groups: int) -> Path:
        return self.out.with_name(f"{self.out.name}.part.{groups}.npz")

    def state(self) -> dict[str, np.ndarray]:
        """`state` of the last `append`; {} if there is none, or no longer."""
        return read_arrays(self._state(self.groups)) or {}

    def append(self, payload: bytes, frames: int, *, sync: bool = True, state: dict[str, np.ndarray] | None = None):
        """Writes one group of `frames` frames; it is written when this returns. `state`: arrays that `state` returns to
        a run that continues after this group."""
        if state is not None:
            write_arrays(self._state(self.groups + 1), state)
        audio = self._audio and self._audio.between(self.frames, self.frames + frames, self._fps)
        data = _native.fragment(payload, self.groups + 1, self.frames, frames, sync, self.config, audio)
        self._file.write(data)
        self._file.flush()
        head = len(data) - len(payload)
        self.fragments.append((len(data), frames, sync, [head + e for e in layer_ends(_native.units(payload))]))
        self._state(self.groups - 1).unlink(missing_ok=True)

    def _forget(self) -> None:
        """Removes the files from which a later run could continue."""
        for path in self.out.parent.glob(f"{escape(self.part.name)}*"):
            path.unlink(missing_ok=True)

    def finish(self, *, keep_part: bool = False) -> None:
        """Writes OUT.gsv: init segment, index, fragments. `keep_part` keeps the files for a later run."""
        self._file.close()
        os.truncate(self.part, self.bytes)  # Ctrl-C may have come in the middle of a fragment
        indexed = self.out.with_name(self.out.name + ".indexed")
        with open(self.part, "rb") as source, open(indexed, "wb") as target:
            target.write(_native.finish(self.init, [self.fragments]))
            source.seek(len(self.init))
            shutil.copyfileobj(source, target, 1 << 20)
        os.replace(indexed, self.out)
        if not keep_part:
            self._forget()

    def close(self) -> None:
        """Closes the .part and leaves it as it is."""
        self._file.close()

    def abandon(self) -> None:
        """After a failure: keeps the .part, from which a later run continues, but removes it if it has no group."""
        self.close()
        if not self.groups:
            self._forget()


def layer_ends(units: list[dict]) -> list[int]:
    """Bytes of a payload up to the end of each layer."""
    return [max(u["offset"] + u["bytes"] for u in units if u["layer"] <= k) for k in range(units[-1]["layer"] + 1)]

"""Size, quality and time of gscodec and its peers on the same sequences: an entry of bench/results/rd.json per setting.

size      all bytes that decoding needs, side information and container included
quality   codec PSNR of `gscodec eval` on every fifth frame
time      frames in memory; encoding without training (one run), decoding to float attributes (median of 3)
If a peer orders its Gaussians once for the whole curve, that is not timed.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gscodec.decode import open_stream
from gscodec.encode.encode import StreamOutput, encode_groups, stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.errors import UsageError
from gscodec.fit import fit_groups
from gscodec.metrics import bd_rate, evaluate_splats, rising
from gscodec.metrics.bd_rate import shared_psnr
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.model.parametric_group import ParametricGroup

from .baselines import BASELINES, Baseline
from .machine import update_entries
from .sequences import SINGLE, open_case

OURS = "gscodec"
QUALITIES = (20, 30, 40, 50, 60, 70, 80, 90, 100)
CODECS = (OURS, *BASELINES)
DECODE_RUNS = 3
EVERY = 5  # PSNR is measured on every 5th frame
WITHIN = {"videogs": (39, 45), "videogs-raw": (39, 45)}  # peer -> range of PSNR of the BD-rate
USUAL = (39, 52)  # the range of the other peers
ONE_POINT = ("sog", "spz")
VIDEO = ("videogs", "videogs-raw", "x265", "svt-av1", "gsav", "webp")  # SH degree 0 and more than one frame
Group = DenseGroup | ParametricGroup


@dataclass(frozen=True)
class Coded:
    """A coded sequence, or its measured frames.

    Attributes:
        size: bytes.
        frames: number of frames coded.
        encode_s, decode_s: seconds for all these frames.
        decoded: frame -> Gaussians.
    """

    size: int
    frames: int
    encode_s: float
    decode_s: float
    decoded: Callable[[int], Gaussians]


def run(
    sequences: Iterable[str],
    codecs: Iterable[str],
    data: Path,
    work: Path,
    out: Path,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[dict]:
    """Yields the entries of each codec on each sequence and puts them into the result file `out` as they come.

    A curve whose data or tool is missing is left out, and `say` gets a line.
    """
    for sequence in sequences:
        for codec in codecs:
            try:
                yield from update(out, measure(sequence, codec, data, work))
            except UsageError as e:
                say(f"{sequence}, {codec}: left out, {e}")


def measure(sequence_name: str, codec: str, data: Path, work: Path) -> Iterator[dict]:
    """Yields the entries of a codec's curve on one sequence.

    Raises:
        UsageError: data or a tool is missing.
    """
    if sequence_name in SINGLE and codec in VIDEO:
        return
    sequence = open_case(sequence_name, data, work)
    groups = [_loaded(group) for group in sequence.groups]
    picked = list(range(0, sequence.frame_count, EVERY))
    settings = {f"quality {q}": {"quality": q} for q in QUALITIES} if codec == OURS else BASELINES[codec].settings
    alone = {"refine": EncodeSettings().rounding.still_views} if sequence_name in SINGLE and codec == OURS else {}
    for name, setting in settings.items():
        if codec == OURS:
            coded = _ours(sequence, groups, setting | alone)
        else:
            coded = _peer(BASELINES[codec], groups, picked, setting)
        quality = evaluate_splats(coded.decoded, sequence, picked)["codec_psnr"]
        yield {
            "sequence": sequence_name,
            "codec": codec,
            "setting": name,
            "kb_per_frame": round(coded.size / 1000 / coded.frames, 3),
            "codec_psnr": round(quality, 3),
            "encode_s_per_frame": round(coded.encode_s / coded.frames, 4),
            "decode_ms_per_frame": round(1000 * coded.decode_s / coded.frames, 2),
            "gaussians": len(sequence.frame(0)),
        }


def _loaded(group: Group) -> Group:
    """The group with its frames in memory."""
    return replace(group, frames=list(group.frames)) if isinstance(group, DenseGroup) else group


def _ours(sequence: GaussianSequence, groups: list[Group], setting: dict) -> Coded:
    """The sequence, coded by gscodec; motion is fitted to dense groups, which counts as encoding."""
    settings, first = EncodeSettings(**setting), [group.frame(0) for group in groups]
    fitting = {"random_access": settings.random_access, "quality": settings.quality}
    most, longest = max(map(len, first)), max(map(len, groups))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "rd.gsv")
        config = stream_config(fps=sequence.fps, sh_degree=first[0].sh_degree, gaussians=most, frames=longest)
        start = time.perf_counter()
        fitted = lambda done, _: fit_groups(groups, start=done, **fitting)  # noqa: E731
        report = encode_groups(fitted, StreamOutput(out, config), settings)
        encode_s = time.perf_counter() - start
        decoded, decode_s = _timed_decoding(lambda: _frames(out))
    return Coded(report.bytes, len(decoded), encode_s, decode_s, decoded.__getitem__)


def _frames(path: Path) -> list[Gaussians]:
    stream = open_stream(path)
    return [stream.frame(t) for t in range(stream.frame_count)]


def _timed_decoding(decode: Callable[[], list[Gaussians]]) -> tuple[list[Gaussians], float]:
    seconds = []
    for _ in range(DECODE_RUNS):
        start = time.perf_counter()
        decoded = decode()
        seconds.append(time.perf_counter() - start)
    return decoded, float(np.median(seconds))


def _peer(baseline: Baseline, groups: list[Group], picked: list[int], setting: dict) -> Coded:
    """The sequence, coded by a peer; a peer that codes each frame alone gets only the frames `picked`."""
    shown = [[group.visible(t) for t in range(len(group))] for group in groups]
    numbers = range(sum(map(len, shown)))
    if baseline.per_frame:
        numbers, frames = picked, [frame for group in shown for frame in group]
        shown = [[frames[t]] for t in picked]
    for frames in shown:
        baseline.prepare(frames[0])
    start = time.perf_counter()
    coded = [baseline.encode(frames, **setting) for frames in shown]
    encode_s = time.perf_counter() - start
    decoded, decode_s = _timed_decoding(lambda: [frame for files in coded for frame in baseline.decode(files)])
    size = sum(len(data) for files in coded for data in files.values())
    return Coded(size, len(decoded), encode_s, decode_s, dict(zip(numbers, decoded, strict=True)).__getitem__)


def update(path: Path, entries: Iterable[dict]) -> Iterator[dict]:
    """Yields entries and puts each into a result file, in place of an older one of the same setting.

    BD-rates and shares are computed again over the whole file.
    """
    return update_entries(path, entries, lambda e: (e["sequence"], e["codec"], e["setting"]), _whole)


def _whole(entries: list[dict]) -> dict:
    entries = sorted(entries, key=_place)
    derived = {"bd_rate": bd_rates(entries), "shares": shares(entries)}
    return {"settings": {"psnr_every": EVERY}, "entries": entries, **derived}


def _place(e: dict) -> tuple:
    codec = CODECS.index(e["codec"]) if e["codec"] in CODECS else len(CODECS)
    return e["sequence"], codec, e["kb_per_frame"]


def bd_rates(entries: Sequence[dict]) -> list[dict]:
    """BD-rates against each peer on each sequence where the curves share a range of PSNR; the strongest peer first."""
    found: list[dict] = []
    for name in dict.fromkeys(e["sequence"] for e in entries):
        curves = {c: rising(_points(entries, name, c)) for c in CODECS}
        for anchor in BASELINES:
            within = WITHIN.get(anchor, USUAL)
            try:
                percent = bd_rate(curves[anchor], curves[OURS], within=within)
            except UsageError:
                continue
            span = shared_psnr(curves[anchor], curves[OURS], within)
            found.append({"sequence": name, "anchor": anchor, "percent": round(percent, 2), "psnr": span})
    return sorted(found, key=lambda r: (r["sequence"], -r["percent"]))


def shares(entries: Sequence[dict]) -> list[dict]:
    """Size of a single frame of gscodec at the PSNR of the peers that have one setting.

    The size is interpolated: log size is linear in PSNR between two points. `kb` is None where the curve of gscodec
    does not reach the PSNR.
    """
    found = []
    for name in SINGLE:
        ours = rising(_points(entries, name, OURS))
        for peer in ONE_POINT:
            for kb, psnr in _points(entries, name, peer):
                own = None
                if ours and ours[0][1] <= psnr <= ours[-1][1]:
                    own = float(np.exp(np.interp(psnr, [p[1] for p in ours], np.log([p[0] for p in ours]))))
                    own = round(own, 3)
                found.append({"sequence": name, "peer": peer, "psnr": psnr, "kb": own, "peer_kb": kb})
    return found


def _points(entries: Sequence[dict], sequence: str, codec: str) -> list[tuple[float, float]]:
    of = [e for e in entries if (e["sequence"], e["codec"]) == (sequence, codec)]
    return [(e["kb_per_frame"], e["codec_psnr"]) for e in of]

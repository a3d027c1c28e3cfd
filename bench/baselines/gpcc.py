"""G-PCC, MPEG's codec of point clouds (ISO/IEC 23090-9), on each frame alone, through its test model TMC13.

It is on the PATH as tmc3 or named by the environment variable TMC3; https://github.com/MPEGGroup/mpeg-pcc-tmc13 builds
with cmake. Its times contain the start of the program and its .ply files.

A Gaussian is a point at integer coordinates with 8-bit attributes, the starting point of MPEG's exploration of Gaussian
splats. TMC13 reads one colour and one reflectance per point, so that a frame takes several runs: colours with
opacities, log scales, rotations (xyz with w), and one for each harmonic. The points are the same in all runs, and
counted once. Octree and RAHT with the options of the common test conditions for lossless geometry and lossy attributes,
sparse points. Two Gaussians in one place would be one point, so the second moves to the next free place.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gscodec.model.gaussians import Gaussians

from .tool import run_tool

SETTINGS = {
    f"{p} bit, QP {qp}": {"position": p, "qp": qp}
    for p, qp in ((11, 34), (12, 28), (13, 22), (14, 16), (16, 10), (16, 4))
}
GEOMETRY = "trisoupNodeSizeLog2=0 mergeDuplicatedPoints=0 positionQuantizationScale=1 autoSeqBbox=1 planarEnabled=1"
SPARSE = "inferredDirectCodingMode=3 maxNumQtBtBeforeOt=6 minQtbtSizeLog2=0 planarModeIdcmUse=32"
CONTEXTS = "neighbourAvailBoundaryLog2=8 intra_pred_max_node_size_log2=6 rahtPredictionSearchRange=2500"
POINTS, ATTRIBUTES = 2, (4, 7)  # types of units of the byte stream that hold points, or attributes
STEPS = 255  # quantization steps of an attribute
NEEDED = "the G-PCC baseline needs tmc3; build it from https://github.com/MPEGGroup/mpeg-pcc-tmc13"


def encode(frames: Sequence[Gaussians], position: int, qp: int) -> dict[str, bytes]:
    """Codes frames with `position` bits and the quantization parameter `qp` of the attributes; returns their files."""
    files = {}
    for t, g in enumerate(frames):
        values = _attributes(g)
        low, high, corner = values.min(0), values.max(0), g.means.min(0)
        codes = np.rint((values - low) / np.where(high > low, high - low, 1) * STEPS).astype(np.uint8)
        step = (g.means.max(0) - corner).max() / (2**position - 1)
        places = _apart(np.rint((g.means - corner) / step).astype(np.int64))
        for k, run in enumerate(_runs(codes.shape[1])):
            units = _coded(places, codes[:, run], qp, colours=k == 0)
            files[f"{t}.{k}"] = b"".join(u for u in units if k == 0 or u[0] != POINTS)
        files[f"{t}.ranges"] = np.concatenate([corner, [step], low, high]).astype(np.float32).tobytes()
    return files


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames; their Gaussians are in the order of the octree."""
    frames = []
    for name in (n for n in files if n.endswith(".ranges")):
        t, ranges = name.split(".")[0], np.frombuffer(files[name], np.float32)
        low, high = ranges[4:].reshape(2, -1)
        points = [u for u in _units(files[f"{t}.0"]) if u[0] == POINTS]
        parts = []
        for k, run in enumerate(_runs(len(low))):
            units = list(_units(files[f"{t}.{k}"]))
            if k:
                at = next((i for i, u in enumerate(units) if u[0] in ATTRIBUTES), len(units))
                units[at:at] = points
            places, codes = _decoded(b"".join(units), len(run), colours=k == 0)
            parts.append(codes)
        v = np.concatenate(parts, 1) / STEPS * (high - low) + low
        quats = np.where(v[:, 7:11].any(1, keepdims=True), v[:, 7:11], (0, 0, 0, 1))[:, [3, 0, 1, 2]]
        means, shN = places * ranges[3] + ranges[:3], v[:, 11:].reshape(len(v), -1, 3)
        frames.append(Gaussians(means, quats, v[:, 4:7], v[:, 3], v[:, :3], shN).validate("G-PCC"))
    return frames


def _attributes(g: Gaussians) -> np.ndarray:
    """[N, C]: colours, opacity, log scales, rotation xyzw, harmonics."""
    quats = g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True)
    quats = np.where(quats[:, :1] < 0, -quats, quats)[:, [1, 2, 3, 0]]
    return np.concatenate([g.sh0, g.logit_opacities[:, None], g.log_scales, quats, g.shN.reshape(len(g), -1)], 1)


def _runs(channels: int) -> list[range]:
    """The attributes of each run, three or four."""
    return [range(4), range(4, 7), range(7, 11), *(range(c, c + 3) for c in range(11, channels, 3))]


def _apart(places: np.ndarray) -> np.ndarray:
    """The integer positions [N, 3], each moved until it has a place of its own."""
    random = np.random.default_rng(0)
    while True:
        _, first = np.unique(places @ (1 << np.array([0, 20, 40])), return_index=True)
        taken = np.setdiff1d(np.arange(len(places)), first)
        if not len(taken):
            return places
        places[taken, random.integers(3, size=len(taken))] += 1


def _coded(places: np.ndarray, codes: np.ndarray, qp: int, *, colours: bool) -> Iterator[bytes]:
    """The units of one run."""
    names = ["red", "green", "blue", "refc"][: codes.shape[1]]
    kinds = ["<u1"] * 3 + ["<u2"]
    cloud = np.zeros(len(places), [*zip("xyz", ["<f4"] * 3, strict=True), *zip(names, kinds, strict=False)])
    for name, column in zip(cloud.dtype.names, [*places.T, *codes.T], strict=True):
        cloud[name] = column
    types = {"<f4": "float", "|u1": "uchar", "<u2": "uint16"}
    properties = "".join(f"property {types[cloud.dtype[n].str]} {n}\n" for n in cloud.dtype.names)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    with tempfile.TemporaryDirectory() as folder:
        ply, out = Path(folder, "in.ply"), Path(folder, "out.bin")
        ply.write_bytes(head.encode() + cloud.tobytes())
        options = f"mode=0 {GEOMETRY} {SPARSE} {CONTEXTS} convertPlyColourspace={int(colours)} transformType=0"
        attributes = f"qp={qp} bitdepth=8 attribute=reflectance " * ("refc" in names) + f"qp={qp} bitdepth=8"
        if not colours:
            attributes += " colourMatrix=0"
        _run(f"{options} {attributes} attribute=color", f"uncompressedDataPath={ply}", f"compressedStreamPath={out}")
        return _units(out.read_bytes())


def _decoded(stream: bytes, channels: int, *, colours: bool) -> tuple[np.ndarray, np.ndarray]:
    """Places [N, 3] and codes [N, `channels`] of one run."""
    with tempfile.TemporaryDirectory() as folder:
        source, ply = Path(folder, "in.bin"), Path(folder, "out.ply")
        source.write_bytes(stream)
        options = f"mode=1 convertPlyColourspace={int(colours)} outputScaling=0 outputBinaryPly=1"
        _run(options, f"compressedStreamPath={source}", f"reconstructedDataPath={ply}")
        head, data = ply.read_bytes().split(b"end_header\n", 1)
    types = {"float64": "<f8", "uchar": "<u1", "uint16": "<u2"}
    lines = [line.split() for line in head.decode().split("\n") if line.startswith("property") and "list" not in line]
    cloud = np.frombuffer(data, [(name, types[kind]) for _, kind, name in lines])
    names = ["red", "green", "blue", "refc"][:channels]
    return np.stack([cloud[n] for n in "xyz"], 1), np.stack([cloud[n] for n in names], 1)


def _units(stream: bytes) -> Iterator[bytes]:
    """The units of a byte stream: type, length (4 bytes) and payload."""
    while stream:
        end = 5 + int.from_bytes(stream[1:5], "big")
        yield stream[:end]
        stream = stream[end:]


def _run(options: str, *paths: str) -> None:
    run_tool("tmc3", "TMC3", NEEDED, [f"--{o}" for o in (*options.split(), *paths)])

"""Stands in for tmc3 where TMC13 is not built: the same options, units and .ply files, without compression."""

import sys
from pathlib import Path

import numpy as np

KINDS = {"float": "<f4", "float64": "<f8", "uchar": "<u1", "uint16": "<u2"}
OUTPUT = {"x": "float64", "y": "float64", "z": "float64", "green": "uchar", "blue": "uchar", "red": "uchar"}


def unit(kind: int, payload: bytes) -> bytes:
    return bytes([kind]) + len(payload).to_bytes(4, "big") + payload


def encode(ply: Path, out: Path) -> None:
    head, data = ply.read_bytes().split(b"end_header\n", 1)
    lines = [line.split() for line in head.decode().split("\n") if line.startswith("property")]
    cloud = np.frombuffer(data, [(name, KINDS[kind]) for _, kind, name in lines])
    cloud = cloud[np.lexsort([cloud[n] for n in "xyz"])]  # not the order of the input
    assert len(np.unique(cloud[list("xyz")])) == len(cloud), "two points in one place"
    places = np.stack([cloud[n] for n in "xyz"], 1).astype("<f8")
    names = [n for n in cloud.dtype.names if n not in "xyz"]
    attributes = b"".join(unit(4, n.encode() + b"\0" + cloud[n].tobytes()) for n in names)
    out.write_bytes(unit(0, b"parameters") + unit(2, places.tobytes()) + attributes)


def decode(stream: Path, ply: Path) -> None:
    data, columns, places = stream.read_bytes(), {}, None
    while data:
        kind, end = data[0], 5 + int.from_bytes(data[1:5], "big")
        if kind == 2:
            places = np.frombuffer(data[5:end], "<f8").reshape(-1, 3)
        if kind == 4:
            assert places is not None, "attributes before their points"
            name, values = data[5:end].split(b"\0", 1)
            columns[name.decode()] = values
        data = data[end:]
    kinds = {n: kind for n, kind in {**OUTPUT, "refc": "uint16"}.items() if n in "xyz" or n in columns}
    cloud = np.zeros(len(places), [(n, KINDS[kind]) for n, kind in kinds.items()])
    for name, kind in kinds.items():
        cloud[name] = places[:, "xyz".index(name)] if name in "xyz" else np.frombuffer(columns[name], KINDS[kind])
    properties = "".join(f"property {kind} {name}\n" for name, kind in kinds.items())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}"
    faces = "element face 0\nproperty list uint8 int32 vertex_index\nend_header\n"
    ply.write_bytes((head + faces).encode() + cloud.tobytes())


options = dict(argument.removeprefix("--").split("=", 1) for argument in sys.argv[1:])
stream = Path(options["compressedStreamPath"])
if options["mode"] == "0":
    encode(Path(options["uncompressedDataPath"]), stream)
else:
    decode(stream, Path(options["reconstructedDataPath"]))

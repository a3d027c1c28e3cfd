"""The PLY container: header and element tables. splats/ and capture/ interpret the properties.

Plain numpy, so that the player's side can read and write it. Reading stops at the first element with a list property
(the faces of a mesh): splats do not need it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .atomic_write import part_file
from .errors import CaptureError

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
NAMES = {"u1": "uchar", "u4": "uint", "f4": "float"}  # the types that are written
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_MAX = 1 << 20  # bytes; a file whose header does not end by then is not a PLY


def read_header(path: Path) -> tuple[str, dict[str, tuple[int, np.dtype]], int]:
    """Reads the header.

    Returns:
        The byte order ("" for ascii, "<", ">"), element name -> (count, row dtype) in file order, and the offset of the
        data in bytes.

    Raises:
        CaptureError: the file is missing or not a PLY.
    """
    if not path.is_file():
        raise CaptureError(f"{path}: no such file, expected a .ply")
    with path.open("rb") as f:
        head = f.read(HEADER_MAX)
    end = head.find(b"end_header")
    start = head.find(b"\n", end) + 1
    if not head.startswith((b"ply\n", b"ply\r")) or end < 0 or not start:
        raise CaptureError(f"{path}: not a PLY file, expected it to open with 'ply' and a header up to 'end_header'")
    order, elements, name = None, {}, ""
    for number, line in enumerate(head[:end].decode("latin-1").splitlines()[1:], 2):
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = ORDERS[words[1]]
            elif words[:1] == ["element"]:
                name, count = words[1], int(words[2])
                elements[name] = (count, [])
            elif words[:2] == ["property", "list"]:
                elements[name][1].append(None)
            elif words[:1] == ["property"]:
                elements[name][1].append((words[2], (order or "<") + TYPES[words[1]]))
        except (KeyError, IndexError, ValueError, TypeError) as e:
            raise CaptureError(f"{path}: header line {number} is not valid PLY: {line.strip()!r}") from e
    if order is None:
        raise CaptureError(f"{path}: the header names no known format, expected {' or '.join(ORDERS)}")
    return order, _dtypes(path, elements), start


def _dtypes(path: Path, elements: dict) -> dict[str, tuple[int, np.dtype]]:
    out = {}
    for name, (count, properties) in elements.items():
        if None in properties:
            break
        try:
            out[name] = count, np.dtype(properties)
        except ValueError as e:
            raise CaptureError(f"{path}: element {name} has a property twice ({e})") from e
        if count < 0:
            raise CaptureError(f"{path}: element {name} has a count of {count}")
    return out


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Element name -> structured array, one field per property.

    Raises:
        CaptureError: not a PLY, or the data is shorter than the header says.
    """
    order, elements, start = read_header(path)
    data = memoryview(path.read_bytes())[start:]
    if not order:
        return _read_ascii(path, elements, data)
    out, at = {}, 0
    for name, (count, dtype) in elements.items():
        size = count * dtype.itemsize
        if at + size > len(data):
            rows = (len(data) - at) // dtype.itemsize
            raise CaptureError(f"{path}: truncated, {rows} of {count} rows of element {name} are there")
        out[name] = np.frombuffer(data[at : at + size], dtype)
        at += size
    return out


def _read_ascii(path: Path, elements: dict[str, tuple[int, np.dtype]], data: memoryview) -> dict[str, np.ndarray]:
    words, out, at = bytes(data).split(), {}, 0
    for name, (count, dtype) in elements.items():
        columns = len(dtype.names or ())
        rows = words[at : at + count * columns]
        if len(rows) < count * columns:
            have = len(rows) // columns
            raise CaptureError(f"{path}: truncated, {have} of {count} rows of element {name} are there")
        try:
            numbers = np.array(rows, np.float64).reshape(count, columns)
        except ValueError as e:
            raise CaptureError(f"{path}: element {name} has a value that is not a number ({e})") from e
        out[name] = np.empty(count, dtype)
        for k, field in enumerate(dtype.names or ()):
            out[name][field] = numbers[:, k]
        at += count * columns
    return out


def write_table(path: Path, elements: dict[str, np.ndarray], comment: str = "gscodec") -> None:
    """Writes structured arrays (u1, u4 and f4 fields) as binary little-endian PLY."""
    lines = ["ply", "format binary_little_endian 1.0", f"comment {comment}"]
    for name, rows in elements.items():
        lines.append(f"element {name} {len(rows)}")
        lines += [f"property {NAMES[rows.dtype[f].str[1:]]} {f}" for f in rows.dtype.names]
    with part_file(path) as part, part.open("wb") as f:
        f.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        for rows in elements.values():
            f.write(rows.tobytes())

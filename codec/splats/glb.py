"""Gaussians -> binary glTF 2.0 with KHR_gaussian_splatting (Khronos, release candidate of 2026).

One point primitive with the attributes of the ellipse kernel, all f32, and COLOR_0 for viewers without the extension.
Values stay as they are: the node turns the scene upright, since glTF has y up and z to the front.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from ..atomic_write import part_file
from ..errors import CaptureError
from ..model.gaussians import SH_C0, Gaussians, sigmoid

EXTENSION = "KHR_gaussian_splatting"
KERNEL = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
HALF = float(np.sqrt(0.5))
UPRIGHT = {  # up axis of the scene -> quaternion xyzw that turns it to +y
    "y": (0.0, 0.0, 0.0, 1.0),
    "-y": (0.0, 0.0, 1.0, 0.0),  # about z: the front of a .ply stays in front
    "z": (-HALF, 0.0, 0.0, HALF),
    "-z": (HALF, 0.0, 0.0, HALF),
    "x": (0.0, 0.0, HALF, HALF),
    "-x": (0.0, 0.0, -HALF, HALF),
}
FLOAT, ARRAY_BUFFER, POINTS = 5126, 34962, 0  # of glTF
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
SIZE_MAX = 2**32 - 1  # bytes of a .glb


def write_glb(path: Path, gaussians: Gaussians, up: str = "-y") -> None:
    """Writes one frame.

    Args:
        up: axis of the scene that points up, e.g. "-y" as in most .ply.

    Raises:
        CaptureError: there are no Gaussians, or too many for a .glb.
    """
    if not len(gaussians):
        raise CaptureError(f"{path}: no Gaussians to write; glTF has no empty meshes, use .ply for an empty frame")
    columns = _attributes(gaussians)
    binary = b"".join(np.ascontiguousarray(a, "<f4").tobytes() for a in columns.values())
    text = json.dumps(_document(columns, len(binary), up), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    if size > SIZE_MAX:
        raise CaptureError(f"{path}: {size} bytes, a .glb has at most {SIZE_MAX}; write .ply or .spz")
    with part_file(path) as part, part.open("wb") as f:
        f.write(b"glTF" + struct.pack("<II", 2, size))
        f.write(struct.pack("<I4s", len(text), b"JSON") + text)
        f.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)


def _attributes(g: Gaussians) -> dict[str, np.ndarray]:
    """Semantic -> [N, C] f32."""
    opacity = sigmoid(g.logit_opacities)[:, None]
    display = np.clip(g.sh0.astype(np.float64) * SH_C0 + 0.5, 0, 1)
    linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)  # COLOR_0 is linear
    out = {
        "POSITION": g.means,
        "COLOR_0": np.concatenate([linear, opacity], 1),
        f"{EXTENSION}:ROTATION": np.roll(g.quats, -1, 1),  # xyzw
        f"{EXTENSION}:SCALE": np.exp(g.log_scales.astype(np.float64)),
        f"{EXTENSION}:OPACITY": opacity,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": g.sh0,
    }
    for degree in range(1, g.sh_degree + 1):
        first = degree * degree - 1
        for n in range(2 * degree + 1):
            out[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}"] = g.shN[:, first + n]
    return {n: a.astype(np.float32) for n, a in out.items()}


def _document(columns: dict[str, np.ndarray], size: int, up: str) -> dict:
    views, accessors, at = [], [], 0
    for name, a in columns.items():
        views.append({"buffer": 0, "byteOffset": at, "byteLength": a.nbytes, "target": ARRAY_BUFFER})
        accessor = {"bufferView": len(accessors), "componentType": FLOAT, "count": len(a), "type": TYPES[a.shape[1]]}
        if name == "POSITION":
            accessor |= {"min": a.min(0).tolist(), "max": a.max(0).tolist()}
        accessors.append(accessor)
        at += a.nbytes
    attributes = {name: i for i, name in enumerate(columns)}
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: KERNEL}}
    return {
        "asset": {"version": "2.0", "generator": "gscodec"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": list(UPRIGHT[up])}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }

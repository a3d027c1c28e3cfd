"""3D Gaussian Splatting .ply <-> Gaussians (the layout of Kerbl et al. 2023 that every splat tool knows).

One element `vertex`. Properties are found by name: their order, their float width and unknown ones do not matter.
f_rest is channel-major: all coefficients of red, then green, then blue. Values are stored as in Gaussians (log scales,
logit opacities, quaternions wxyz), so that writing and reading back is exact.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.gaussians import SH_COUNTS, Gaussians
from ..ply_table import write_table

FIELDS = {
    "means": ("x", "y", "z"),
    "sh0": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "logit_opacities": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}


def sh_count(names: tuple[str, ...], where: Path) -> int:
    """K, the number of SH coefficients per channel, from the names of the f_rest properties.

    Raises:
        CaptureError: no SH degree from 0 to 3 has that many.
    """
    rest = sum(n.startswith("f_rest_") for n in names)
    if rest % 3 or rest // 3 not in SH_COUNTS or any(f"f_rest_{i}" not in names for i in range(rest)):
        raise CaptureError(f"{where}: {rest} f_rest properties, expected f_rest_0 to _8, _23 or _44 (SH degree 1 to 3)")
    return rest // 3


def stack(rows: np.ndarray, names: tuple[str, ...] | list[str]) -> np.ndarray:
    """[N, len(names)] f32 of the named fields."""
    return np.stack([rows[n].astype(np.float32) for n in names], 1)


def split_rest(rest: np.ndarray) -> np.ndarray:
    """[N, 3 K] channel-major f_rest -> [N, K, 3] shN."""
    return np.ascontiguousarray(rest.reshape(len(rest), 3, -1 if len(rest) else rest.shape[1] // 3).swapaxes(1, 2))


def join_rest(shN: np.ndarray) -> np.ndarray:
    """[N, K, 3] shN -> [N, 3 K] channel-major f_rest."""
    return shN.swapaxes(1, 2).reshape(len(shN), 3 * shN.shape[1])


def gaussians_of(table: dict[str, np.ndarray], path: Path) -> Gaussians:
    """The Gaussians of an element table in the 3DGS layout.

    Raises:
        CaptureError: no Gaussian splats, or a value is not finite.
    """
    rows = table.get("vertex")
    names = rows.dtype.names or () if rows is not None else ()
    missing = [n for wanted in FIELDS.values() for n in wanted if n not in names]
    if missing:
        raise CaptureError(
            f"{path}: no property {', '.join(missing)} in element vertex, expected a Gaussian splat "
            "(3DGS .ply or SuperSplat .compressed.ply), not a mesh or a point cloud"
        )
    k = sh_count(names, path)
    parts = {name: stack(rows, wanted) for name, wanted in FIELDS.items()}
    parts["logit_opacities"] = parts["logit_opacities"][:, 0]
    rest = stack(rows, [f"f_rest_{i}" for i in range(3 * k)]) if k else np.zeros((len(rows), 0), np.float32)
    return Gaussians(shN=split_rest(rest), **parts).validate(str(path))


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Writes binary little-endian 3DGS .ply with the properties in the reference implementation's order."""
    g, rest = gaussians, join_rest(gaussians.shN)
    normals = np.zeros((len(g), 3), np.float32)  # unused, but old loaders need the properties
    columns = [g.means, normals, g.sh0, rest, g.logit_opacities[:, None], g.log_scales, g.quats]
    names = [*FIELDS["means"], "nx", "ny", "nz", *FIELDS["sh0"], *(f"f_rest_{i}" for i in range(rest.shape[1]))]
    names += [*FIELDS["logit_opacities"], *FIELDS["log_scales"], *FIELDS["quats"]]
    flat = np.ascontiguousarray(np.concatenate(columns, 1), "<f4")
    write_table(path, {"vertex": flat.view([(n, "<f4") for n in names])[:, 0] if len(flat) else _empty(names)})


def _empty(names: list[str]) -> np.ndarray:
    return np.zeros(0, [(n, "<f4") for n in names])

"""A coded track -> tracks with some of its Gaussians each. Integers are copied, not quantized again.

All integers except rotations stay, and so do their decoded values: every Gaussian keeps its grid, its steps and the
nodes that carry it. A rotation is coded as the residual to that of a neighbour (spec 13.1), which may be in another
track: so rotations are rounded once more, by their own steps.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import _native
from ..bitstream.quantized_group import QuantizedGroup, QuantizedNodes, QuantizedTrajectories
from ..decode.stream import Stream
from .companding import Curve
from .quantize import dequantize
from .rewriting import sound_of, writer_like
from .rotation_residuals import step_factors


def can_split(stream: Stream) -> bool:
    """Whether the groups of `stream` have one layer each; with more, a layer of a part could be empty."""
    return all(len(stream.group(i).layers) == 1 for i in range(len(stream.groups)))


def split_stream(stream: Stream, labels: list[np.ndarray], outs: list[Path]) -> None:
    """Writes the Gaussians of `stream` with label k ([N] of each group) as the stream outs[k]. The first one has the
    sound."""
    whole = hashlib.sha256(stream.bytes_at(0, stream.file_size)).hexdigest()[:16]
    for k, out in enumerate(outs):
        writer = writer_like(stream, out, {"whole": whole, "part": k}, None if k else sound_of(stream))
        there = writer.groups  # groups of an interrupted run
        parts: list[tuple[np.ndarray, QuantizedGroup, object] | None] = []
        for i, own in enumerate(labels):
            decoded, back = stream.group(i), stream.group(i).reference
            index, reference = np.flatnonzero(own == k), parts[i - back] if back else None
            q = _picked(decoded.quantized(), decoded, index, reference)
            payload = _native.encode_group(q, reference and reference[2])[0]
            options = {"reference": reference[2]} if reference else {}
            parts.append((index, q, _native.DecodedGroup(payload, stream.config["level"], **options)))
            if i >= there:
                writer.append(payload, q.frames, sync=stream.groups[i]["sync"])
        writer.finish()


def _picked(q: QuantizedGroup, decoded, index: np.ndarray, reference: tuple | None) -> QuantizedGroup:
    """The Gaussians at `index` of a group of one layer.

    Args:
        reference: index, integers and decoded form of the reference's part, if the group is predicted.
    """
    channels = {n: replace(c, values=np.ascontiguousarray(c.values[:, index])) for n, c in q.channels.items()}
    trajectories = {}
    for name, t in q.trajectories.items():
        c = t.coefficients[:, :, index]
        used = np.flatnonzero(c.any((1, 2)))
        if len(used):
            trajectories[name] = QuantizedTrajectories(np.ascontiguousarray(c[: used[-1] + 1]), t.step)
    part = replace(
        q,
        positions=q.positions[index],
        channels=channels,
        trajectories=trajectories,
        nodes=_nodes(q, index),
        lifetimes=None if q.lifetimes is None else q.lifetimes[index],
        layers=(len(index),),
        parents=_parents(q.parents[index], reference[0]) if reference else None,
    )
    return _with_rotations(part, decoded.canonical()["quats"][index], reference and reference[1])


def _parents(parents: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Parents as indices in the reference's part, which has the Gaussians `reference` of the whole reference."""
    place = np.full(max(parents.max(initial=-1), reference.max(initial=-1)) + 2, -1)
    place[reference] = np.arange(len(reference))
    return place[parents].astype(np.int32)  # a birth, -1, indexes the last entry, which is -1


def _nodes(q: QuantizedGroup, index: np.ndarray) -> QuantizedNodes | None:
    """The nodes that carry the Gaussians at `index`: the nearest nodes of each, and the next nearest one, on whose
    distance their weights depend (spec 13.2)."""
    if q.nodes is None or not len(index):
        return None
    positions = np.ascontiguousarray(q.positions[index])
    used = np.unique(_native.node_weights(positions, q.nodes.positions, q.nodes.neighbors + 1)[0])
    coefficients = np.ascontiguousarray(q.nodes.coefficients[:, :, used])
    return replace(q.nodes, positions=q.nodes.positions[used], coefficients=coefficients)


def _with_rotations(part: QuantizedGroup, quats: np.ndarray, reference: QuantizedGroup | None) -> QuantizedGroup:
    """The part with integers for its rotations `quats` [N, 4], as they are in the whole; survivors have the integers of
    the reference."""
    channels, sizes = part.channels["quats"], part.channels["log_scales"]
    curves = None if sizes.companding is None else [Curve.of(row) for row in sizes.companding]
    steps = np.minimum(channels.steps * step_factors(dequantize(sizes, curves), part.scale_exponents), 1)
    born = np.ones(len(part), bool) if reference is None else part.parents < 0
    values = np.zeros_like(channels.values)
    if born.any():
        given = np.ascontiguousarray(quats[born], np.float32), np.ascontiguousarray(steps[born], np.float32)
        plain = np.zeros_like(given[1]), np.zeros(0, np.float32)  # without a price of bits
        values[:, born] = _native.quantize_rotations(*given, part.positions[born], *plain)[0].T
    if reference is not None:
        values[:, ~born] = reference.channels["quats"].values[:, part.parents[~born]]
    quats_of = replace(channels, values=np.ascontiguousarray(values))
    return replace(part, channels={**part.channels, "quats": quats_of})

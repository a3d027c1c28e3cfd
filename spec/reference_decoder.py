"""Reference decoder of the gsv bitstream: the second implementation, written from gsv.md alone and in its order.

In: the bytes of a .gsv file. Out: for each group the decoded integers, exactly, and any frame of it in float64.
It imports numpy and the standard library only, uses the names of gsv.md, and is written to be read, not to be fast:
entropy decoding works on Python integers, bin after bin. Strict: one damaged unit makes the group a BitstreamError.

    reference_container.py  clauses 1, 2      reference_integers.py    clauses 7 to 12, one unit each
    reference_units.py      clauses 3 to 5    reference_group.py       clauses 3 to 12, a whole group
    reference_entropy.py    clause 6          reference_evaluation.py  clause 13
    reference_scene.py      clause 2.8

    python spec/reference_decoder.py FILE.gsv [--npz OUT.npz]     prints the conformance hash (clause 16) of each group
"""

import argparse
import hashlib
import struct
import sys
from pathlib import Path

import numpy as np
from reference_container import BitstreamError, LimitError, read_container, require
from reference_group import decode_group
from reference_units import ATTRIBUTES, LOG_SCALES, MEANS, SHN, read_reference


def arrays(group):
    """Clause 16: the decoded arrays in their order; None where the group has none."""
    yield "positions", group.positions
    for a in range(LOG_SCALES, SHN + 1):
        yield f"channels_{ATTRIBUTES[a]}", group.channels.get(a)
    yield "lifetimes", group.lifetimes
    yield "node_positions", group.node_positions
    yield "node_trajectories", group.node_trajectories
    for a in range(MEANS, SHN + 1):
        yield f"trajectories_{ATTRIBUTES[a]}", group.trajectories.get(a)
    if group.rig is not None:
        yield "joints", group.rig.joints
        yield "parents", group.rig.parents
        yield "bind", group.rig.bind
        yield "weights", group.rig.weights
        yield "joint_poses", group.rig.poses


def hash_arrays(frames, grid_bits, arrays):
    """Clause 16: SHA-256 of the canonical serialization of the decoded integers."""
    digest = hashlib.sha256(struct.pack("<2i", frames, grid_bits))
    for array in arrays:
        shape = () if array is None else array.shape
        digest.update(struct.pack(f"<{1 + len(shape)}i", len(shape), *shape))
        digest.update(b"" if array is None else np.ascontiguousarray(array, "<i4").tobytes())
    return digest.hexdigest()


def group_hash(group):
    return hash_arrays(group.header.frames, group.header.grid_bits, [array for _, array in arrays(group)])


def decode(data, track=0):
    """A whole file -> (Config, [(Sample, Group)]) of one of its tracks."""
    config, samples = read_container(data, track)
    groups = []
    for i, sample in enumerate(samples):
        back = read_reference(sample.payload)
        require(back <= i, f"group {i}: it refers to the group {back} before it, which is before the first")
        require(not back or not sample.sync, f"group {i}: it is predicted, but its sample is a sync sample")
        reference = groups[i - back] if back else None
        group = decode_group(sample.payload, config.level, sample.frames, reference)
        told, got = config.sh_degree, group.header.sh_degree
        require(got <= told, f"group_header: sh_degree is {got}, but gsvC allows {told}")
        groups.append(group)
    return config, list(zip(samples, groups, strict=True))


def main():
    parser = argparse.ArgumentParser(description="Decode a .gsv file with the reference decoder.")
    parser.add_argument("file", type=Path)
    parser.add_argument("--npz", type=Path, help="write the decoded integers of all groups here")
    options = parser.parse_args()
    try:
        _, groups = decode(options.file.read_bytes())
    except (BitstreamError, LimitError) as error:
        sys.exit(f"{type(error).__name__}: {error}")
    for sample, group in groups:
        print(f"{group_hash(group)}  frames {sample.start_frame} to {sample.start_frame + sample.frames - 1}")
    if options.npz:
        named = {
            f"group{g}_{name}": a for g, (_, group) in enumerate(groups) for name, a in arrays(group) if a is not None
        }
        np.savez_compressed(options.npz, **named)


if __name__ == "__main__":
    main()

"""QuantizedGroup to the native coder and back: all fields are coded, errors are named, reconstruction is decoding."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from quantized_groups import assert_same, layered_group, moving_group, predicted_group, surface_group, with_channels

from gscodec import _native
from gscodec.bitstream.quantized_group import QuantizedChannels, QuantizedGroup, QuantizedNodes, QuantizedTrajectories

QUANTIZED = (QuantizedGroup, QuantizedChannels, QuantizedTrajectories, QuantizedNodes)


class Recorder:
    """Stands in for a dataclass and notes which of its fields are read."""

    def __init__(self, instance, read):
        self._instance, self._read = instance, read

    def __getattr__(self, name):
        self._read.add((type(self._instance), name))
        return recorded(getattr(self._instance, name), self._read)


def recorded(value, read):
    if isinstance(value, dict):
        return {k: recorded(v, read) for k, v in value.items()}
    return Recorder(value, read) if type(value) in QUANTIZED else value


def test_every_field_of_the_integers_is_coded():
    """The native mirror of QuantizedGroup includes every field, in both directions."""
    first = layered_group()
    known = _native.DecodedGroup(_native.encode_group(first)[0], 1)
    group, read = predicted_group(first), set()
    for f in fields(group):
        assert getattr(group, f.name) is not None, f.name
    payload, _ = _native.encode_group(recorded(group, read), known)
    assert read == {(c, f.name) for c in QUANTIZED for f in fields(c)}
    assert payload == _native.encode_group(group, known)[0]
    assert_same(first, known.quantized())
    decoded = _native.DecodedGroup(payload, 1, reference=known)
    assert_same(group, decoded.quantized())
    assert _native.encode_group(decoded.quantized(), known)[0] == payload


@pytest.mark.parametrize(
    "group", [surface_group(), moving_group(), layered_group()], ids=["still", "moving", "layered"]
)
def test_reconstruction_is_what_decoding_gives(group):
    decoded = _native.DecodedGroup(_native.encode_group(group)[0], 1)
    assert_reconstructs(decoded, _native.DecodedGroup.reconstruct(group))


def test_reconstruction_of_a_predicted_group_is_what_decoding_gives():
    first = layered_group()
    known, group = _native.DecodedGroup.reconstruct(first), predicted_group(first)
    reference = _native.DecodedGroup(_native.encode_group(first)[0], 1)
    decoded = _native.DecodedGroup(_native.encode_group(group, reference)[0], 1, reference=reference)
    assert_reconstructs(decoded, _native.DecodedGroup.reconstruct(group, reference))
    assert_reconstructs(decoded, _native.DecodedGroup.reconstruct(group, known))
    with pytest.raises(ValueError, match="a predicted group: expected its reference"):
        _native.DecodedGroup.reconstruct(group)


def assert_reconstructs(decoded, made):
    """Compares all frames bit by bit."""
    assert_same(decoded.quantized(), made.quantized())
    for t in range(decoded.frames):
        frame, want = made.frame(t), decoded.frame(t)
        assert set(frame) == set(want)
        for name in want:
            assert frame[name].tobytes() == want[name].tobytes(), f"frame {t}, {name}"
        assert np.array_equal(made.visible(t), decoded.visible(t))
    for own, their in ((made.carried(), decoded.carried()), (made.blend(), decoded.blend())):
        assert [a.tobytes() for a in own] == [a.tobytes() for a in their]


def test_reconstruction_names_what_cannot_be_coded():
    with pytest.raises(ValueError, match="frames"):
        _native.DecodedGroup.reconstruct(replace(surface_group(10), frames=0))


def trajectory(*shape):
    return QuantizedTrajectories(np.zeros(shape, np.int32), 1.0)


STILL = trajectory(1, 3, 10)
NODE = QuantizedNodes(np.zeros((1, 3), np.uint32), np.zeros((1, 6, 1), np.int32), 1.0, 1.0, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": None}, "expected 'positions', there is none"),
        ({"positions": np.array([[1, 0, 0], [0, 0, 0]] + [[1, 1, 1]] * 8, np.uint32)}, "Morton order"),
        ({"positions": np.full((10, 3), 1024, np.uint32)}, r"below 2\^10"),
        ({"positions": np.full((10, 3), 0.5)}, "'positions': expected integers that fit uint32"),
        ({"positions": np.zeros(10, np.uint32)}, r"'positions': expected shape \[N, 3\]"),
        ({"positions": np.zeros((10, 2), np.uint32)}, r"positions: expected shape \[N, 3\], got \[10, 2\]"),
        ({"positions": np.zeros((9, 3), np.uint32)}, r"log_scales: expected shape \[3, 9\], got \[3, 10\]"),
        ({"frames": 0}, "frames"),
        ({"frames": None}, "expected 'frames', there is none"),
        ({"frames": "many"}, "'frames': unexpected value many"),
        ({"grid_bits": 22}, "grid_bits"),
        ({"grid_step": 0.0}, "grid_step"),
        ({"origin": np.array([0, np.nan, 0])}, "origin"),
        ({"origin": np.zeros(2)}, "'origin': unexpected value"),
        ({"channels": None}, "expected 'channels', there is none"),
        ({"scale_exponents": np.full((3, 3), 128)}, "'scale_exponents': unexpected value"),
        ({"layers": (4, 4)}, r"layers: expected counts that sum up to 10, got \[4, 4\]"),
        ({"layers": (4, 6), "shifts": np.zeros((2, 6), np.uint8)}, "shifts: expected 5 numbers for each of 2 layers"),
        ({"shifts": np.full((1, 5), 1, np.uint8)}, "layer 0: expected integers that are multiples of"),
        ({"corrections": np.zeros((2, 2))}, "a correction for each layer"),
        ({"parents": np.zeros(10, np.int32)}, "parents in a predicted group only"),
        ({"parents": np.zeros((10, 2), np.int32)}, r"parents: expected shape \[N\]"),
        ({"reference": 1, "parents": np.zeros(10, np.int32)}, "a predicted group: expected its reference"),
        ({"lifetimes": np.zeros((10, 2), np.uint16)}, "lifetime of Gaussian 0"),
        ({"lifetimes": np.zeros((9, 2), np.uint16) + np.uint16([0, 1])}, "expected 10 lifetimes, got 9"),
        ({"lifetimes": np.zeros(10, np.uint16)}, r"lifetimes: expected shape \[N, 2\]"),
        ({"lifetimes": np.zeros((10, 3), np.uint16)}, r"lifetimes: expected shape \[N, 2\], got \[10, 3\]"),
        ({"trajectories": None}, "expected 'trajectories', there is none"),
        ({"trajectories": {"colour": STILL}}, "trajectories: unknown attribute 'colour'"),
        ({"trajectories": {"sh0": trajectory(2, 3, 10)}}, "coefficients"),
        ({"trajectories": {"sh0": trajectory(1, 3, 9)}}, r"expected shape \[K, 3, 10\], got \[1, 3, 9\]"),
        ({"trajectories": {"sh0": trajectory(3, 10)}}, r"trajectories of sh0: expected shape \[K, C, N\]"),
        ({"trajectories": {"sh0": replace(STILL, coefficients=None)}}, "expected 'coefficients', there is none"),
        ({"trajectories": {"sh0": replace(STILL, step=None)}}, "expected 'step', there is none"),
        ({"nodes": replace(NODE, positions=None)}, "expected 'positions', there is none"),
        ({"nodes": replace(NODE, neighbors=300)}, "'neighbors': unexpected value 300"),
        ({"nodes": replace(NODE, coefficients=np.zeros((1, 6, 2), np.int32))}, "trajectories of nodes"),
    ],
)
def test_bad_input_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        _native.encode_group(replace(surface_group(10), **change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": np.array([1.0, 0.0, 1.0])}, "step > 0"),
        ({"steps": np.ones(1)}, "3 steps"),
        ({"steps": None}, "expected 'steps', there is none"),
        ({"offsets": np.zeros(2)}, "3 steps and offsets"),
        ({"values": None}, "expected 'values', there is none"),
        ({"values": np.full((3, 10), 1 << 25)}, "sh0: expected integers within"),
        ({"values": np.full((3, 10), 1 << 32)}, "'values': expected integers that fit int32"),
        ({"values": np.zeros((2, 10), np.int32)}, r"sh0: expected shape \[3, 10\]"),
        ({"values": np.zeros(10, np.int32)}, r"sh0: expected shape \[C, N\]"),
    ],
)
def test_channel_errors_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        _native.encode_group(with_channels(surface_group(10), "sh0", **change))


def test_unexpected_attributes_are_named():
    group = surface_group(10)
    sh0 = group.channels["sh0"]
    with pytest.raises(ValueError, match="channels: unknown attribute 'colour'"):
        _native.encode_group(replace(group, channels={**group.channels, "colour": sh0}))
    with pytest.raises(ValueError, match="channels: expected the attribute 'quats'"):
        _native.encode_group(replace(group, channels={n: c for n, c in group.channels.items() if n != "quats"}))
    with pytest.raises(ValueError, match="shN: expected 0, 9, 24 or 45 channels, got 3"):
        _native.encode_group(replace(group, channels={**group.channels, "shN": sh0}))


def test_companding_has_a_row_for_each_channel():
    group = with_channels(surface_group(10), "log_scales", companding=np.ones((3, 10), np.float32))
    with pytest.raises(
        ValueError, match="companding: expected 3 rows of log_scales and 1 of logit_opacities, or none, got 3"
    ):
        _native.encode_group(group)
    with pytest.raises(ValueError, match="'companding': unexpected value"):
        _native.encode_group(with_channels(group, "log_scales", companding=np.ones((3, 9), np.float32)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"grid_step": 0.5}, "with the same grid, steps"),
        ({"scale_exponents": np.ones((3, 3), np.int32)}, "with the same grid, steps"),
        ({"shifts": None}, "with the same grid, steps"),
        ({"parents": None}, "parents in a predicted group only"),
        ({"parents": np.full(10, -1, np.int32)}, r"expected \d+ parents, got 10"),
    ],
)
def test_predicted_groups_are_like_their_reference(change, message):
    first = layered_group()
    known = _native.DecodedGroup(_native.encode_group(first)[0], 1)
    with pytest.raises(ValueError, match=message):
        _native.encode_group(replace(predicted_group(first), **change), known)


def test_survivors_are_those_of_the_reference():
    first = layered_group()
    known = _native.DecodedGroup(_native.encode_group(first)[0], 1)
    group = predicted_group(first)
    swapped = group.parents.copy()
    swapped[:2] = swapped[1::-1]
    with pytest.raises(ValueError, match="parents of layer 0: expected increasing indices"):
        _native.encode_group(replace(group, parents=swapped), known)
    values = group.channels["sh0"].values.copy()
    values[1, 0] += 1
    with pytest.raises(ValueError, match="layer 0: expected survivors to have the integers of the reference"):
        _native.encode_group(with_channels(group, "sh0", values=values), known)

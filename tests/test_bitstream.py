"""The bitstream core by its Python API: integers survive, damage is named, the container can be cut and split."""

from __future__ import annotations

import mmap
import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from quantized_groups import assert_same, layered_group, moving_group, surface_group, with_channels

from gscodec import _native
from gscodec.bitstream.levels import LEVELS, smallest_level
from gscodec.bitstream.quantized_group import QuantizedNodes, QuantizedTrajectories
from gscodec.decode import Stream, open_stream
from gscodec.decode.maps import layouts, planes
from gscodec.errors import BitstreamError, LimitError

CAMERA = {"name": "cam00", "K": [[500, 0, 320], [0, 510, 240], [0, 0, 1]], "viewmat": np.eye(4)}
CONFIG = {
    "fps": 29.97,
    "level": 2,
    "metres_per_unit": 1.0,
    "up": "-y",
    "color_space": "srgb",
    "background": [0.0, 0.5, 1.0],
    "sh_degree": 0,
    "cameras": [{**CAMERA, "width": 640, "height": 480}],
}


@pytest.mark.parametrize(
    "group",
    [
        surface_group(),
        surface_group(0),
        surface_group(1),
        surface_group(300, sh_coefficients=15),
        moving_group(),
        layered_group(),
    ],
    ids=["keyframe", "empty", "single", "sh3", "moving", "layered"],
)
def test_integers_survive(group):
    payload, report = _native.encode_group(group)
    decoded = _native.DecodedGroup(payload, 1)
    assert_same(group, decoded.quantized())
    assert _native.encode_group(decoded.quantized())[0] == payload
    assert sum(u["bytes"] for u in report) == len(payload)
    assert [(u["type"], u["attribute"], u["bytes"]) for u in report] == [
        (u["type"], u["attribute"], u["bytes"]) for u in decoded.units()
    ]
    assert (decoded.frames, decoded.count) == (group.frames, len(group))


def test_payload_may_be_any_buffer():
    payload, _ = _native.encode_group(surface_group(50))
    for view in (bytearray(payload), memoryview(b"x" + payload)[1:], np.frombuffer(payload, np.uint8)):
        assert _native.DecodedGroup(view, 1).count == 50


def test_contexts_beat_a_memoryless_code():
    n = 20000
    group = surface_group(n)
    _, report = _native.encode_group(group)
    bits = Counter()
    for u in report:
        bits[u["attribute"] or u["type"]] += 8 * u["bytes"] / n
    for name, c in group.channels.items():
        memoryless = 0.0
        for channel in c.values:
            p = np.unique(channel, return_counts=True)[1] / channel.size
            memoryless -= (p * np.log2(p)).sum()
        assert bits[name] < 0.92 * memoryless, name
    assert bits["positions"] < 13.5  # 30 raw; 17.2 for an unordered set of points anywhere in the cube


def expected_frame(group, t):
    """Spec 13 in f64, without nodes and quats."""
    frames = group.frames
    k = np.arange(frames)
    basis = np.sqrt(np.where(k == 0, 1, 2) / frames) * np.cos(np.pi * (2 * t + 1) * k / (2 * frames))

    def delta(name):
        m = group.trajectories[name]
        return m.step * np.einsum("k,kcn->nc", basis[: len(m.coefficients)], m.coefficients)

    def values(name):
        c = group.channels[name]
        v = c.offsets[:, None] + c.steps[:, None] * c.values
        return v.T + delta(name)

    def rgb(v):
        y, co, cg = np.moveaxis(v.reshape(len(v), -1, 3), 2, 0)
        return np.stack([y + co - cg, y + cg, y - co - cg], 2)

    return {
        "means": group.origin + group.grid_step * group.positions + delta("means"),
        "log_scales": values("log_scales"),
        "logit_opacities": values("logit_opacities")[:, 0],
        "sh0": rgb(values("sh0"))[:, 0],
        "shN": rgb(values("shN")),
    }


def test_frames_follow_the_spec():
    group = replace(moving_group(), nodes=None)
    decoded = _native.DecodedGroup(_native.encode_group(group)[0], 1)
    for t in (0, 3, 7):
        frame = decoded.frame(t)
        for name, want in expected_frame(group, t).items():
            np.testing.assert_allclose(frame[name], want, atol=2e-4, err_msg=name)
        np.testing.assert_allclose(np.linalg.norm(frame["quats"], axis=1), 1, atol=1e-5)
        visible = (group.lifetimes[:, 0] <= t) & (t < group.lifetimes[:, 1])
        np.testing.assert_array_equal(decoded.visible(t), visible)
    with pytest.raises(IndexError, match="frame 8 of a group of 8"):
        decoded.frame(8)


def test_quaternion_trajectories_turn_from_the_left():
    values = np.array([[8, 0, 0]] * 3, np.int32).T
    group = with_channels(surface_group(3), "quats", values=values, offsets=np.zeros(3, np.float32))
    c = np.zeros((1, 3, 3), np.int32)
    c[0, 2] = 16
    group = replace(group, trajectories={"quats": QuantizedTrajectories(c, 0.03125)})
    q = _native.DecodedGroup(_native.encode_group(group)[0], 1).frame(0)["quats"][0]
    w, x = np.sqrt(1 - 0.25**2), 0.25  # canonical
    dw, dz = np.sqrt(1 - 0.5**2), 0.5
    np.testing.assert_allclose(q, [dw * w, dw * x, dz * x, dz * w], atol=1e-6)


def node_group(group, nodes, coefficients, rotation_step, translation_step):
    return replace(group, nodes=QuantizedNodes(nodes, coefficients, rotation_step, translation_step, neighbors=3))


def test_nodes_carry_their_gaussians():
    group = surface_group(800, frames=2)
    nodes = group.positions[::40]
    c = np.zeros((1, 6, len(nodes)), np.int32)
    c[0, 3] = 8  # every node has the same translation
    decoded = _native.DecodedGroup(_native.encode_group(node_group(group, nodes, c, 0.01, 0.25))[0], 1)
    rest = group.origin + group.grid_step * group.positions
    np.testing.assert_allclose(decoded.frame(1)["means"] - rest, [[8 * 0.25 / np.sqrt(2), 0, 0]] * 800, atol=1e-3)


def test_a_rotation_that_all_nodes_share_is_rigid():
    group = surface_group(200)
    nodes = group.positions[::20]
    angle = 0.5
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    at = group.origin + group.grid_step * nodes
    c = np.zeros((1, 6, len(nodes)), np.int32)
    c[0, 2] = round(angle / 2**-20)
    c[0, 3:] = np.rint((at @ turn.T - at).T / 2**-10)
    still = _native.DecodedGroup(_native.encode_group(group)[0], 1).frame(0)
    moved = _native.DecodedGroup(_native.encode_group(node_group(group, nodes, c, 2**-20, 2**-10))[0], 1).frame(0)
    np.testing.assert_allclose(moved["means"], still["means"] @ turn.T, atol=5e-3)
    w, z = np.cos(angle / 2), np.sin(angle / 2)
    a, b, c, d = still["quats"].T
    want = np.stack([w * a - z * d, w * b - z * c, w * c + z * b, w * d + z * a], 1)
    np.testing.assert_allclose(moved["quats"], want, atol=1e-4)


def test_node_weights_are_exact_and_sum_to_one():
    rng = np.random.default_rng(5)
    p = rng.integers(0, 1 << 21, (300, 3)).astype(np.uint32)
    for m in (1, 3, 4, 60):
        nodes = rng.integers(0, 1 << 21, (m, 3)).astype(np.uint32)
        nodes = nodes[_native.morton_order(nodes)]
        index, weight = _native.node_weights(p, nodes, 4)
        assert index.shape == weight.shape == (300, min(4, m))
        for i in range(0, 300, 7):
            d = [sum((int(a) - int(b)) ** 2 for a, b in zip(p[i], q, strict=True)) for q in nodes]
            order = sorted(range(m), key=lambda j: (d[j], j))
            k = min(4, m)
            scale = d[order[4]] if m > 4 else 2 * d[order[k - 1]]
            w = [(((scale - d[j]) << 16) // scale) ** 2 if scale else 0 for j in order[:k]]
            w = w if any(w) else [1] * k
            assert list(index[i]) == order[:k]
            np.testing.assert_allclose(weight[i], np.array(w, float) / sum(w), rtol=1e-6)


def test_node_weights_where_distances_vanish():
    p = np.full((2, 3), 5, np.uint32)
    index, weight = _native.node_weights(p, np.full((6, 3), 5, np.uint32), 4)
    assert index.tolist() == [[0, 1, 2, 3]] * 2
    np.testing.assert_array_equal(weight, 0.25)


def test_node_weights_take_grid_points_only():
    p = np.full((2, 3), 5, np.uint32)
    with pytest.raises(ValueError, match=r"nodes: expected grid coordinates below 2\^21"):
        _native.node_weights(p, np.full((6, 3), 1 << 21, np.uint32), 4)


def test_damage_is_an_error():
    payload, _ = _native.encode_group(moving_group(40))
    rng = np.random.default_rng(2)
    for at in rng.integers(0, len(payload), 200):
        bad = bytearray(payload)
        bad[at] ^= 1 << rng.integers(8)
        with pytest.raises(BitstreamError, match=r"byte \d+, unit"):
            _native.DecodedGroup(bad, 1)
    for size in rng.integers(0, len(payload) - 200, 50):
        with pytest.raises(BitstreamError):
            _native.DecodedGroup(payload[:size], 1)


def flipped(payload, unit_type, index=0):
    """The payload with one changed bit near the end of a unit."""
    u = next(u for u in _native.units(payload) if (u["type"], u["index"]) == (unit_type, index))
    bad = bytearray(payload)
    bad[u["offset"] + u["bytes"] - 2] ^= 4
    return bytes(bad), u["unit"]


def tiled_group(count=600):
    """A group in tiles of 256 Gaussians."""
    return replace(moving_group(count), tile_side_log2=4)


def test_what_is_not_damaged_decodes():
    payload, _ = _native.encode_group(tiled_group())
    sound = _native.DecodedGroup(payload, 1, strict=False)
    assert sound.damage() == []
    bad, unit = flipped(payload, "tile", 1)
    decoded = _native.DecodedGroup(bad, 1, strict=False)
    [damage] = decoded.damage()
    assert damage.pop("message").endswith("the unit is damaged")
    assert damage == {"unit": unit, "type": "tile", "layer": 0, "tile": 1}
    assert [t["gaussians"] for t in decoded.tiles()[0]] == [256, 0, 88]
    kept = np.r_[:256, 512:600]
    for t in (0, 5):
        for name, values in decoded.frame(t).items():
            np.testing.assert_array_equal(values, sound.frame(t)[name][kept], err_msg=name)
    assert not np.array_equal(sound.frame(0)["sh0"], sound.frame(5)["sh0"])
    for name in ("tile", "group_header"):  # the first tile starts the others
        with pytest.raises(BitstreamError, match="CRC"):
            _native.DecodedGroup(flipped(payload, name)[0], 1, strict=False)


def test_bounds_hold_what_a_tile_shows():
    group = tiled_group()
    decoded = _native.DecodedGroup(_native.encode_group(group)[0], 1)
    [tiles] = decoded.tiles()
    first = 0
    for tile in tiles:
        own = slice(first, first + tile["gaussians"])
        first = own.stop
        for t in range(decoded.frames):
            frame = decoded.frame(t)
            opaque = frame["logit_opacities"][own] > -5
            means, sizes = frame["means"][own][opaque], np.exp(frame["log_scales"][own][opaque]).min(1, keepdims=True)
            assert (means - sizes >= tile["low"]).all()
            assert (means + sizes <= tile["high"]).all()
    assert first == 600


def test_streams_tell_of_damage(tmp_path):
    payload, _ = _native.encode_group(tiled_group())
    bad, unit = flipped(payload, "tile", 2)
    frames = _native.DecodedGroup(payload, 1).frames
    path = tmp_path / "damaged.gsv"
    config = {**CONFIG, "sh_degree": 3}
    parts = [
        _native.fragment(p, i + 1, i * frames, frames, True, config)
        for i, p in enumerate((payload, bad, payload, payload))
    ]
    path.write_bytes(_native.init_segment(config) + b"".join(parts))
    with pytest.raises(BitstreamError, match=r"group 1 .*CRC"):
        open_stream(path).frame(frames)
    stream = open_stream(path, strict=False)
    assert len(stream.frame(0)) > len(stream.frame(frames)) > 0
    assert stream.frame_count == 4 * frames
    for i in (0, 2, 3, 1):  # decoded again, reported once
        stream.group(i)
    [damage] = stream.damage
    assert (damage["group"], damage["unit"], damage["type"], damage["tile"]) == (1, unit, "tile", 2)
    with pytest.raises(IndexError):
        stream.frame(4 * frames)


def test_damage_anywhere_behind_the_index_costs_one_group_and_its_followers():
    """Damage at every byte of boxes and some bytes of payloads: all other groups are unchanged, the damage is
    reported."""
    group = moving_group(30)
    known = _native.DecodedGroup(_native.encode_group(group)[0], 1)
    later = replace(known.quantized(), reference=2, parents=np.arange(30, dtype=np.int32))
    alone = _native.encode_group(group)[0]
    payloads = [alone, alone, _native.encode_group(later, known)[0], alone]
    config = {**CONFIG, "sh_degree": 3}
    fragments = [_native.fragment(p, i + 1, 8 * i, 8, i != 2, config) for i, p in enumerate(payloads)]
    index = [(len(f), 8, i != 2, []) for i, f in enumerate(fragments)]
    head = _native.finish(_native.init_segment(config), [index])
    data = head + b"".join(fragments)
    ends = len(head) + np.cumsum([len(f) for f in fragments])
    want = known.frame(3)["means"]
    for at in range(len(head), len(data)):
        hit = int(np.searchsorted(ends, at, side="right"))
        if ends[hit] - len(payloads[hit]) <= at and at % 13:
            continue
        bad = bytearray(data)
        bad[at] ^= 0x55
        stream = Stream(bad, strict=False)
        assert [g["frames"] for i, g in enumerate(stream.groups) if i != hit] == [8] * 3, at
        for i in {0, 1, 2, 3} - {hit} - ({2} if hit == 0 else set()):
            np.testing.assert_array_equal(stream.group(i).frame(3)["means"], want, err_msg=f"byte {at}, group {i}")
        try:
            same = np.array_equal(stream.group(hit).frame(3)["means"], want)
        except BitstreamError:
            continue
        assert same or stream.damage, at


def test_levels_are_caps():
    payload, _ = _native.encode_group(surface_group(1, frames=65))
    with pytest.raises(LimitError, match="65 frames, level 1 allows 64"):
        _native.DecodedGroup(payload, 1)
    assert _native.DecodedGroup(payload, 2).frames == 65
    with pytest.raises(LimitError):
        _native.DecodedGroup(payload, 9)
    assert smallest_level(gaussians=65536) == 1
    assert smallest_level(gaussians=65537, frames=20) == 2
    with pytest.raises(LimitError, match="frames exceeds level 4"):
        smallest_level(frames=LEVELS[-1].frames + 1)


def test_maps_hold_every_value():
    group = replace(surface_group(700), tile_side_log2=4)
    decoded = _native.DecodedGroup(_native.encode_group(group)[0], 1)
    [layout] = layouts(decoded)
    assert (layout.width, layout.height, layout.side) == (16, 48, 16)
    for name, values in planes(decoded.quantized()):
        np.testing.assert_array_equal(layout.collect(layout.arrange(values)), values, err_msg=name)
    for t in range(3):  # a tile is a square of 16 x 16
        own = slice(256 * t, 256 * (t + 1))
        assert (layout.x[own] // 16 == 0).all()
        assert (layout.y[own] // 16 == t).all()
    steps = np.abs(np.diff(layout.x)) + np.abs(np.diff(layout.y))
    assert (steps == 1).all()


def make_file(frames=(20, 1, 7)):
    init = _native.init_segment(CONFIG)
    payload, _ = _native.encode_group(surface_group(30))
    parts, index, start = [], [], 0
    for number, n in enumerate(frames, 1):
        parts.append(_native.fragment(payload, number, start, n, number != 2, CONFIG))
        index.append((len(parts[-1]), n, number != 2, []))
        start += n
    return _native.finish(init, [index]) + b"".join(parts), payload


def test_file_round_trip():
    data, payload = make_file()
    found = _native.demux(data)
    assert found["complete"]
    config = found["config"]
    assert config["fps"] == (30000, 1001)
    for key in ("level", "up", "color_space", "background", "sh_degree"):
        assert config[key] == CONFIG[key]
    np.testing.assert_array_equal(config["cameras"][0]["K"], CONFIG["cameras"][0]["K"])
    np.testing.assert_array_equal(config["cameras"][0]["viewmat"], np.eye(4))
    timing = [(g["start_frame"], g["frames"], g["sync"]) for g in found["groups"]]
    assert timing == [(0, 20, True), (20, 1, False), (21, 7, True)]
    for g in found["groups"]:
        assert data[g["offset"] : g["offset"] + g["size"]] == payload
    assert _native.init_segment(config) == _native.init_segment(CONFIG)


def test_cut_files_keep_whole_groups():
    data, payload = make_file()
    whole = [g["offset"] + g["size"] for g in _native.demux(data)["groups"]]
    first = whole[0] - len(payload)
    for n in [*range(first, len(data), 97), len(data) - 1]:
        found = _native.demux(data[:n])
        assert len(found["groups"]) == sum(end <= n for end in whole)
        assert not found["complete"]
    with pytest.raises(BitstreamError, match="moov"):
        _native.demux(data[:40])
    with pytest.raises(BitstreamError, match="ftyp"):
        _native.demux(b"ply\nformat ascii 1.0\n")


def test_mapped_files(tmp_path):
    path = tmp_path / "a.gsv"
    path.write_bytes(make_file()[0])
    with path.open("rb") as f, mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ) as m:
        assert len(_native.demux(m)["groups"]) == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fps": 0}, "fps"),
        ({"up": "w"}, "up: expected one of"),
        ({"background": [0, 0, 2]}, "background"),
        ({"level": 7}, "level 7"),
        ({"metres_per_unit": -1.0}, "metres_per_unit"),
        ({"cameras": [{**CONFIG["cameras"][0], "K": np.ones((3, 3))}]}, "camera K"),
    ],
)
def test_config_errors_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        _native.init_segment({**CONFIG, **change})


def test_decoding_releases_the_gil():
    payload, _ = _native.encode_group(surface_group(60000))
    ticks, done = [], threading.Event()

    def tick():
        while not done.wait(0.001):
            ticks.append(1)

    thread = threading.Thread(target=tick)
    thread.start()
    for _ in range(3):
        _native.DecodedGroup(payload, 1)
    done.set()
    thread.join()
    assert len(ticks) >= 6  # one or two per call if the GIL were held

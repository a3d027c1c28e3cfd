"""Conformance: the native decoder and the reference decoder against the vectors and against each other.

The case lists spec/vectors/valid_cases.py and invalid_cases.py drive these tests and, by make.py, write the files; the
manifest holds the expected results.
"""

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gscodec import _native, errors
from gscodec.decode import Stream
from gscodec.decode.scene import read_scene

SPEC = Path(__file__).resolve().parents[1] / "spec"
VECTORS = SPEC / "vectors"
sys.path[:0] = [str(SPEC), str(VECTORS)]
import reference_decoder as reference  # noqa: E402
from groups import encode, make_group  # noqa: E402
from invalid_cases import INVALID as INVALID_CASES  # noqa: E402
from reference_container import LEVELS  # noqa: E402
from reference_evaluation import evaluate  # noqa: E402
from reference_scene import scene_frame  # noqa: E402
from valid_cases import MOTION  # noqa: E402
from valid_cases import VALID as VALID_CASES  # noqa: E402

MANIFEST = json.loads((VECTORS / "manifest.json").read_text())
VALID = {Path(entry["file"]).stem: entry for entry in MANIFEST["valid"]}
INVALID = {Path(entry["file"]).stem: entry for entry in MANIFEST["invalid"]}


def native_groups(data, track=None):
    """[(fragment, DecodedGroup)] of a track of a file, by the native decoder."""
    stream = Stream(data, track=track)
    return [(fragment, stream.group(i)) for i, fragment in enumerate(stream.groups)]


def decode_all(data):
    """Every group of every track, by the native reader of files, which also checks that groups agree with the file."""
    count = _native.track_count(data)
    return [group for k in range(count) for _, group in native_groups(data, k or None)]


def reference_decode_all(data):
    first, _ = reference.decode(data)
    return [reference.decode(data, k) for k in range(first.tracks)]


def native_hash(group):
    """Clause 16, from a `QuantizedGroup`."""
    names, nodes = list(reference.ATTRIBUTES.values()), group.nodes
    channels = {name: c.values for name, c in group.channels.items()}
    trajectories = {name: t.coefficients for name, t in group.trajectories.items()}
    arrays = [group.positions, *(channels.get(name) for name in names[1:]), group.lifetimes]
    arrays += [nodes.positions, nodes.coefficients] if nodes else [None, None]
    arrays += [trajectories.get(name) for name in names]
    if nodes and nodes.rig:
        arrays += [getattr(nodes.rig, name) for name in ("joints", "parents", "bind", "weights", "poses")]
    return reference.hash_arrays(group.frames, group.grid_bits, arrays)


def assert_close(got, expected, name):
    scale = max(np.abs(expected).max(initial=0), 1e-30)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-4 * scale, err_msg=name)


def test_manifest_lists_the_cases():
    assert list(VALID) == list(VALID_CASES)
    reasons = {name: (entry["error"], entry["reason"]) for name, entry in INVALID.items()}
    assert reasons == {name: case[:2] for name, case in INVALID_CASES.items()}
    files = {path.relative_to(VECTORS).as_posix() for path in VECTORS.glob("*valid/*")}
    assert files == {entry["file"] for entry in MANIFEST["valid"] + MANIFEST["invalid"]}


@pytest.mark.parametrize("name", VALID)
def test_valid(name):
    entry = VALID[name]
    data = (VECTORS / entry["file"]).read_bytes()
    assert len(data) < 30_000
    assert entry["frames"] == sum(group["frames"] for group in entry["groups"])
    tracks = [entry["groups"], *entry.get("tracks", ())]
    assert _native.track_count(data) == len(tracks)
    for k, groups in enumerate(tracks):
        compare(name, data, reference.decode(data, k)[1], native_groups(data, k or None), groups)


def compare(name, data, decoded, native, groups):
    """Compares the groups of a track: both decoders and the manifest."""
    assert len(decoded) == len(native) == len(groups)
    for (sample, group), (fragment, ours), facts in zip(decoded, native, groups, strict=True):
        assert reference.group_hash(group) == native_hash(ours.quantized()) == facts["sha256"]
        assert ours.frames == fragment["frames"]
        for key in ("start_frame", "frames", "sync"):
            assert getattr(sample, key) == fragment[key] == facts[key]
        sound = fragment.get("audio")  # (offset, time, samples)
        assert sample.audio == (sound and (*sound[1:], data[sound[0] : fragment["offset"]]))
        frames = sample.frames
        for t in sorted({0, 1, frames // 2, frames - 1} & set(range(frames))):
            expected, frame = evaluate(group, t), ours.frame(t)
            shown, visible = expected.pop("shown"), ours.visible(t)
            assert np.array_equal(shown, np.ones_like(shown) if visible is None else visible)
            for key, values in expected.items():
                assert_close(frame[key], values, f"{name}, frame {t}, {key}")


@pytest.mark.parametrize("name", [name for name in VALID if name.startswith("track")])
def test_scene(name):
    """Frames of a scene by both decoders: tracks are placed and concatenated."""
    data = (VECTORS / VALID[name]["file"]).read_bytes()
    scene = read_scene(data)
    assert scene.frame_count > 1
    for t in range(scene.frame_count):
        expected, frame = scene_frame(data, t), scene.frame(t)
        assert len(frame) == len(expected.get("means", ()))
        for key, values in expected.items():
            assert_close(getattr(frame, key), values, f"{name}, frame {t}, {key}")


@pytest.mark.parametrize("name", VALID)
def test_encoder_still_makes_these_integers(name):
    """The encoder may write other bytes than when the vectors were made, but the same integers."""
    groups = [native_hash(group.quantized()) for _, group in native_groups(VALID_CASES[name][1]())]
    assert groups == [facts["sha256"] for facts in VALID[name]["groups"]]


@pytest.mark.parametrize("name", INVALID)
def test_invalid(name):
    error, message, _ = INVALID_CASES[name]
    data = (VECTORS / INVALID[name]["file"]).read_bytes()
    assert message
    with pytest.raises(getattr(reference, error)) as theirs:
        reference_decode_all(data)
    assert message.lower() in str(theirs.value).lower()
    with pytest.raises(getattr(errors, error)) as caught:
        decode_all(data)
    assert message.lower() in str(caught.value).lower()


def test_reference_stops_at_the_cap_of_symbols(monkeypatch):
    payload = encode(make_group(250, 20, **MOTION))
    symbols = 13 * 250 + 4 * 250 + (3 + 6 * 6) * 12
    monkeypatch.setitem(LEVELS, 1, (65536, 64, 1024, symbols + 10, 2**24))
    with pytest.raises(reference.LimitError, match="symbols"):
        reference.decode_group(payload, 1)


@pytest.mark.parametrize("name", ["layers", "layers_most", "layers_predicted", "layer_corrections", "tiles_layers"])
def test_prefix(name):
    """Both decoders decode the first layers alone, also if the sample ends behind them."""
    data = (VECTORS / VALID[name]["file"]).read_bytes()
    _, samples = reference.read_container(data)
    for layers in (1, 2, 3):
        stream, groups = Stream(data, layers=layers), []
        for i, sample in enumerate(samples):
            units = _native.units(sample.payload)
            end = min((u["offset"] for u in units if u["layer"] >= layers), default=len(sample.payload))
            options = {"reference": groups[0] if i else None, "layers": layers}
            groups.append(reference.decode_group(sample.payload[:end], 1, **options))
            ours = stream.group(i)
            assert ours.layers == groups[i].counts
            assert native_hash(ours.quantized()) == reference.group_hash(groups[i])
            expected = evaluate(groups[i], 0)
            expected.pop("shown")
            for key, values in expected.items():
                assert_close(ours.frame(0)[key], values, f"{name}, {layers} layers, {key}")


@pytest.mark.parametrize("name", ["tiles", "tiles_predicted", "tiles_layers"])
def test_some_tiles(name):
    """Both decoders decode the same tiles alone, also if the bytes of other tiles are missing."""
    data = (VECTORS / VALID[name]["file"]).read_bytes()
    _, samples = reference.read_container(data)
    for wanted in ({(0, 2)}, {(0, 1), (0, 4), (1, 1)}, set()):
        theirs, ours = [], []
        for i, sample in enumerate(samples):
            payload = bytearray(sample.payload)
            for u in _native.units(sample.payload):
                if u["type"] == "tile" and (u["layer"], u["index"]) not in wanted and u["index"] not in (0, 5):
                    payload[u["offset"] : u["offset"] + u["bytes"]] = bytes(u["bytes"])
            payload = bytes(payload)
            before, known = (theirs[0], ours[0]) if i else (None, None)
            tiles = [[(k, t) in wanted for t in range(9)] for k in range(2)]
            theirs.append(reference.decode_group(payload, 1, reference=before, tiles=lambda k, t, all=tiles: all[k][t]))
            ours.append(_native.DecodedGroup(payload, 1, reference=known, tiles=tiles))
            assert native_hash(ours[i].quantized()) == reference.group_hash(theirs[i])
            told = [sum(place[1] for place in own if place) for own in theirs[i].tiles]
            assert ours[i].layers == told == [sum(t["gaussians"] for t in own) for own in ours[i].tiles()]
            assert len(theirs[i].positions) < VALID[name]["groups"][i]["gaussians"]


def test_a_missing_leading_tile_says_who_needs_it():
    """Tile 2 is requested; the bytes of tile 0, its leading tile, are missing."""
    data = (VECTORS / VALID["tiles"]["file"]).read_bytes()
    _, (sample,) = reference.read_container(data)
    first = next(u for u in _native.units(sample.payload) if u["type"] == "tile")
    start, end = first["offset"], first["offset"] + first["bytes"]
    payload = sample.payload[:start] + bytes(end - start) + sample.payload[end:]
    said = rf"byte {start}, unit 1 \(tile 0\): .* damaged; the tiles that were asked for start from it$"
    with pytest.raises(errors.BitstreamError, match=said):
        _native.DecodedGroup(payload, 1, tiles=[[t == 2 for t in range(9)]])
    with pytest.raises(reference.BitstreamError, match="unit 1: wrong CRC"):
        reference.decode_group(payload, 1, tiles=lambda k, t: t == 2)


def test_reference_command(tmp_path):
    name = "several_groups"
    command = [
        sys.executable,
        SPEC / "reference_decoder.py",
        VECTORS / "valid" / f"{name}.gsv",
        "--npz",
        tmp_path / "o.npz",
    ]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert [line.split()[0] for line in run.stdout.splitlines()] == [g["sha256"] for g in VALID[name]["groups"]]
    with np.load(tmp_path / "o.npz") as arrays:
        assert arrays["group2_positions"].shape == (70, 3)
    bad = subprocess.run([*command[:2], VECTORS / "invalid" / "unit_crc.gsv"], capture_output=True, text=True)
    assert bad.returncode == 1
    assert bad.stderr.startswith("BitstreamError: ")


def test_rendering_is_as_written():
    """Clause 14 has the constants of the rasterizer and its spherical harmonics."""
    text = (SPEC / "gsv.md").read_text().split("## 14. ")[1].split("## 15.")[0]
    code = (SPEC.parent / "codec/native/raster/src/constants.rs").read_text()
    constants = dict(re.findall(r"pub const (\w+): f32 = ([^;]+);", code))
    constants.pop("LOG2_ALPHA_MIN")
    for name, value in constants.items():
        assert float(eval(re.search(rf"\b{name} = (\d[\d. /e-]*)", text)[1])) == float(eval(value)), name

    torch = pytest.importorskip("torch")
    from gscodec.render.reference import sh_basis

    x, y, z = direction = np.array([0.48, -0.6, 0.64])
    written = {int(k): term.strip() for k, term in re.findall(r"Y_(\d+) +=(.*?)(?=  +Y_|\n)", text)}
    for k, value in enumerate(sh_basis(torch.tensor(direction)[None], 15)[0].tolist(), 1):
        term = re.sub(r"(?<=[\dxyz]) (?=[xyz(])", " * ", written[k].replace("^", "**"))
        assert eval(term, {"x": x, "y": y, "z": z}) == pytest.approx(value, rel=1e-8), f"Y_{k}"


def test_reference_hash_is_as_written():
    """Clause 16 written out for one case: T = 2, grid_bits = 3, one Gaussian, positions only."""
    arrays = [np.array([[1, 2, 7]])] + [None] * 14
    words = [2, 3, 2, 1, 3, 1, 2, 7] + [0] * 14
    serialized = b"".join(word.to_bytes(4, "little") for word in words)
    assert reference.hash_arrays(2, 3, arrays) == hashlib.sha256(serialized).hexdigest()

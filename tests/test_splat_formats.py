"""Splat formats of other tools: files written by those tools are read, and files are written for them.

tests/data/splats, made from source.ply and spacetime.ply: niantic_v*.spz by Niantic's C++ library (21715c3),
splat_transform.* by @playcanvas/splat-transform 2.7.1, antimatter15.splat by antimatter15/splat's convert.py,
spacetime.splatv by macaburguera/splaTV's ply_to_splatv.py, videogs_*.zip by VideoGS' scripts in compress/.
"""

import gzip
import json
import os
import re
import shutil
import struct
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData
from synthetic import assert_close, blob, covariances, gaussians, moved

from gscodec.errors import CaptureError, UsageError
from gscodec.model.gaussians import SH_C0, Gaussians
from gscodec.model.rotations import quat_multiply, quat_to_matrix
from gscodec.splats import archive, detect_input, open_sequence, read_splat, write_splat
from gscodec.splats.describe import describe_splats
from gscodec.splats.files import splat_size
from gscodec.splats.glb import UPRIGHT

GOLDEN = Path(__file__).parent / "data" / "splats"
SPZ = ["niantic_v2.spz", "niantic_v3.spz", "niantic_v4.spz", "splat_transform.spz"]
SPZ_LIMITS = {"means": 2e-4, "log_scales": 0.033, "opacity": 0.04, "sh0": 0.014}  # 8 bits each


@pytest.fixture(scope="module")
def source():
    return read_splat(GOLDEN / "source.ply")


# -- .spz


@pytest.mark.parametrize("name", SPZ)
def test_spz_of_others(source, name):
    assert_close(read_splat(GOLDEN / name), source, angle=0.03 if "v2" in name else 3e-3, shN=0.07, **SPZ_LIMITS)
    assert splat_size(GOLDEN / name) == (5, 15)


def test_spz_is_what_niantic_writes(source, tmp_path):
    write_splat(tmp_path / "a.spz", source)
    ours, theirs = (gzip.decompress(p.read_bytes()) for p in (tmp_path / "a.spz", GOLDEN / "niantic_v3.spz"))
    assert ours[: 16 + 20 * 5] == theirs[: 16 + 20 * 5]  # all but harmonics: Niantic writes fewer bits
    assert len(ours) == len(theirs)
    assert_close(read_splat(tmp_path / "a.spz"), source, angle=3e-3, shN=0.004, **SPZ_LIMITS)


def test_spz_holds_far_positions(tmp_path):
    g = gaussians(3)
    far = Gaussians(g.means * 0 + 4e5, g.quats, g.log_scales, g.logit_opacities, g.sh0, g.shN)
    write_splat(tmp_path / "a.spz", far)
    np.testing.assert_allclose(read_splat(tmp_path / "a.spz").means, far.means, atol=1 / 16)
    edge = Gaussians(np.full_like(g.means, 2048 - 2**-13), *(getattr(g, n) for n in REST))
    write_splat(tmp_path / "a.spz", edge)  # rounded to 12 bits of fraction it would need more than 24 bits
    np.testing.assert_allclose(read_splat(tmp_path / "a.spz").means, edge.means, atol=1 / 4096)
    with pytest.raises(CaptureError, match=r"a position of 1e\+30, expected less than 8388608"):
        write_splat(tmp_path / "b.spz", Gaussians(g.means * 0 + 1e30, *(getattr(g, n) for n in REST)))
    with pytest.raises(CaptureError, match="no Gaussians to write"):
        write_splat(tmp_path / "b.spz", gaussians(0))
    assert not (tmp_path / "b.spz").exists()


REST = ("quats", "log_scales", "logit_opacities", "sh0", "shN")


def header(version=3, count=5, degree=0, fraction=12):
    return b"NGSP" + struct.pack("<IIBBBB", version, count, degree, fraction, 0, 0)


def v4(count=5, streams=5, table=32, sizes=(), flags=0, records=b"", data=b""):
    head = b"NGSP" + struct.pack("<IIBBBBI12x", 4, count, 0, 12, flags, streams, table)
    return head + records + b"".join(struct.pack("<QQ", *s) for s in sizes) + data


BOMB = gzip.compress(header(count=4_000_000) + bytes(20_000_000))
SPZ_BAD = [
    (b"PK not a splat", r"not a \.spz, expected NGSP or a gzip stream"),
    (gzip.compress(b"some text"), r"not a \.spz, expected NGSP"),
    (b"\x1f\x8bdamaged", "its gzip stream is damaged"),
    (gzip.compress(header(1)), "version 1 in gzip, expected 2 or 3 in gzip, or 4 without"),
    (header(3), "version 3 without gzip, expected 2 or 3 in gzip, or 4 without"),
    (v4().replace(b"\4", b"\5", 1), "version 5 without gzip"),
    (gzip.compress(header(degree=7)), "SH degree 7, 12 fraction bits; expected 0 to 4"),
    (gzip.compress(header(fraction=60)), "SH degree 0, 60 fraction bits"),
    (gzip.compress(header(count=2**32 - 1)), r"4294967295 Gaussians in \d+ bytes, expected at most \d+"),
    (BOMB, r"4000000 Gaussians in \d+ bytes, expected at most \d+"),
    (gzip.compress(header() + bytes(50)), "truncated, 50 of 100 bytes behind the header are there"),
    (gzip.compress(header() + bytes(os.urandom(100)))[:-40], "truncated or damaged"),
    (v4(streams=9), "9 streams, table at byte 32; expected 5"),
    (v4(table=10**6), "table at byte 1000000; expected 5, within the file"),
    (v4(sizes=[(1, 2**50)] * 5), "means has 1 bytes for 1125899906842624, expected 45 and at most 0"),
    (v4(sizes=[(9, 45)] * 5, data=bytes(45)), "means is damaged"),
]


@pytest.mark.parametrize(("content", "message"), SPZ_BAD, ids=[message for _, message in SPZ_BAD])
def test_bad_spz(tmp_path, content, message):
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(CaptureError, match=r"a\.spz: .*" + message):
        read_splat(tmp_path / "a.spz")


def test_spz_streams_unpack_no_more_than_promised(tmp_path):
    zstandard = pytest.importorskip("zstandard")
    bomb = zstandard.ZstdCompressor().compress(bytes(10**8))
    short = zstandard.ZstdCompressor().compress(bytes(9))
    (tmp_path / "a.spz").write_bytes(v4(sizes=[(len(bomb), 45), *[(0, 5), (0, 15), (0, 15), (0, 20)]], data=bomb))
    with pytest.raises(CaptureError, match="alphas is"):  # the means were cut at 45 bytes
        read_splat(tmp_path / "a.spz")
    (tmp_path / "a.spz").write_bytes(v4(sizes=[(len(short), 45)] * 5, data=short * 5))
    with pytest.raises(CaptureError, match="means is truncated, 9 of 45 bytes are there"):
        read_splat(tmp_path / "a.spz")


def test_spz_in_other_axes_is_refused(tmp_path):
    record = struct.pack("<III", 0xADBE0003, 4, 6)
    (tmp_path / "a.spz").write_bytes(v4(flags=2, table=44, records=record, sizes=[(0, 0)] * 5))
    with pytest.raises(CaptureError, match="coordinate system is not right, up, back"):
        read_splat(tmp_path / "a.spz")


# -- .splat


def test_splat_of_others(source):
    g = read_splat(GOLDEN / "antimatter15.splat")
    order = np.linalg.norm(source.means[:, None] - g.means, axis=2).argmin(1)  # antimatter15/splat sorts by size
    plain = Gaussians(*(getattr(source, n) for n in ("means", *REST[:4])), np.zeros((5, 0, 3)))
    assert_close(g.take(order), plain, angle=0.03, opacity=0.05, sh0=0.014)
    assert splat_size(GOLDEN / "antimatter15.splat") == (5, 0)


def test_bad_splat(tmp_path):
    (tmp_path / "a.splat").write_bytes((GOLDEN / "antimatter15.splat").read_bytes()[:-1])
    with pytest.raises(CaptureError, match="159 bytes, expected 32 for each Gaussian; truncated"):
        read_splat(tmp_path / "a.splat")
    (tmp_path / "a.splat").write_bytes(b"")
    with pytest.raises(CaptureError, match="0 bytes, expected 32"):
        read_splat(tmp_path / "a.splat")
    (tmp_path / "a.splat").write_bytes(struct.pack("<6f8B", 0, 0, 0, 1, -1, 1, *range(8)))
    with pytest.raises(CaptureError, match=r"scales of Gaussian 0 are \[1.0, -1.0, 1.0\], expected 0 or more"):
        read_splat(tmp_path / "a.splat")


# -- .glb


def read_glb(path):
    """JSON document, and attribute semantic -> [N, C], read exactly as glTF 2.0 specifies."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    document, at = json.loads(data[20 : 20 + length]), 20 + length
    assert struct.unpack_from("<I4s", data, at) == (len(data) - at - 8, b"BIN\0")
    assert length % 4 == at % 4 == 0
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    out = {}
    for name, i in primitive["attributes"].items():
        accessor = document["accessors"][i]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        values = np.frombuffer(data, kind, view["byteLength"] // int(kind[-1]), at + 8 + view["byteOffset"])
        out[name] = values.reshape(accessor["count"], -1)
        assert out[name].shape[1] == {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    return document, out


def test_glb_beside_that_of_others(source, tmp_path):
    write_splat(tmp_path / "a.glb", source)
    (ours, a), (theirs, b) = read_glb(tmp_path / "a.glb"), read_glb(GOLDEN / "splat_transform.glb")
    assert set(a) == set(b)
    extension = lambda d: d["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]  # noqa: E731
    assert extension(ours) == extension(theirs)
    assert ours["extensionsUsed"] == ["KHR_gaussian_splatting"]
    accessor = ours["accessors"][0]
    assert (accessor["min"], accessor["max"]) == (source.means.min(0).tolist(), source.means.max(0).tolist())
    x, y, z, w = ours["nodes"][0]["rotation"]  # splat-transform rotates the values, ours the node
    turn = np.array([w, x, y, z])
    np.testing.assert_allclose(a["POSITION"] @ quat_to_matrix(turn).T, b["POSITION"], atol=1e-5)
    for name in ("SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"):
        np.testing.assert_allclose(a[f"KHR_gaussian_splatting:{name}"], b[f"KHR_gaussian_splatting:{name}"], rtol=1e-5)
    quats, theirs = (np.roll(v["KHR_gaussian_splatting:ROTATION"], 1, 1).astype(float) for v in (a, b))
    same = np.einsum("nc,nc->n", quat_multiply(np.broadcast_to(turn, quats.shape), quats), theirs)
    np.testing.assert_allclose(np.abs(same), 1, atol=1e-5)
    for degree, k in ((1, 0), (2, 3), (3, 8)):
        for n in range(2 * degree + 1):
            stored = a[f"KHR_gaussian_splatting:SH_DEGREE_{degree}_COEF_{n}"]
            np.testing.assert_array_equal(stored, source.shN[:, k + n])


def test_glb_color_is_linear_and_any_axis_stands_up(tmp_path):
    g = gaussians(1)
    write_splat(tmp_path / "a.glb", Gaussians(*(getattr(g, n) for n in ("means", *REST[:3])), g.sh0 * 0, g.shN))
    _, a = read_glb(tmp_path / "a.glb")
    np.testing.assert_allclose(a["COLOR_0"][0, :3], 0.2140, atol=1e-4)  # sRGB 0.5, decoded
    for up, (x, y, z, w) in UPRIGHT.items():
        axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
        np.testing.assert_allclose(quat_to_matrix(np.array([w, x, y, z])) @ axis, [0, 1, 0], atol=1e-12)
    with pytest.raises(CaptureError, match="no Gaussians to write; glTF has no empty meshes"):
        write_splat(tmp_path / "b.glb", gaussians(0))


# -- .splatv


def spacetime(t):
    """Frame `t` of spacetime.ply by the formulas of the paper, and which Gaussians have an orientation."""
    v = PlyData.read(str(GOLDEN / "spacetime.ply"))["vertex"]
    stack = lambda *names: np.stack([v[n] for n in names], 1).astype(float)  # noqa: E731
    dt = (t / 50 - v["trbf_center"])[:, None]
    means = stack("x", "y", "z")
    for k in range(3):
        means = means + stack(*(f"motion_{3 * k + i}" for i in range(3))) * dt ** (k + 1)
    quats = stack(*(f"rot_{i}" for i in range(4))) + stack(*(f"omega_{i}" for i in range(4))) * dt
    fade = np.exp(-((dt[:, 0] / np.exp(v["trbf_scale"])) ** 2))
    alpha = fade / (1 + np.exp(-v["opacity"].astype(float)))
    color = stack("f_dc_0", "f_dc_1", "f_dc_2")
    shown = (np.abs(quats).sum(1) > 0) & (fade >= 0.02) & (alpha >= 1 / 255)
    return means, quats, alpha, color, shown


@pytest.mark.parametrize("t", [0, 7, 25, 49])
def test_splatv_of_others(t):
    sequence = open_sequence(GOLDEN / "spacetime.splatv", gop=30)
    assert [len(g) for g in sequence.groups] == [30, 20]
    g = sequence.frame(t)
    means, quats, alpha, color, shown = spacetime(t)
    order = [int(np.linalg.norm(means - m, axis=1).argmin()) for m in g.means]  # the file's order is sorted
    assert sorted(order) == np.flatnonzero(shown).tolist()
    np.testing.assert_allclose(g.means, means[order], atol=1e-3)
    np.testing.assert_allclose(1 / (1 + np.exp(-g.logit_opacities)), alpha[order], atol=0.006)
    np.testing.assert_allclose(g.sh0 * SH_C0 + 0.5, color[order], atol=0.005)
    unit = quats[order] / np.linalg.norm(quats[order], axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((unit * g.quats).sum(1)), 1, atol=1e-5)


def test_splatv_groups_continue_each_other():
    first, second = open_sequence(GOLDEN / "spacetime.splatv", gop=30).groups
    known = second.parents >= 0
    assert known.any()
    a, b = first.frame(29), second.frame(0)
    np.testing.assert_allclose(a.log_scales[second.parents[known]], b.log_scales[known])
    assert (first.lifetimes[:, 0] < first.lifetimes[:, 1]).all()


def chunk(**changes):
    return {"type": "splat", "size": 320, "texwidth": 4096, "texheight": 1, "cameras": [], **changes}


def splatv(chunks, data=bytes(320), magic=0x674B):
    text = json.dumps(chunks).encode()
    return struct.pack("<II", magic, len(text)) + text + data


SPLATV_BAD = [
    (splatv([chunk()], magic=7), r"not a \.splatv, expected it to open with 0x674b, found 0x7"),
    (b"", "found 0x0"),
    (struct.pack("<II", 0x674B, 2**31), "a header of 2147483648 bytes, expected at most 0"),
    (splatv([{"type": "text"}]), "no chunk of type splat with a size"),
    (splatv(3), "no chunk of type splat with a size"),
    (splatv([chunk(size="many")]), "no chunk of type splat with a size"),
    (splatv([chunk(size=-1)]), "truncated, 0 of -1 bytes"),
    (splatv([chunk(size=10**9)]), "truncated, 320 of 1000000000 bytes"),
    (splatv([chunk()], bytes(100)), "truncated, 100 of 320 bytes"),
    (splatv([chunk(frames=0)]), "0 frames at 30 a second, expected 1 to 100000"),
    (splatv([chunk()]), "none of its 5 Gaussians has a finite position and an orientation"),
]


@pytest.mark.parametrize(("content", "message"), SPLATV_BAD)
def test_bad_splatv(tmp_path, content, message):
    (tmp_path / "a.splatv").write_bytes(content)
    with pytest.raises(CaptureError, match=r"a\.splatv: .*" + message):
        open_sequence(tmp_path / "a.splatv")


# -- VideoGS


@pytest.fixture(scope="module")
def videogs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("videogs")
    for name in ("images", "videos"):
        with zipfile.ZipFile(GOLDEN / f"videogs_{name}.zip") as z:
            z.extractall(folder / name)
    return folder


@pytest.mark.parametrize(
    "maps", ["images/feature_image", "images/raw", "videos/feature_video", "videos/feature_video/png_all_0"]
)
def test_packed_maps_are_the_checkpoints(videogs, maps):
    packed, trained = open_sequence(videogs / maps), open_sequence(videogs / maps.split("/")[0])
    assert (packed.mode, [len(g) for g in packed.groups]) == ("scene", [2])
    assert (trained.mode, trained.frame_count) == ("tracked", 2)
    scales = 0.02 if maps.endswith("raw") else 0.25  # the usual script packs exp(scale) in 8 bits
    limits = {"means": 2e-4, "log_scales": scales, "angle": 0.03, "opacity": 0.13, "sh0": 0.012, "shN": 0.008}
    for t in range(2):
        assert_close(packed.frame(t), trained.frame(t), **limits)


def test_the_last_iteration_of_a_checkpoint_counts(videogs, tmp_path):
    shutil.copytree(videogs / "images" / "checkpoint", tmp_path / "checkpoint")
    old = tmp_path / "checkpoint" / "0" / "point_cloud" / "iteration_900"
    old.mkdir()
    (old / "point_cloud.ply").write_text("of an earlier iteration")
    (old.parent / "iteration_90000").mkdir()  # not saved yet
    assert open_sequence(tmp_path).frame_count == open_sequence(tmp_path / "checkpoint").frame_count == 2
    for ply in old.parent.rglob("*.ply"):
        ply.unlink()
    with pytest.raises(CaptureError, match=r"checkpoint/0: no iteration has a point_cloud.ply, expected one"):
        open_sequence(tmp_path)


def test_maps_without_the_viewers_ranges(videogs, tmp_path):
    shutil.copytree(videogs / "images" / "feature_image", tmp_path, dirs_exist_ok=True)
    wanted = open_sequence(tmp_path).frame(1)
    (tmp_path / "viewer_min_max.json").unlink()
    np.testing.assert_array_equal(open_sequence(tmp_path).frame(1).sh0, wanted.sh0)


def spoil_json(name, **changes):
    def spoil(folder):
        path = folder / name
        data = json.loads(path.read_text())
        key = next(iter(data))
        data[key] |= changes
        path.write_text(json.dumps(data))

    return spoil


VIDEOGS_BAD = [
    (lambda f: (f / "group0" / "0_4.png").unlink(), r"neither 0_4.png nor 4.mp4, VideoGS packs either"),
    (lambda f: (f / "group0" / "0_9.png").write_bytes(b"no image"), r"plane 9 of frame 0 is \(0, 0\), expected 8 x 8"),
    (lambda f: shorten(f / "group0" / "0_9.png"), "0_9.png: not a readable 8-bit grey PNG"),
    (spoil_json("viewer_min_max.json", num=10**12), "frame 0 has 1000000000000 Gaussians, expected 1 to 50000000"),
    (spoil_json("viewer_min_max.json", num=5000), r"frames 0 to 1 have \[20, 5000\] Gaussians, expected one number"),
    (spoil_json("viewer_min_max.json", info=[0, 1]), "frame 0 has 1 columns, expected 17, 26, 41 or 62"),
    (spoil_json("viewer_min_max.json", info="x"), "not valid .* expected num and info of each frame"),
    (spoil_json("group_info.json", name_index=[0]), r"not valid .* expected name_index: \[first, last\]"),
    (spoil_json("group_info.json", name_index=[7, 9]), r"frames 7 to 9 have \[\] Gaussians, expected one number"),
    (lambda f: (f / "group_info.json").write_text("{}"), "no groups, expected at least one"),
]


def shorten(path):
    path.write_bytes(path.read_bytes()[:40])


@pytest.mark.parametrize(("spoil", "message"), VIDEOGS_BAD)
def test_bad_videogs(videogs, tmp_path, spoil, message):
    shutil.copytree(videogs / "images" / "feature_image", tmp_path, dirs_exist_ok=True)
    spoil(tmp_path)
    with pytest.raises(CaptureError, match=message):
        open_sequence(tmp_path).frame(0)


# -- zips


def test_a_zip_is_what_it_holds(tmp_path):
    g = blob(40)
    for t in range(3):
        write_splat(tmp_path / f"{t}.spz", moved(g, np.zeros(3), np.array([0.01 * t, 0, 0])))
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as z:
        z.writestr("__MACOSX/._0.spz", b"litter")
        for t in range(3):
            z.write(tmp_path / f"{t}.spz", f"clip/{t}.spz")
    sequence = open_sequence(tmp_path / "a.zip")
    assert (sequence.mode, sequence.frame_count, len(sequence.frame(2))) == ("tracked", 3, 40)
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as z:
        z.write(GOLDEN / "spacetime.splatv", "deep/down/a.splatv")
    assert open_sequence(tmp_path / "b.zip").frame_count == 50
    assert open_sequence(GOLDEN / "videogs_images.zip").frame_count == 2
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as z:
        z.write(tmp_path / "0.spz", "2024/0.spz")
    assert open_sequence(tmp_path / "c.zip").frame_count == 1


def test_bad_zips(tmp_path, monkeypatch):
    (tmp_path / "a.zip").write_bytes(b"PK\3\4 no zip")
    with pytest.raises(CaptureError, match=r"a\.zip: not a readable zip .* expected a zip of splats"):
        open_sequence(tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "b.zip", "w", zipfile.ZIP_DEFLATED) as z:
        z.writestr("a.ply", bytes(10**7))
    with pytest.raises(CaptureError, match=r"10000000 bytes once unpacked, expected at most \d+; unpack it yourself"):
        open_sequence(tmp_path / "b.zip")
    with zipfile.ZipFile(tmp_path / "c.zip", "w"):
        pass
    with pytest.raises(CaptureError, match="0 files, expected a zip of 1 to 100000 files"):
        open_sequence(tmp_path / "c.zip")
    with zipfile.ZipFile(tmp_path / "d.zip", "w") as z:
        z.writestr("../../evil.ply", (GOLDEN / "source.ply").read_bytes())
    assert open_sequence(tmp_path / "d.zip").frame_count == 1
    assert not (tmp_path.parent.parent / "evil.ply").exists()
    with zipfile.ZipFile(tmp_path / "e.zip", "w") as z:
        z.writestr("readme.txt", b"no splats")
    with pytest.raises(CaptureError, match=r"e\.zip: no splats, expected one file per frame"):
        open_sequence(tmp_path / "e.zip")
    with pytest.raises(CaptureError, match=r"e\.zip: neither a capture nor splats"):
        detect_input(tmp_path / "e.zip")
    with zipfile.ZipFile(tmp_path / "g.zip", "w") as z:
        z.writestr("scene/transforms.json", b"{}")
    with pytest.raises(CaptureError, match=r"g\.zip: a zip of a capture, expected its folder; unpack the zip first"):
        detect_input(tmp_path / "g.zip")
    monkeypatch.setattr(archive, "SPARE", 10**18)
    with zipfile.ZipFile(tmp_path / "f.zip", "w") as z:
        z.writestr("a.ply", b"much larger than the disk")
    with pytest.raises(CaptureError, match="25 bytes once unpacked, expected at most 0"):
        open_sequence(tmp_path / "f.zip")


# -- all of them


@pytest.mark.parametrize(
    ("name", "what", "frames", "gaussians", "degree"),
    [
        ("source.ply", "3DGS .ply", 1, 5, 3),
        ("niantic_v2.spz", ".spz version 2 (Niantic)", 1, 5, 3),
        ("niantic_v4.spz", ".spz version 4 (Niantic)", 1, 5, 3),
        ("antimatter15.splat", ".splat (antimatter15)", 1, 5, 0),
        ("spacetime.splatv", ".splatv (Spacetime Gaussians, antimatter15)", 50, 5, 0),
        ("videogs_images.zip", "VideoGS checkpoints, 3DGS .ply in a zip", 2, 20, 1),
    ],
)
def test_describe(name, what, frames, gaussians, degree):
    facts = describe_splats(GOLDEN / name)
    assert (facts["format"], facts["frames"], facts["gaussians"], facts["sh_degree"]) == (
        what,
        frames,
        gaussians,
        degree,
    )
    assert facts["bytes"] == (GOLDEN / name).stat().st_size


def test_describe_packed_maps_and_compressed_ply(videogs, tmp_path):
    assert describe_splats(videogs / "images" / "raw")["format"] == "VideoGS packed maps"
    write_splat(tmp_path / "a.compressed.ply", gaussians(300))
    assert describe_splats(tmp_path / "a.compressed.ply")["format"] == "SuperSplat compressed .ply"


def test_round_trip_through_splat_transform(source, tmp_path):
    tool = shutil.which(os.environ.get("SPLAT_TRANSFORM", "splat-transform"))
    if not tool:
        pytest.skip("splat-transform is not installed (npm i -g @playcanvas/splat-transform)")
    write_splat(tmp_path / "a.spz", source)
    said = subprocess.run([tool, "--version"], capture_output=True, text=True)
    version = int(re.search(r"v(\d+)", said.stdout + said.stderr)[1])
    turned = ["-r", "180,0,0"] if version >= 3 else []  # version 3 keeps the axes of a .ply
    for given, made in (("a.spz", "b.ply"), ("b.ply", "c.spz"), ("a.spz", "d.glb")):
        subprocess.run([tool, "-q", tmp_path / given, *turned, tmp_path / made], check=True, capture_output=True)
    ours = read_splat(tmp_path / "a.spz")
    limits = {"angle": 1, "opacity": 1e-4, "sh0": 1e-4}  # half turns about own axes change nothing
    for name, means, shN, rtol in (("b.ply", 1e-6, 1e-5, 1e-3), ("c.spz", 2e-4, 0.07, 0.02)):
        back = read_splat(tmp_path / name)
        assert_close(back, ours, means=means, shN=shN, log_scales=1e-5, **limits)
        scale = np.abs(covariances(ours)).max((1, 2))[:, None, None]
        np.testing.assert_allclose(covariances(back) / scale, covariances(ours) / scale, atol=rtol)
    write_splat(tmp_path / "e.glb", ours)
    a, b = (read_glb(tmp_path / n)[1] for n in ("e.glb", "d.glb"))
    np.testing.assert_allclose(a["KHR_gaussian_splatting:SCALE"], b["KHR_gaussian_splatting:SCALE"], rtol=1e-5)
    with pytest.raises(UsageError, match="cannot tell the format from the name"):
        write_splat(tmp_path / "a.splat", source)


@pytest.mark.parametrize("name", [*SPZ, "antimatter15.splat", "spacetime.splatv"])
def test_damaged_bytes_are_named_or_read(tmp_path, name):
    """Changed or cut bytes give Gaussians or a CaptureError that names the file, and never another error."""
    data, r, path = (GOLDEN / name).read_bytes(), np.random.default_rng(1), tmp_path / name
    for _ in range(150):
        harmed = bytearray(data[: r.integers(1, len(data) + 1)] if r.random() < 0.3 else data)
        for at in r.integers(0, len(harmed), r.integers(1, 4)):
            harmed[at] = r.integers(256)
        path.write_bytes(harmed)
        said = str(path)
        try:
            assert open_sequence(path).frame(0).means.dtype == np.float32
        except CaptureError as e:
            said = str(e)
        assert str(path) in said

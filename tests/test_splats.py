"""Splat formats: written files read back the same, damage is named."""

import json
import struct
import subprocess
import sys
import zipfile

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import assert_close, gaussians

from gscodec.errors import CaptureError, UsageError
from gscodec.model.gaussians import Gaussians
from gscodec.splats import detect_input, read_splat, write_splat
from gscodec.splats.codebook import codebook, palette
from gscodec.splats.files import splat_size

FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


# -- .ply


@settings(max_examples=25, deadline=None)
@given(n=st.integers(0, 40), k=st.sampled_from([0, 3, 8, 15]), seed=st.integers(0, 99))
def test_ply_round_trip_is_exact(tmp_path_factory, n, k, seed):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    g = gaussians(n, k, seed).validate("test")
    write_splat(path, g)
    back = read_splat(path)
    for name in FIELDS:
        limit = 1e-6 if name == "quats" else 0
        np.testing.assert_allclose(getattr(back, name), getattr(g, name), rtol=0, atol=limit)
    assert splat_size(path) == (n, k)


def test_ply_is_what_plyfile_reads(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    g = gaussians(5, 3)
    write_splat(tmp_path / "a.ply", g)
    rows = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    np.testing.assert_array_equal(rows["f_rest_4"], g.shN[:, 1, 1])  # channel-major: green starts at 3
    np.testing.assert_array_equal(rows["rot_0"], g.quats[:, 0])
    np.testing.assert_array_equal(rows["opacity"], g.logit_opacities)


COLUMNS = ("unknown", *(f"rot_{i}" for i in range(4)), *(f"scale_{i}" for i in range(3)), "opacity")
COLUMNS += ("f_dc_0", "f_dc_1", "f_dc_2", "z", "y", "x")


@pytest.mark.parametrize("kind", ["ascii", "binary_big_endian", "binary_little_endian"])
def test_ply_in_any_order_and_encoding(tmp_path, kind):
    values = [9, 1, 0, 0, 0, -4, -5, -6, 0.5, 0.1, 0.2, 0.3, 3, 2, 1]
    lines = ["ply", f"format {kind} 1.0", "comment made by hand", "obj_info x", "element vertex 1"]
    lines += [f"property {'uchar' if c == 'unknown' else 'double'} {c}" for c in COLUMNS]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    row = " ".join(map(str, values)).encode() + b"\n3 0 0 0\n"
    if kind != "ascii":
        row = struct.pack((">" if "big" in kind else "<") + "B14d", *values) + b"\x01\x00\x00\x00\x00"
    (tmp_path / "a.ply").write_bytes("\n".join(lines).encode() + row)
    g = read_splat(tmp_path / "a.ply")
    assert g.means.tolist() == [[1, 2, 3]]
    assert g.quats.tolist() == [[1, 0, 0, 0]]
    assert g.log_scales.tolist() == [[-4, -5, -6]]
    assert g.logit_opacities.tolist() == [0.5]
    np.testing.assert_allclose(g.sh0, [[0.1, 0.2, 0.3]], rtol=1e-6)
    assert g.sh_degree == 0


HEADER = "ply\nformat {} 1.0\nelement vertex {}\n{}end_header\n"
PROPERTIES = "".join(f"property float {c}\n" for c in COLUMNS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("plyx", "not a PLY file"),
        ("ply\nformat ascii 1.0\n", "up to 'end_header'"),
        (HEADER.format("ascii", "many", ""), "header line 3 is not valid PLY: 'element vertex many'"),
        (HEADER.format("ascii", 1, "property wide x\n"), "header line 4 is not valid PLY"),
        (HEADER.format("middle_endian", 1, ""), "header line 2 is not valid PLY"),
        ("ply\nelement vertex 0\nend_header\n", "the header names no known format"),
        (HEADER.format("ascii", -2, "property float x\n"), "element vertex has a count of -2"),
        (HEADER.format("ascii", 1, "property float x\n" * 2), "has a property twice"),
        (HEADER.format("ascii", 1, "property float x\n") + "1\n", "no property y, z, f_dc_0, .* not a mesh"),
        (HEADER.format("ascii", 2, PROPERTIES) + "1 " * 20, "truncated, 1 of 2 rows of element vertex"),
        (HEADER.format("ascii", 1, PROPERTIES) + "x " * 15, "has a value that is not a number"),
        (HEADER.format("binary_little_endian", 9, PROPERTIES) + "1" * 150, "truncated, 2 of 9 rows"),
        (HEADER.format("binary_little_endian", 10**15, PROPERTIES), "truncated, 0 of 1000000000000000 rows"),
        (HEADER.format("ascii", 1, PROPERTIES + "property float f_rest_0\n") + "1 " * 16, "1 f_rest properties"),
        (HEADER.format("ascii", 1, PROPERTIES) + "nan " * 15, "means of Gaussian 0 is not finite"),
    ],
)
def test_bad_ply(tmp_path, content, message):
    (tmp_path / "a.ply").write_bytes(content.encode())
    with pytest.raises(CaptureError, match=message):
        read_splat(tmp_path / "a.ply")


def test_a_failed_write_leaves_nothing(tmp_path):
    g = gaussians(3)
    with pytest.raises(ValueError, match="dimension"):
        write_splat(tmp_path / "a.ply", Gaussians(g.means, g.quats[:2], g.log_scales, g.logit_opacities, g.sh0, g.shN))
    with pytest.raises(UsageError, match=r"cannot tell the format from the name"):
        write_splat(tmp_path / "a.obj", g)
    assert not list(tmp_path.iterdir())


def test_unknown_and_missing_files(tmp_path):
    with pytest.raises(CaptureError, match="no such file, expected a splat"):
        read_splat(tmp_path / "a.ply")
    (tmp_path / "a.xyz").touch()
    with pytest.raises(CaptureError, match="not a known splat format"):
        read_splat(tmp_path / "a.xyz")


# -- .compressed.ply


@pytest.mark.parametrize("k", [0, 15])
def test_compressed_ply_round_trip(tmp_path, k):
    g = gaussians(700, k)
    path = tmp_path / "a.compressed.ply"
    write_splat(path, g)
    assert splat_size(path) == (700, k)
    back = read_splat(path)
    step = 1 / 1023  # share of a chunk's range; the range is below 8 here
    assert_close(g, back, 8 * step, 8 * step, 2e-5, 0.5 / 255 + 1e-6, 8 / 255 / 2 + 1e-3, 8 / 256)
    write_splat(tmp_path / "b.compressed.ply", back)
    assert_close(back, read_splat(tmp_path / "b.compressed.ply"), 1e-5, 1e-5, 1e-6, 1e-6, 1e-5, 1e-5)


def compressed(path, chunks=1, rows=1, sh=None, drop="", more=()):
    """Writes a .compressed.ply of one Gaussian word by word, from the format's description."""
    names = [f"{m}_{a}" for m in ("min", "max") for a in ("x", "y", "z")]
    names += [*(f"{m}_scale_{a}" for m in ("min", "max") for a in "xyz"), *more]
    header = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    header += [f"property float {n}" for n in names if n != drop] + [f"element vertex {rows}"]
    header += [f"property uint packed_{w}" for w in ("position", "rotation", "scale", "color")]
    if sh is not None:
        header += [f"element sh {sh}", *(f"property uchar f_rest_{i}" for i in range(9))]
    bounds = [0, 0, 0, 1, 2, 4, -8, -8, -8, 0, 0, 0][: 12 - bool(drop)] + [0] * len(more)
    data = struct.pack(f"<{len(bounds)}f", *bounds) * chunks
    words = (2047 << 21 | 0 << 11 | 2047, 2 << 30 | 1023 << 20 | 512 << 10 | 512, 1 << 31, 255 << 24 | 128)
    data += struct.pack("<4I", *words) * rows + bytes(range(9)) * (sh or 0)
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + data)
    return path


def test_compressed_ply_bits(tmp_path):
    g = read_splat(compressed(tmp_path / "a.ply", sh=1))  # recognised by content, not by name
    assert g.means.tolist() == [[1, 0, 4]]
    np.testing.assert_allclose(g.log_scales, [[-8 + 8 * 1024 / 2047, -8, -8]], rtol=1e-6)
    np.testing.assert_allclose(g.quats, [[0.7071, 0, 0.7071, 0]], atol=2e-3)  # index 2 is y, wxyz
    np.testing.assert_allclose(g.sh0 * 0.28209479 + 0.5, [[1, 0, 0]], atol=1e-6)
    assert g.logit_opacities[0] == pytest.approx(np.log(128 / 127), rel=1e-5)
    assert g.shN[0, 0].tolist() == [-4, 8 * (3.5 / 256 - 0.5), 8 * (6.5 / 256 - 0.5)]


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        ({"chunks": 2}, "2 chunks for 1 Gaussians, expected 1 of 256"),
        ({"sh": 3}, "3 rows of SH for 1 Gaussians"),
        ({"drop": "max_x"}, "no property max_x, expected a SuperSplat compressed PLY"),
        ({"more": ["min_r", "min_g", "min_b", "max_r"]}, "no property max_g, max_b, expected a SuperSplat"),
    ],
)
def test_bad_compressed_ply(tmp_path, harm, message):
    with pytest.raises(CaptureError, match=message):
        read_splat(compressed(tmp_path / "a.ply", **harm))


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.sog", "a.drc"])
def test_formats_that_cannot_be_empty(tmp_path, name):
    with pytest.raises(CaptureError, match=r"no Gaussians to write; use .ply"):
        write_splat(tmp_path / name, gaussians(0))


# -- SOG


@pytest.mark.parametrize(("name", "k"), [("a.sog", 0), ("A.SOG", 8), ("folder/meta.json", 3)])
def test_sog_round_trip(tmp_path, name, k):
    g = gaussians(300, k)
    write_splat(tmp_path / name, g)
    path = tmp_path / "folder" if name.endswith("meta.json") else tmp_path / name
    assert detect_input(tmp_path / name) == "splats"
    assert splat_size(path) == (300, k)
    back = read_splat(path)
    assert_close(g, back, 4e-4, 0.5, 2e-4, 1 / 255, 0.5, 0.3)
    assert np.abs(back.log_scales - g.log_scales).mean() < 0.02
    assert np.abs(back.shN - g.shN).mean() < 0.01 if k else True
    write_splat(tmp_path / "b.sog", back)
    assert_close(back, read_splat(tmp_path / "b.sog"), 1e-5, 1e-6, 1e-4)


@pytest.fixture
def sog(tmp_path):
    """An unpacked SOG and a function that changes its meta.json."""
    write_splat(tmp_path / "meta.json", gaussians(20, 3))
    meta = json.loads((tmp_path / "meta.json").read_text())

    def save(**change):
        (tmp_path / "meta.json").write_text(json.dumps(meta | change))
        return tmp_path

    return meta, save


def test_sog_quaternion_tag_is_in_alpha(sog):
    folder = sog[1]()
    _, bgr = 0, np.full((4, 5, 4), 128, np.uint8)
    bgr[..., 3] = 254  # y is the largest
    cv2.imwrite(str(folder / "quats.webp"), bgr, [cv2.IMWRITE_WEBP_QUALITY, 101])
    np.testing.assert_allclose(read_splat(folder).quats, [[0, 0, 1, 0]] * 20, atol=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 3}, "SOG version 3, only 2 is read"),
        ({"version": None}, "SOG version None"),
        ({"count": 999}, r"not valid SOG version 2 \(ValueError: map .* has 25 pixels for 999|has \d+ pixels for 999"),
        ({"scales": {}}, "not valid SOG version 2 .KeyError: 'files'"),
        ({"sh0": {"files": ["none.webp"], "codebook": [0]}}, "map none.webp is missing"),
        ({"sh0": {"files": ["meta.json"], "codebook": [0]}}, "map meta.json is not a readable 8-bit colour image"),
        ({"sh0": {"files": ["sh0.webp"], "codebook": [0]}}, "not valid SOG version 2 .IndexError"),
    ],
)
def test_bad_sog(sog, change, message):
    with pytest.raises(CaptureError, match=message):
        read_splat(sog[1](**change))


def test_bad_sog_palette(sog):
    meta, save = sog
    with pytest.raises(CaptureError, match="SH palette is 192 pixels wide, expected 512"):
        read_splat(save(shN=meta["shN"] | {"bands": 2}))
    with pytest.raises(CaptureError, match="SH label 19 for a palette of 3"):
        read_splat(save(shN=meta["shN"] | {"count": 3}))


def test_sog_with_harmonics_of_null(sog):
    folder = sog[1](shN=None)
    assert splat_size(folder) == (20, read_splat(folder).shN.shape[1]) == (20, 0)


def test_bad_sog_bundles(tmp_path):
    (tmp_path / "a.sog").write_bytes(b"PK nothing")
    with pytest.raises(CaptureError, match=r"not a readable .sog"):
        read_splat(tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as z:
        z.writestr("a.txt", "")
    with pytest.raises(CaptureError, match=r"no readable meta.json"):
        read_splat(tmp_path / "a.sog")


def test_codebook_of_few_values_is_exact():
    values = np.array([[1.0, 2], [5, 1]], np.float32)
    levels, index = codebook(values)
    assert len(levels) == 256
    np.testing.assert_array_equal(np.array(levels, np.float32)[index], values)


def test_codebook_beats_even_steps():
    values = np.random.default_rng(0).normal(size=20000) ** 3
    levels, index = codebook(values)
    even = np.ptp(values) / 255 / np.sqrt(12)
    assert np.sqrt(np.mean((np.array(levels)[index] - values) ** 2)) < even / 2


def test_palette_cuts_where_there_are_too_many():
    vectors = np.random.default_rng(0).normal(size=(1000, 9)).astype(np.float32)
    entries, label = palette(vectors, 256)
    assert len(entries) == 256
    assert np.mean((entries[label] - vectors) ** 2) < 0.6 * vectors.var()


def test_ply_needs_numpy_alone(tmp_path):
    """A playback installation has none of the libraries of the `encode` extra."""
    write_splat(tmp_path / "a.ply", gaussians(4))
    missing = ("cv2", "OpenImageIO", "skimage", "scipy", "torch", "imageio_ffmpeg", "plyfile")
    code = f"import sys; sys.modules.update(dict.fromkeys({missing})); from gscodec.splats import *; "
    code += "s = open_sequence(sys.argv[1]); write_splat(sys.argv[2], s.frame(0)); print(len(s.frame(0)))"
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a.ply", tmp_path / "b.ply"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("4\n", "")
    assert_close(read_splat(tmp_path / "a.ply"), read_splat(tmp_path / "b.ply"))

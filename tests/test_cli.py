"""The command line as a user meets it: help, results on stdout, one clear sentence for each error."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic import turning

from gscodec.commands import checkout
from gscodec.errors import UsageError
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.progress import Bar
from gscodec.splats import write_sequence


def run(*args, cwd=None):
    """Runs `gscodec ARGS` in its own process."""
    code = "import sys; from gscodec.cli import main; main()"
    return subprocess.run([sys.executable, "-c", code, *map(str, args)], capture_output=True, text=True, cwd=cwd)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of tracked .ply frames and the stream made of it."""
    path = tmp_path_factory.mktemp("cli")
    write_sequence(turning(300, frames=5), path / "plys")
    done = run("encode", path / "plys", path / "a.gsv", "--json", path / "report.json")
    assert done.returncode == 0, done.stderr
    assert "5 frames" in done.stdout
    return path


def fails(result, *words, code=1):
    """Checks for one sentence on stderr, no traceback, nothing on stdout."""
    assert result.returncode == code, result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    for w in words:
        assert w in result.stderr


def test_help_names_every_command():
    result = run("--help")
    assert result.returncode == 0
    for command in ("encode", "train", "decode", "render", "play", "info", "masks", "eval", "bench", "chart"):
        assert command in result.stdout
        assert run(command, "--help").returncode == 0


def test_report_holds_the_size(folder):
    report = json.loads((folder / "report.json").read_text())
    assert report["bytes"] == (folder / "a.gsv").stat().st_size
    assert report["frames"] == 5
    assert sum(report["units"].values()) < report["bytes"]


def test_info_accounts_for_every_byte(folder):
    facts = json.loads(run("info", folder / "a.gsv", "--json").stdout)
    assert facts["frames"] == 5
    assert facts["gaussians"] > 250
    assert sum(u["bytes"] for u in facts["units"].values()) == facts["bytes"]
    assert "kB/frame" in run("info", folder / "a.gsv").stdout


def png_header(path):
    """Width, height and bit depth of a .png file."""
    header = path.read_bytes()[16:26]
    return int.from_bytes(header[:4], "big"), int.from_bytes(header[4:8], "big"), header[8]


def test_maps_come_back_to_the_same_bytes(folder, tmp_path):
    stream, maps = folder / "a.gsv", tmp_path / "maps"
    assert run("decode", "--maps", stream, maps).returncode == 0
    images = list(maps.glob("*.png"))
    assert len(images) >= 13
    width, height, depth = png_header(images[0])
    assert (width > 8, height > 8, depth) == (True, True, 16)
    done = run("encode", "--from-maps", maps, tmp_path / "b.gsv")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "b.gsv").read_bytes() == stream.read_bytes()
    images[0].unlink()
    bad = run("encode", "--from-maps", maps, tmp_path / "c.gsv")
    assert bad.returncode != 0
    assert "no attribute maps" in bad.stderr
    assert not (tmp_path / "c.gsv").exists()


def test_info_draws_the_maps(folder, tmp_path):
    assert run("info", folder / "a.gsv", "--maps", tmp_path / "maps.png").returncode == 0
    width, height, depth = png_header(tmp_path / "maps.png")
    assert (width > 100, height > 100, depth) == (True, True, 8)
    assert "--maps" in run("info", folder / "a.gsv", "--maps", tmp_path / "maps").stderr
    fails(run("info", folder / "plys", "--sheet", tmp_path / "a.jpg"), "--sheet", "must be named *.png")


def test_names_are_no_markup(folder, tmp_path, capsys):
    path = tmp_path / "take[final]:smile:.gsv"
    path.write_bytes((folder / "a.gsv").read_bytes())
    assert run("info", path).stdout.startswith(f"{path}: 5 frames")
    with Bar() as bar:
        bar._terminal = True
        bar.say("x[/a]:smile:")
    assert capsys.readouterr().err == "x[/a]:smile:\n"


def test_info_takes_endings_in_upper_case(folder, tmp_path):
    (tmp_path / "A.PLY").write_bytes((folder / "plys" / "000000.ply").read_bytes())
    assert "3DGS .ply" in run("info", tmp_path / "A.PLY").stdout


def test_eval_gives_the_quality_of_every_prefix(tmp_path):
    frames, same = turning(300, frames=6).groups[0].frames, np.arange(300, dtype=np.int32)
    groups = [DenseGroup(frames[t : t + 2], parents=same if t else None) for t in (0, 2, 4)]
    write_sequence(GaussianSequence(25, groups), tmp_path / "plys")
    done = run("encode", tmp_path / "plys", tmp_path / "l.gsv", "--layers", "3", "--random-access", "4")
    assert done.returncode == 0, done.stderr
    info = run("info", tmp_path / "l.gsv", "--json")
    facts = json.loads(info.stdout)
    assert [g["reference"] for g in facts["per_group"]] == [None, 0, None]
    assert len(facts["layers"]) == 3
    result = json.loads(run("eval", tmp_path / "l.gsv", tmp_path / "plys", "--frames", "2:3", "--json").stdout)
    prefixes = [*result["prefixes"], result]
    for key in ("codec_psnr", "bytes", "gaussians"):
        assert sorted(p[key] for p in prefixes) == [p[key] for p in prefixes], key
    assert result["codec_psnr"] > 3 + prefixes[0]["codec_psnr"]


def test_decode_and_encode_again(folder, tmp_path):
    assert run("decode", folder / "a.gsv", tmp_path / "plys").returncode == 0
    assert len(list((tmp_path / "plys").glob("*.ply"))) == 5
    assert run("decode", folder / "a.gsv", tmp_path / "plys", "--format", "spz").returncode == 0
    done = run("encode", tmp_path / "plys", tmp_path / "b.gsv", "--frames", "1:4")
    assert (done.returncode, "were changed" in done.stderr) == (0, False), done.stderr
    assert json.loads(run("info", tmp_path / "b.gsv", "--json").stdout)["frames"] == 3
    assert run("decode", folder / "a.gsv", tmp_path / "plys", "--frames", "0:2").returncode == 0
    assert not (tmp_path / "plys" / "sequence.json").exists(), "it would not fit the new frames"


def test_eval_against_the_splats(folder):
    result = run("eval", folder / "a.gsv", folder / "plys", "--frames", "0:2", "--json")
    facts = json.loads(result.stdout)
    assert facts["codec_psnr"] > 35, result.stderr
    assert len(facts["per_frame"]) == 2


def test_render_images_and_video(folder, tmp_path):
    assert run("render", folder / "a.gsv", tmp_path / "png", "--size", "64x48", "--frames", "0:2").returncode == 0
    assert sorted(p.name for p in (tmp_path / "png").iterdir()) == ["000000.png", "000001.png"]
    assert run("render", folder / "a.gsv", tmp_path / "new" / "a.mp4", "--size", "64x48").returncode == 0
    assert (tmp_path / "new" / "a.mp4").stat().st_size > 500
    assert not list(tmp_path.rglob("*.part*"))


def test_wrong_paths_and_values(folder, tmp_path):
    gsv = folder / "a.gsv"
    fails(run("encode", tmp_path / "nothing", tmp_path / "o.gsv"), "nothing")
    fails(run("encode", folder / "plys", tmp_path / "o.mp4"), "*.gsv")
    fails(run("encode", folder / "plys", tmp_path / "o.gsv", "--quality", "200"), "0 (small) to 100")
    fails(run("encode", folder / "plys", tmp_path / "o.gsv", "--frames", "9:12"), "frames 0 to 4")
    fails(run("encode", folder / "plys", tmp_path / "o.gsv", "--gop", "0"), "--gop")
    fails(run("encode", folder / "plys", tmp_path / "o.gsv", "--preset", "bar"), "--preset bar does not exist")
    both = ("--bitrate", "1M", "--quality", "10")
    fails(run("encode", folder / "plys", tmp_path / "o.gsv", *both), "--quality and --bitrate exclude each other")
    no_folder = ("--json", tmp_path / "none" / "r.json")
    fails(run("encode", folder / "plys", tmp_path / "o.gsv", *no_folder), "there is no folder", "make it first")
    fails(run("encode", "--from-maps", folder, tmp_path / "o.gsv", "--frames", "0:4"), "leave --frames away")
    fails(run("info", tmp_path / "no.gsv"), "no.gsv", "No such file")
    fails(run("render", gsv, tmp_path / "o", "--camera", "cam99"), "cam99", "orbit")
    fails(run("render", gsv, tmp_path / "o", "--size", "huge"), "WxH")
    fails(run("render", gsv, tmp_path / "o.avi"), ".mp4")
    fails(run("render", gsv, tmp_path / "o.mp4", "--size", "1x1"), "at least 2 x 2 pixels")
    fails(run("eval", gsv, folder), "neither a capture nor splats", "looked for")
    cut = (folder / "plys" / "000000.ply").read_bytes()[:-9]
    (tmp_path / "cut.ply").write_bytes(cut)
    fails(run("encode", tmp_path / "cut.ply", tmp_path / "o.gsv"), "cut.ply: truncated")
    (tmp_path / "cut.ply").unlink()
    fails(run("encode", gsv, tmp_path / "o.gsv"), "a stream already, neither a capture nor splats")
    fails(run("encode", tmp_path, tmp_path / "o.gsv"), "the folder is empty, neither a capture nor splats")
    fails(run("render", folder, tmp_path / "o.mp4"), "a folder, expected a .gsv file")
    fails(run("decode", folder / "report.json", tmp_path / "o"), "not a .gsv file")
    fails(run("decode", gsv, tmp_path / "o.splatv", "--format", "spz"), "--format spz", "is one .splatv")
    fails(run("encode"), "SEQ", code=2)
    assert not list(tmp_path.iterdir()), "nothing is left behind"


def test_an_empty_folder_says_what_was_looked_for(tmp_path):
    (tmp_path / "empty").mkdir()
    fails(run("encode", tmp_path / "empty", tmp_path / "o.gsv"), "empty", "transforms.json", ".ply")
    assert [p.name for p in tmp_path.iterdir()] == ["empty"], "nothing is left behind"


def test_a_stream_without_frames_is_refused(folder, tmp_path):
    empty = Path(__file__).parent.parent / "spec/vectors/valid/no_groups.gsv"
    for arguments in (("decode", empty, tmp_path / "d"), ("render", empty, tmp_path / "r"), ("eval", empty, folder)):
        fails(run(*arguments), "no_groups.gsv has no whole frame")
    assert not list(tmp_path.iterdir()), "nothing is left behind"
    told = run("info", empty)
    assert told.returncode == 0
    assert "0 frames" in told.stdout
    assert "bits" not in told.stdout, "of no Gaussian"
    assert "per Gaussian" not in told.stdout


def test_broken_files(folder, tmp_path):
    data = (folder / "a.gsv").read_bytes()
    broken = tmp_path / "b.gsv"
    broken.write_bytes(b"")
    fails(run("info", broken), "b.gsv", "empty")
    broken.write_bytes(b"not a stream at all, but long enough to be one")
    fails(run("info", broken), "b.gsv")
    hurt = bytearray(data)
    hurt[len(data) // 2] ^= 1
    broken.write_bytes(hurt)
    fails(run("decode", broken, tmp_path / "plys"), "b.gsv", "group 0")
    broken.write_bytes(data[: len(data) - 10])
    result = run("info", broken)
    assert "cut short" in result.stderr


def test_benchmarks_are_found_beside_the_package(tmp_path):
    pytest.importorskip("matplotlib")
    fails(run("chart", cwd=tmp_path), "no results that have a chart")


def test_an_installed_wheel_has_no_benchmarks(tmp_path, monkeypatch):
    monkeypatch.setattr(checkout, "PACKAGE", tmp_path / "gscodec")
    with pytest.raises(UsageError, match=r"not part of an installed wheel, and .*bench does not exist; clone"):
        checkout.require_bench()


def test_untracked_frames_are_said_to_be(tmp_path):
    from synthetic import blob

    frames = [blob(40 + 7 * t, seed=t) for t in range(3)]
    write_sequence(GaussianSequence(30, [DenseGroup([f]) for f in frames]), tmp_path / "plys")
    (tmp_path / "plys" / "sequence.json").unlink()
    result = run("encode", tmp_path / "plys", tmp_path / "o.gsv", "--keep-all")
    assert "independent" in result.stderr
    groups = json.loads(run("info", tmp_path / "o.gsv", "--json").stdout)["per_group"]
    np.testing.assert_array_equal([g["gaussians"] for g in groups], [40, 47, 54])


def test_train_writes_what_encode_takes(tmp_path):
    """The first half of encode on its own: two frames of the bundled capture, with the smallest budget."""
    capture = Path(__file__).parent.parent / "examples" / "lumberjack"
    done = run("train", capture, tmp_path / "plys", "--preset", "fast", "--frames", "0:1")
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "plys").glob("*.ply"))) == 1
    assert run("encode", tmp_path / "plys", tmp_path / "a.gsv").returncode == 0

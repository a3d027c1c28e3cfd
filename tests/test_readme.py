"""The figures of the README and of docs/ are those of bench/results."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from bench import sources

ROOT = Path(__file__).resolve().parent.parent
README = "\n".join(p.read_text() for p in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))))
RESULTS = ROOT / "bench" / "results"
SPLATS = ("statue", "statue40", "splatv")


def result(name):
    return json.loads((RESULTS / f"{name}.json").read_text())


def rows(heading):
    """Cells of the table whose first cell starts with `heading`, without the header rows."""
    lines = README.split("\n")
    first = next(i for i, line in enumerate(lines) if line.startswith(f"| {heading}"))
    table = []
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            return table
        table.append([cell.strip() for cell in line.strip("|").split("|")])
    return table


def agrees(cell, value):
    """Whether `value`, rounded to the digits of `cell`, equals it."""
    return cell == "-" if value is None else float(cell) == pytest.approx(value, abs=0.51 * 10 ** -decimals(cell))


def decimals(cell):
    return len(re.search(r"(?:\.(\d+))?$", cell)[1] or "")


def trained(capture, preset, recipe="gscodec"):
    found = [
        e
        for e in result("train")["entries"]
        if (e["capture"], e["preset"], e["recipe"], e["frames"][0], e["frames"][2]) == (capture, preset, recipe, 0, 1)
        and e["quality"] is None
    ]
    assert len(found) == 1, (capture, preset, recipe)
    return found[0]


def test_table_of_training():
    capture, keys = "", ("kb_per_frame", "psnr_fg", "psnr_corrected", "ssim")
    table = rows("capture | preset")
    assert len(table) >= 3
    for name, preset, *figures in table:
        capture = capture if name == "the same" else name.split(",")[0]
        e, model = trained(capture, preset), trained(capture, preset, "model")
        values = [*(e[k] for k in keys), model["psnr_fg"], e["gaussians"], e["seconds_per_frame"]]
        assert all(map(agrees, figures, values)), (name, preset, figures, values)


def test_table_of_other_qualities():
    found = {(e["capture"], e["preset"], e["quality"]): e for e in result("train")["entries"] if e["frames"][2] == 1}
    for name, quality, *figures in rows("capture, preset | `--quality`"):
        e = found[(*name.split(", "), float(quality))]
        assert all(map(agrees, figures, [e[k] for k in ("kb_per_frame", "psnr_fg", "seconds_per_frame")])), name


def test_table_of_frames_alone():
    entries = [e for e in result("train")["entries"] if e["preset"] == "medium" and e["quality"] is None]
    recipes = {
        "stream": "gscodec",
        "alone with the steps of medium's keyframe": "alone",
        "the same coded": "alone-coded",
        "alone in full": "full",
        "V3's recipe": "v3",
        "V3's recipe and packing": "v3-coded",
    }
    for name, *figures in rows("capture, step of the frames, recipe"):
        capture, step, recipe = name.split(", ")[:3]
        at = 1 if recipe == "stream" else int(step)
        [e] = (e for e in entries if (e["capture"], e["recipe"], e["frames"][2]) == (capture, recipes[recipe], at))
        psnr = np.mean(e["psnr_of_frame"][:: int(step) // at])
        assert all(map(agrees, figures, [e["kb_per_frame"], psnr, e["seconds_per_frame"]])), (name, psnr)


def test_table_of_stress():
    found, table = {e["case"]: e for e in result("stress")["entries"]}, rows("stress case")
    assert {name for name, *_ in table} == set(found)
    keys = ("psnr_fg", "psnr_fg_alone", "psnr_fg_worst", "floor", "kb_per_frame", "kb_per_frame_alone", "keyframes")
    for name, *figures, verdict in table:
        e = found[name]
        assert all(map(agrees, figures, [e[k] for k in keys])), (name, figures)
        assert e["verdict"].startswith(verdict.split(",")[0]), (name, verdict)


def test_table_of_what_moves_the_nodes():
    found = {(e["capture"], e["variant"]): e for e in result("ablation")["entries"]}
    table = {re.split(" as | at |,", name)[0]: figures for name, *figures in rows("capture | kB/frame | hash grid and")}
    assert set(table) == {capture for capture, _ in found}
    for name, figures in table.items():
        whole, v3 = found[name, "whole recipe"], found[name, "V3's grid"]
        of = {v: e["psnr_at_bytes"] for (c, v), e in found.items() if c == name and "psnr_at_bytes" in e}
        both = [whole["psnr_coded"], *(p for v, p in of.items() if v.startswith("seed"))]
        nodes = [p for v, p in of.items() if v.startswith("nodes alone")]
        assert figures == [
            f"{whole['kb_per_frame']:.2f}",
            *(f"{np.mean(p):.2f} ± {np.std(p, ddof=1):.2f} ({len(p)})" for p in (both, nodes)),
            f"{of['field alone']:.2f}",
            f"{v3['psnr_coded']:.2f} at {v3['kb_per_frame']:.2f}",
        ], name


def test_tables_of_streams():
    captures, keys, demo = rows("what was captured"), ("kb_per_frame", "psnr_fg"), result("demo")
    assert len(captures) >= 4
    for name, _, *figures in captures:
        values = [demo[k] for k in keys] + [demo["encode_seconds"] / demo["frames"]]
        if not name.startswith("bundled"):
            values = [trained(name.split(",")[0], "medium")[k] for k in (*keys, "seconds_per_frame")]
        assert all(map(agrees, figures, values)), (name, figures, values)
    keys = ("kb_per_frame", "bits_per_gaussian_frame", "codec_psnr", "codec_psnr_fg")
    for (name, *figures), found in zip(rows("splats, no training"), map(result, SPLATS), strict=True):
        values = [*(found[k] for k in keys), found["encode_seconds"] / found["frames"]]
        assert all(map(agrees, figures, values)), (name, figures, values)


def test_table_of_cores():
    measured = result("cores")["rows"]
    for figures, found in zip(rows("cores | training"), measured, strict=True):
        values = (found["cores"], found["train_s_per_frame"], found["decode_ms"])
        assert all(map(agrees, figures, values)), (figures, values)


def test_table_of_the_player():
    streams = {e["stream"]: e for e in result("player")["entries"]}
    names = ("demo", "demo_slow", "lumberjack", "statue", "statue_all")
    for (name, *figures), found in zip(rows("512 x 512, CPU path"), map(streams.get, names), strict=True):
        shown = ("gaussians", "first_picture_ms", "fps_clock", "fps_free")
        values = [*(found[k] for k in shown), found["decode"]["wasm_ms"], found["decode"]["ratio"]]
        assert all(map(agrees, (f.replace(",", "") for f in figures), values)), (name, figures, values)


def test_table_of_bd_rates():
    found = {(r["sequence"], r["anchor"]): r["percent"] for r in result("rd")["bd_rate"]}
    table = rows("peer | what it is given")
    assert {name for name, *_ in table} == {peer for _, peer in found}
    for name, _, *figures in table:
        values = [found.get((sequence, name)) for sequence in ("statue", "lumberjack")]
        assert all(agrees(f.removesuffix(" %"), v) for f, v in zip(figures, values, strict=True)), (name, values)


def test_bytes_before_the_first_picture():
    found = next(e for e in result("player")["entries"] if e["stream"] == "demo")
    kb, seconds = found["first_picture_bytes"] / 1000, found["first_picture_slow_ms"] / 1000
    assert f"has received {kb:.0f} kB over a slow link, stream and all, after {seconds:.1f} s" in " ".join(
        README.split()
    )


def test_table_of_sparse_points():
    found = {(e["case"], e["frame"], e["points"] > 0): e for e in result("points")["entries"]}
    for name, *figures in rows("frame 0 of"):
        none, points = found[name, 0, False], found[name, 0, True]
        values = [points["points"], *(e[k] for k in ("psnr", "ssim", "seconds") for e in (none, points))]
        assert all(map(agrees, figures, values)), (name, figures, values)


def test_table_of_depth_images():
    found = {(e["scene"], e["cameras"], e["variant"]): e for e in result("depth")["entries"]}
    variants = ("without", "start", "loss", "both")
    for name, *figures in rows("frame 3 of"):
        scene, cameras = name.removesuffix(" cameras").rsplit(", ", 1)
        entries = [found[scene, int(cameras), v] for v in variants]
        values = [e[key] for key in ("psnr_fg", "depth_error") for e in entries]
        assert all(map(agrees, figures, values)), (name, figures, values)


def test_table_of_a_capture_in_tracks():
    found = {e["stream"]: e for e in result("tracks")["entries"]}
    table = rows("basketball, 320 x 180")
    assert len(table) == len(found) == 2
    for name, *figures in table:
        e = found["one" if name == "one track" else "tracks"]
        assert all(map(agrees, figures, (e["kb_per_frame"], e["kb_per_frame_later"], e["psnr"], e["ssim"]))), name
    assert found["tracks"]["room_share_later"] <= 0.05


def test_what_a_rig_saves():
    saved = result("rig")["size_at_equal_psnr_percent"]
    text = "saves {} % of a stream of splats at equal PSNR, and {} % of a trained one"
    assert text.format(*(round(-saved[case]) for case in ("splats", "training"))) in " ".join(README.split())


def test_the_table_of_sources_is_that_of_the_results():
    page = sources.PAGE.read_text()
    assert sources.with_table(page) == page, "run python -m bench.sources"
    assert len(rows("figures")) > 15


def test_every_result_is_of_a_commit_without_changes():
    for file in RESULTS.glob("*.json"):
        dirty = set(re.findall(r'"commit": "(\w*\+)"', file.read_text()))
        assert not dirty, f"{file.name}: measure it again"

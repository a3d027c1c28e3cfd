"""Each peer codec returns its input as exactly as its finest setting allows; rd.json is kept entry by entry."""

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic import turning

pytest.importorskip("imageio_ffmpeg")
pytest.importorskip("DracoPy")
pytest.importorskip("zstandard")

from bench.baselines import BASELINES
from bench.baselines.grid import grid_order
from bench.plots.charts import draw_charts
from bench.rd import OURS, bd_rates, measure, update
from gscodec.splats import write_splat

KEYS = {"sequence", "codec", "setting", "kb_per_frame", "codec_psnr", "encode_s_per_frame", "decode_ms_per_frame"}
FINEST = {"videogs": "qp 8", "videogs-raw": "qp 8", "x265": "rp0", "svt-av1": "qp 4", "gsav": "snap 0"}
FINEST |= {"zstd": "8 bit", "webp": "8 bit", "draco": "16/8 bit", "sog": "default", "spz": "default"}
FINEST |= {"gpcc": "16 bit, QP 4"}


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_gives_its_input_back(name, tmp_path, monkeypatch):
    if name in ("sog", "spz") and not shutil.which(os.environ.get("SPLAT_TRANSFORM", "splat-transform")):
        pytest.skip("splat-transform is not installed: npm i -g @playcanvas/splat-transform@3")
    if name == "gpcc" and not shutil.which(os.environ.get("TMC3", "tmc3")):
        stand_in, command = Path(__file__).parent / "stand_in_tmc3.py", tmp_path / "tmc3"
        command.write_text(f"#!{sys.executable}\n{stand_in.read_text()}")
        command.chmod(0o755)
        monkeypatch.setenv("TMC3", str(command))
    frames = list(turning(n=60, frames=3).groups[0].frames)
    files = BASELINES[name].encode(frames, **BASELINES[name].settings[FINEST[name]])
    assert all(isinstance(data, bytes) for data in files.values())
    decoded = BASELINES[name].decode(files)
    assert len(decoded) == 3
    for given, got in zip(frames, decoded, strict=True):
        away = np.linalg.norm(given.means[:, None] - got.means[None], axis=2)
        index = away.argmin(1)  # the codecs return any order
        assert away.min(1).max() < 0.01
        assert len(set(index)) == 60
        assert np.abs(got.sh0[index] - given.sh0).max() < 0.15
        assert np.abs(got.log_scales[index] - given.log_scales).max() < 0.15
        assert np.median(np.abs((got.quats[index] * given.quats).sum(1))) > 0.999
        opacity = 1 / (1 + np.exp(-np.stack([got.logit_opacities[index], given.logit_opacities])))
        assert np.abs(np.diff(opacity, axis=0)).max() < 0.06


def test_the_grid_holds_everyone_once_and_puts_alike_ones_side_by_side():
    g = turning(n=1000, frames=1).frame(0)
    order = grid_order(g)
    assert order.shape == (32, 32)
    assert sorted(order[order >= 0]) == list(range(1000))
    near = np.abs(np.diff(g.means[order], axis=1)).mean()
    shuffled = np.random.default_rng(0).permutation(order.ravel()).reshape(order.shape)
    assert near < 0.3 * np.abs(np.diff(g.means[shuffled], axis=1)).mean()


def test_measuring_gives_the_keys_that_scripts_rely_on(tmp_path):
    (tmp_path / "splats").mkdir()
    write_splat(tmp_path / "splats" / "fruit.ply", turning(n=64, frames=1, sh_count=15).frame(0))
    for codec in (OURS, "zstd"):
        entries = list(measure("fruit", codec, tmp_path, tmp_path))
        assert len(entries) >= 4
        assert all(set(e) >= KEYS and e["kb_per_frame"] > 0 for e in entries)
        assert entries[-1]["codec_psnr"] > entries[0]["codec_psnr"] + 3


def entry(codec, setting, kb, psnr):
    times = {"encode_s_per_frame": 0.1, "decode_ms_per_frame": 1.0}
    return {"sequence": "s", "codec": codec, "setting": setting, "kb_per_frame": kb, "codec_psnr": psnr, **times}


def test_entries_replace_older_ones_and_bd_rates_follow(tmp_path):
    path = tmp_path / "rd.json"
    ours = [entry(OURS, f"quality {i}", 10.0 * 2**i, 40.0 + 2 * i) for i in range(4)]
    theirs = [entry("videogs", f"qp {i}", 100.0 * 2**i, 40.0 + 2 * i) for i in range(4)]
    assert list(update(path, [*ours, *theirs])) == [*ours, *theirs]
    (rate,) = json.loads(path.read_text())["bd_rate"]
    assert (rate["sequence"], rate["anchor"], rate["psnr"]) == ("s", "videogs", [40, 45])
    assert rate["percent"] == pytest.approx(-90)
    list(update(path, [entry(OURS, f"quality {i}", 5.0 * 2**i, 40.0 + 2 * i) for i in range(4)]))
    result = json.loads(path.read_text())
    assert len(result["entries"]) == 8
    assert result["bd_rate"][0]["percent"] == pytest.approx(-95)
    assert all({"cpu", "commit", "seconds", "busy_beside"} <= set(e["measured"]) for e in result["entries"])
    assert bd_rates(ours) == []


def test_charts_of_a_small_result(tmp_path):
    pytest.importorskip("matplotlib")
    entries = [entry(c, str(i), k * 2**i, 40.0 + 2 * i) for c, k in ((OURS, 10), ("videogs", 99)) for i in range(4)]
    everywhere = [{**e, "sequence": s} for e in entries for s in ("statue", "lumberjack", "fruit")]
    single = {**entry("sog", "default", 60.0, 43.0), "sequence": "fruit"}
    list(update(tmp_path / "rd.json", [*everywhere, single]))
    (share,) = json.loads((tmp_path / "rd.json").read_text())["shares"]
    assert share["kb"] == pytest.approx(10 * 2**1.5, abs=0.01)
    written = draw_charts(tmp_path, tmp_path / "charts")
    assert sorted(p.name for p in written) == [
        f"rd_{name}.{ending}" for name in ("frames", "size", "time") for ending in ("png", "svg")
    ]
    assert all("gscodec" in p.read_text() for p in written if p.suffix == ".svg")

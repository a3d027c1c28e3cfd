"""Benchmarks write the values that the charts read; scripts rely on the keys."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from synthetic import blob, turning

pytest.importorskip("torch")

from bench.ablation import FRAMES, VARIANTS, WHOLE
from bench.animate_splat import Motion, animate_splat, animated
from bench.machine import RESULTS, ROOT, write_result
from bench.plots.charts import draw_charts
from bench.raster import measure, run
from bench.scenes import capsule, capsule_camera
from bench.sequences import lasting
from bench.still import still_share
from bench.train import held_out, repeated
from gscodec.capture import open_capture
from gscodec.errors import CaptureError, UsageError
from gscodec.fit import fit_groups
from gscodec.model.gaussian_sequence import DenseGroup
from gscodec.model.parametric_group import ParametricGroup
from gscodec.ply_table import read_table
from gscodec.render import sensitivity
from gscodec.splats import write_splat
from gscodec.train.settings import train_settings

BENCH = ROOT / "bench"
KEYS = {
    "scene",
    "gaussians",
    "width",
    "height",
    "simd",
    "threads",
    "project_ms",
    "forward_ms",
    "backward_ms",
    "step_ms",
}


def entries():
    made = [measure("capsule", capsule(200), capsule_camera(32, 24), "scalar", t, 1) for t in (1, 2)]
    return [
        {**e, "gaussians": n, "width": w, "height": w}
        for e in made
        for n, w in ((50_000, 512), (100_000, 512), (100_000, 1024))
    ]


def test_charts_are_drawn_from_the_results_alone(tmp_path):
    pytest.importorskip("matplotlib")
    made = entries()
    assert set(made[0]) >= KEYS
    assert 0.05 < made[0]["covered"] < 0.5
    write_result(tmp_path / "raster.json", {"settings": {"simd": ["scalar"]}, "entries": made})
    assert {"machine", "commit", "settings"} <= set(json.loads((tmp_path / "raster.json").read_text()))
    first = [p.read_bytes() for p in draw_charts(tmp_path, tmp_path / "charts")]
    assert [p.read_bytes() for p in draw_charts(tmp_path, tmp_path / "charts")] == first
    assert len(first) == 2
    with pytest.raises(UsageError, match="no results that have a chart"):
        draw_charts(tmp_path / "charts", tmp_path)


def test_training_has_a_chart_of_what_is_there(tmp_path):
    pytest.importorskip("matplotlib")
    runs = (("model", "fast", 2, None), ("gscodec", "fast", 2.1, 7.0), ("gscodec", "medium", 7, 8.0))
    made = [
        {"capture": "a", "recipe": r, "preset": p, "seconds_per_frame": s, "kb_per_frame": kb, "psnr_fg": 26.0 + s}
        | {"frames": [0, 30, 1], "quality": None}
        for r, p, s, kb in runs
    ]
    made.append(made[-1] | {"quality": 40.0, "kb_per_frame": 4.0})
    made.append(made[-1] | {"preset": "of a few frames", "frames": [4, 10, 1]})
    write_result(tmp_path / "train.json", {"entries": made})
    assert [p.name for p in draw_charts(tmp_path, tmp_path / "charts")] == ["train.svg", "train.png"]
    svg = (tmp_path / "charts" / "train.svg").read_text()
    assert "medium" in svg
    assert svg.count("medium, quality 40") == 1, "beside size; it took the same time"
    assert "V3" not in svg
    assert "few" not in svg, "for flicker alone"


def test_ablation_shows_what_each_tool_is_worth(tmp_path):
    pytest.importorskip("matplotlib")
    keys = {"capture": "a", "preset": "fast", "frames": 10, "flicker": 0.5}
    made = [
        {**keys, "variant": v, "psnr_coded": p, "kb_per_frame": 4.0} for v, p in (("whole recipe", 26.0), ("x", 25))
    ]
    write_result(tmp_path / "ablation.json", {"entries": made})
    assert [p.name for p in draw_charts(tmp_path, tmp_path / "charts")] == ["ablation.svg", "ablation.png"]


def test_each_variant_of_the_ablation_changes_the_settings():
    whole = train_settings("fast")
    changed = {name: variant.change(whole) for name, variant in VARIANTS.items()}
    assert changed.pop(WHOLE) == whole
    assert whole not in changed.values()
    assert len(set(map(repr, changed.values()))) == len(changed), "two variants are the same"
    assert all(v.captures for v in VARIANTS.values())
    assert {c for v in VARIANTS.values() for c in v.captures} == set(FRAMES)


def test_each_entry_of_the_ablation_can_be_measured_again():
    entries = json.loads((RESULTS / "ablation.json").read_text())["entries"]
    assert all(e["capture"] in VARIANTS[e["variant"]].captures for e in entries)


def test_still_gaussians_cost_less_than_moving_ones(monkeypatch):
    monkeypatch.setattr(sensitivity, "SIZE", 128)
    g = blob(400)
    shift = np.where(np.arange(400) < 100, 0.1, 0.0)[:, None] * np.random.default_rng(0).standard_normal((400, 3))
    moving = DenseGroup([replace(g, means=(g.means + t * shift).astype(np.float32)) for t in range(4)])
    share, bits = still_share(next(fit_groups([moving])), 50.0, [])
    assert share == pytest.approx(0.75, abs=0.02)
    assert 0 < bits < 0.5
    assert still_share(next(fit_groups([DenseGroup([g] * 4)])), 50.0, [])[0] == 1


def test_what_lasts_keeps_its_parents():
    whole, short = [0, 2], [0, 1]
    lives = [np.array([whole, short, whole]), np.array([whole, whole, short, whole])]
    parents = [None, np.array([2, 1, 0, -1])]
    groups = [
        ParametricGroup(2, blob(len(life)), lifetimes=life, parents=p) for life, p in zip(lives, parents, strict=True)
    ]
    first, second = lasting(groups)
    assert first.lifetimes is second.lifetimes is first.parents is None
    np.testing.assert_array_equal(first.canonical.means, blob(3).means[[0, 2]])
    assert second.parents.tolist() == [1, -1, -1], "of one that was left out, and of none"


@pytest.mark.parametrize("script", [p for p in BENCH.glob("*.py") if "__main__" in p.read_text()], ids=lambda p: p.stem)
def test_scripts_say_how_they_are_used(script):
    command = [sys.executable, "-m", f"bench.{script.stem}", "--help"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: ")
    assert f"python -m bench.{script.stem}" in script.read_text()


def test_an_animated_splat_moves_and_keeps_its_other_properties(tmp_path):
    write_splat(tmp_path / "a.ply", turning(n=50, frames=1, sh_count=3).frame(0))
    static = read_table(tmp_path / "a.ply")["vertex"]
    first, second = animated(static, 2, Motion())
    assert np.abs(second["x"] - first["x"]).max() > 1e-4
    np.testing.assert_array_equal(second["f_rest_8"], static["f_rest_8"])
    np.testing.assert_allclose(sum(second[f"rot_{i}"] ** 2 for i in range(4)), 1, rtol=1e-5)
    still = next(animated(static, 1, Motion(amount=0, jitter=0)))
    for name in static.dtype.names:
        np.testing.assert_allclose(still[name], static[name], rtol=1e-5, atol=1e-6, err_msg=name)
    animate_splat(tmp_path / "a.ply", tmp_path / "plys", 2)
    written = [read_table(tmp_path / "plys" / f"00000{t}.ply")["vertex"] for t in range(2)]
    assert [w.tobytes() for w in written] == [first.tobytes(), second.tobytes()], "equal arguments, equal values"


def test_only_a_ply_is_animated(tmp_path):
    with pytest.raises(CaptureError, match=r"no such file, expected a \.ply"):
        animate_splat(tmp_path / "no.ply", tmp_path / "plys", 2)
    assert not (tmp_path / "plys").exists()


def test_cameras_are_taken_out_of_training(tmp_path):
    capture = open_capture(ROOT / "examples" / "lumberjack")
    held = held_out(capture, ("cam16", "cam17"))
    names = [c.name for c in held.cameras]
    assert [names[i] for i in held.indices("test")] == ["cam16", "cam17"]
    assert len(held.indices("train")) == 10, "the capture's own test cameras are gone"
    np.testing.assert_array_equal(
        held.view(names.index("cam17"), 3).rgb,
        capture.view([c.name for c in capture.cameras].index("cam17"), 3).rgb,
    )
    with pytest.raises(UsageError, match="no camera cam99"):
        held_out(capture, ("cam99",))


def test_a_walk_goes_round():
    capture = open_capture(ROOT / "examples/lumberjack").frames(3, 5)
    for back, walk in ((False, (0, 1, 0, 1)), (True, (0, 1, 1, 0))):
        twice = repeated(capture, 2, back=back)
        assert twice.frame_count == 4
        assert all(np.array_equal(twice.view(0, i).rgb, capture.view(0, t).rgb) for i, t in enumerate(walk))


def test_a_missing_file_is_said(tmp_path):
    said = []
    assert list(run(("statue",), data=tmp_path, say=said.append)) == []
    missing = tmp_path / "splats" / "statue.ply"
    assert said == [f"statue: left out, {missing} is not there; the data folder (GSCODEC_DATA) must have it"]

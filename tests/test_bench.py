"""Benchmarks write what the charts read; scripts rely on the keys."""

import json

import numpy as np
import pytest

pytest.importorskip("torch")

from bench.machine import ROOT, write_result
from bench.raster import measure, run
from bench.scenes import capsule, capsule_camera
from bench.train import held_out
from gscodec.capture import open_capture
from gscodec.errors import UsageError
from gscodec.metrics.charts import draw_charts

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
        | {"frames": [0, 30, 1]}
        for r, p, s, kb in runs
    ]
    made.append(made[-1] | {"preset": "of a few frames", "frames": [4, 10, 1]})
    write_result(tmp_path / "train.json", {"entries": made})
    assert [p.name for p in draw_charts(tmp_path, tmp_path / "charts")] == ["train.svg", "train.png"]
    svg = (tmp_path / "charts" / "train.svg").read_text()
    assert "medium" in svg
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


def test_every_ablation_changes_the_settings():
    pytest.importorskip("torch")
    from bench.ablation import VARIANTS, WHOLE
    from gscodec.train.settings import TrainSettings

    whole = TrainSettings()
    assert [name for name, v in VARIANTS.items() if v.change(whole) == whole] == [WHOLE]


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


def test_a_missing_file_is_said(tmp_path):
    said = []
    assert list(run(("statue",), data=tmp_path, say=said.append)) == []
    missing = tmp_path / "splats" / "statue.ply"
    assert said == [f"statue: left out, {missing} is not there; the data folder (GSCODEC_DATA) must have it"]

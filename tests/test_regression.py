"""Size against quality must not regress: each figure is recorded, with a tolerance.

Two small trained groups are coded in several ways (trained.py); the bundled capture is encoded as users do. A codec
figure that improves beyond its tolerance also fails: record it again (make_trained.py), or the gain may be lost later.
"""

import json
import math

import pytest
from test_cli import run
from trained import CASES, DATA, EXAMPLE, TOLERANCES, load_groups, measure

from gscodec.decode import open_stream

RECORDED = json.loads((DATA / "recorded.json").read_text())
# A run on another machine differs from the recorded runs as a run with another seed does: it is one more sample, which
# lies with 99 % within STUDENT * deviation * sqrt(1 + 1 / seeds) of the mean (Student's t, 19 degrees of freedom).
# Bytes vary more than decibels, since each run chooses its own quality, within a tolerance.
SEEDS, STUDENT = 20, 2.86
LEAST = {"kb_per_frame": 0.02, "ssim": 0.001, "vmaf": 0.5, "flicker": 0.02, "haze": 0.02}  # least interval; dB: 0.05


def test_the_groups_are_what_training_makes():
    first, second = load_groups()
    assert first.parents is None
    assert (second.parents >= 0).mean() > 0.9
    assert first.canonical.shN.shape[1] == 3
    assert (first.lifetimes != [0, len(first)]).any()
    assert first.nodes is not None
    assert len(first.trajectories) == 5
    assert first.calibration is not None
    assert (DATA / "groups.npz").stat().st_size < 200_000


@pytest.mark.parametrize("name", CASES)
def test_codec_alone(name, tmp_path):
    """Tight tolerances: the coder is deterministic, the renderer nearly so."""
    found, recorded = measure(CASES[name], tmp_path / "a.gsv"), RECORDED["codec"][name]
    assert set(found) == set(recorded)
    for key, value in recorded.items():
        tolerance = TOLERANCES[key] * (value if key == "kb_per_frame" else 1)
        assert abs(found[key] - value) <= tolerance, f"{key} of {name}: {found[key]}, recorded {value}"


def test_the_cases_are_what_their_names_say(tmp_path):
    def groups(name):
        CASES[name].stream(tmp_path / f"{name}.gsv")
        return open_stream(tmp_path / f"{name}.gsv").groups

    assert [g["sync"] for g in groups("predicted")] == [True, False]
    assert len(groups("independent")) == 1
    assert open_stream(tmp_path / "predicted.gsv").group(0).sh_degree == 1
    groups("layers")
    assert len(open_stream(tmp_path / "layers.gsv").group(0).layers) == 3


def test_bundled_capture_from_end_to_end(tmp_path):
    """Each figure lies within the 99 % interval over seeds; see SEEDS."""
    recorded = RECORDED["capture"]
    assert recorded["seeds"] == SEEDS
    done = run("encode", EXAMPLE, tmp_path / "a.gsv", "--preset", "fast", "--frames", "0:8")
    assert done.returncode == 0, done.stderr
    measured = json.loads(run("eval", tmp_path / "a.gsv", EXAMPLE, "--json").stdout)
    measured["worst_psnr_fg"] = min(r["psnr_fg"] for r in measured["per_frame"])
    for key, figure in recorded["figures"].items():
        worse = 1 if key in ("kb_per_frame", "haze", "flicker") else -1
        least = LEAST.get(key, 0.05) * (figure["mean"] if key == "kb_per_frame" else 1)
        interval = max(least, STUDENT * figure["deviation"] * math.sqrt(1 + 1 / SEEDS))
        excess = worse * (measured[key] - figure["mean"])
        assert excess <= interval, f"{key}: {measured[key]}, recorded {figure['mean']} +- {interval:.3f}"
        if key in ("kb_per_frame", "psnr_fg"):
            assert interval <= (0.12 * figure["mean"] if key == "kb_per_frame" else 0.4), (
                f"{key}: the seeds are far apart"
            )

"""Size against quality, kept from slipping: what was reached is recorded here, with a tolerance.

`trained.npz` is 4 frames of a trained lumberjack (tests/make_trained.py); the bundled capture is encoded as users do.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic import encode_sequence, from_npz
from test_cli import run

from gscodec.decode import open_stream
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.metrics.evaluate import evaluate_splats

HERE = Path(__file__).parent
RECORDED = json.loads((HERE / "data" / "recorded.json").read_text())


@pytest.mark.parametrize("quality", [30, 50, 70])
def test_codec_alone(tmp_path, quality):
    """Tight: the coder is deterministic, the renderer nearly so."""
    sequence = from_npz(HERE / "data" / "trained.npz")
    out = tmp_path / "a.gsv"
    config = stream_config(fps=30, sh_degree=0, gaussians=4000, frames=4)
    report = encode_sequence(sequence, out, config, EncodeSettings(quality=quality))
    measured = evaluate_splats(open_stream(out).frame, sequence, frames=[0, 3], size=report.bytes)
    recorded = RECORDED["codec"][str(quality)]
    assert measured["kb_per_frame"] <= 1.02 * recorded["kb_per_frame"]
    assert measured["codec_psnr"] >= recorded["codec_psnr"] - 0.1


def test_bundled_capture_from_end_to_end(tmp_path):
    """Loose: training depends on the order of floating-point sums of each machine."""
    capture = HERE.parent / "examples" / "lumberjack"
    done = run("encode", capture, tmp_path / "a.gsv", "--preset", "fast", "--frames", "0:10")
    assert done.returncode == 0, done.stderr
    measured = json.loads(run("eval", tmp_path / "a.gsv", capture, "--json").stdout)
    recorded = RECORDED["capture"]
    assert measured["psnr_fg"] >= recorded["psnr_fg"] - 0.7
    assert measured["kb_per_frame"] <= 1.2 * recorded["kb_per_frame"]
    assert measured["vmaf"] >= recorded["vmaf"] - 6
    assert measured["haze"] <= recorded["haze"] + 0.5
    worst = min(r["psnr_fg"] for r in measured["per_frame"])
    assert worst >= recorded["worst_psnr_fg"] - 1.2, "no frame falls behind"
    assert np.isfinite(measured["flicker"])

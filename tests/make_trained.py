"""Makes tests/data: a small trained sequence, and the figures that test_regression.py holds the code to.

usage: python tests/make_trained.py [--figures-only]   (after a change that is meant to change them; look at the diff)
"""

import json
import sys
import tempfile
from pathlib import Path

from synthetic import encode_sequence, from_npz, to_npz
from test_cli import run

from gscodec.capture import open_capture
from gscodec.decode import open_stream
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.metrics.evaluate import evaluate_splats
from gscodec.train.settings import train_settings
from gscodec.train.train import train_groups

DATA = Path(__file__).parent / "data"
EXAMPLE = Path(__file__).parent.parent / "examples" / "lumberjack"


def codec(quality: int, folder: Path) -> dict:
    """Size and PSNR of the stored sequence at one quality."""
    sequence = from_npz(DATA / "trained.npz")
    config = stream_config(fps=30, sh_degree=0, gaussians=4000, frames=4)
    out = folder / "a.gsv"
    report = encode_sequence(sequence, out, config, EncodeSettings(quality=quality))
    m = evaluate_splats(open_stream(out).frame, sequence, frames=[0, 3], size=report.bytes)
    return {k: round(m[k], 3) for k in ("kb_per_frame", "codec_psnr", "codec_psnr_fg")}


def capture(folder: Path) -> dict:
    """The bundled capture, end to end."""
    run("encode", EXAMPLE, folder / "b.gsv", "--preset", "fast", "--frames", "0:10")
    m = json.loads(run("eval", folder / "b.gsv", EXAMPLE, "--json").stdout)
    figures = {k: round(m[k], 3) for k in ("kb_per_frame", "psnr_fg", "psnr", "ssim", "vmaf", "haze", "flicker")}
    return figures | {"worst_psnr_fg": round(min(r["psnr_fg"] for r in m["per_frame"]), 3)}


def main() -> None:
    """Writes trained.npz and recorded.json."""
    DATA.mkdir(exist_ok=True)
    if "--figures-only" not in sys.argv:
        settings = train_settings("fast", gaussians_max=3000, initial_points=2500)
        to_npz(DATA / "trained.npz", next(train_groups(open_capture(EXAMPLE).frames(0, 4), settings)))
    with tempfile.TemporaryDirectory() as folder:
        figures = {"codec": {str(q): codec(q, Path(folder)) for q in (30, 50, 70)}, "capture": capture(Path(folder))}
    (DATA / "recorded.json").write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()

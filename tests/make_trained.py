"""Makes tests/data: two small trained groups, and the recorded figures for test_regression.py.

usage: python tests/make_trained.py [groups] [codec] [capture]   (all three by default; capture takes minutes)

Run it after a change that is meant to change the figures, and check the diff.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from trained import CASES, DATA, EXAMPLE, FRAMES, GOP, capture, load_groups, measure, save_groups

from gscodec.train.settings import train_settings
from gscodec.train.train import train_groups

SEEDS = 20
RECORDED = DATA / "recorded.json"
WITH_SEED = """
import sys
from gscodec.cli import main
from gscodec.train import settings
settings.PRESETS["fast"]["seed"] = int(sys.argv.pop(1))
main()
"""


def groups() -> None:
    """Trains the groups; harmonics of degree 1 are kept, although these few Gaussians gain nothing by them."""
    settings = train_settings("fast", gop=GOP, gaussians_max=1200, initial_points=900, sh_degree=1)
    settings = replace(settings, keyframe=replace(settings.keyframe, harmonics_gain_min=-1.0))
    save_groups(list(train_groups(capture(), settings, random_access=FRAMES)))
    load_groups.cache_clear()


def codec() -> dict:
    """Figures of the cases: the trained groups, coded in several ways."""
    with tempfile.TemporaryDirectory() as folder:
        return {name: measure(case, Path(folder) / "a.gsv") for name, case in CASES.items()}


def encoded(seed: int, folder: Path) -> dict:
    """Figures of the bundled capture, encoded as users do, but with the random seed `seed`."""
    stream, command = folder / "b.gsv", [sys.executable, "-c", WITH_SEED, str(seed)]
    subprocess.run([*command, "encode", EXAMPLE, stream, "--preset", "fast", "--frames", "0:8"], check=True)
    done = subprocess.run([*command, "eval", stream, EXAMPLE, "--json"], check=True, capture_output=True, text=True)
    stream.unlink()
    m = json.loads(done.stdout)
    figures = {k: m[k] for k in ("kb_per_frame", "psnr_fg", "psnr", "ssim", "vmaf", "haze", "flicker")}
    return figures | {"worst_psnr_fg": min(r["psnr_fg"] for r in m["per_frame"])}


def over_seeds() -> dict:
    """Mean and standard deviation of each figure over seeds."""
    with tempfile.TemporaryDirectory() as folder:
        found = [encoded(seed, Path(folder)) for seed in range(SEEDS)]
    values = {k: [f[k] for f in found] for k in found[0]}
    spread = {k: {"mean": float(np.mean(v)), "deviation": float(np.std(v, ddof=1))} for k, v in values.items()}
    return {"seeds": SEEDS, "figures": {k: {n: round(x, 4) for n, x in s.items()} for k, s in spread.items()}}


def main() -> None:
    """Writes groups.npz and recorded.json, or the parts of them that are named."""
    parts = sys.argv[1:] or ["groups", "codec", "capture"]
    recorded = json.loads(RECORDED.read_text())
    if "groups" in parts:
        groups()
    if "codec" in parts:
        recorded["codec"] = codec()
    if "capture" in parts:
        recorded["capture"] = over_seeds()
    RECORDED.write_text(json.dumps(recorded, indent=1) + "\n")
    print(json.dumps(recorded, indent=1))


if __name__ == "__main__":
    main()

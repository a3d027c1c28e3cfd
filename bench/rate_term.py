"""Bits of the canonical attributes: training's estimate beside the coder's, in bench/results/rate_term.json.

usage: GSCODEC_DATA=... python -m bench.rate_term

The first frames of lumberjack are trained (preset fast) with several weights of the rate term. The estimate is at the
nominal steps of training; the coder uses measured steps and rate-distortion optimisation, as `gscodec encode` does.
Bits per Gaussian.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np
import torch

from gscodec.bitstream.quantization import steps_for, subject_radius
from gscodec.capture import open_capture
from gscodec.encode.coder import GroupCoder
from gscodec.encode.settings import EncodeSettings
from gscodec.train.entropy_model import CanonicalRate
from gscodec.train.model import from_gaussians
from gscodec.train.settings import train_settings
from gscodec.train.train import train_groups

from .data import data_folder
from .machine import RESULTS, write_result

FRAMES, QUALITY = 4, 62.0
WEIGHTS = (0.0, 0.02, 0.08, 0.32)


def rows(capture, weight: float) -> list[dict]:
    """A row per attribute of a group trained with this weight of the rate term."""
    settings = train_settings("fast", gop=FRAMES, rate_lambda=weight, quality=QUALITY)
    group = next(train_groups(capture, settings))
    model = from_gaussians(group.canonical)
    steps = steps_for(QUALITY, subject_radius(group.canonical.means))
    rate = CanonicalRate(model.params["means"], steps, settings.entropy_model)
    estimated = rate.bits(model.params, torch.Generator().manual_seed(0))
    cameras = [capture.cameras[i] for i in capture.indices("train")]
    coder = GroupCoder(EncodeSettings(QUALITY, refine=0), cameras=lambda _: cameras)
    coded, _ = coder.code(None, group, coder.measure(group, 0), QUALITY, 0)
    bits = Counter()
    for unit in coded.units:  # of all layers
        if unit["type"] == "channels":
            bits[unit["attribute"]] += 8 * unit["bytes"]
    return [
        {
            "rate_lambda": weight,
            "attribute": name,
            "estimated": round(estimated[name].item() / len(model), 2),
            "coded": round(count / coded.gaussians, 2),
        }
        for name, count in bits.items()
    ]


def correlations(table: list[dict]) -> dict[str, float]:
    """Correlation of estimated and coded bits: per attribute over the weights, and over all rows."""
    chosen = {
        name: [r for r in table if r["attribute"] == name] for name in dict.fromkeys(r["attribute"] for r in table)
    }
    return {
        name: round(float(np.corrcoef([(r["estimated"], r["coded"]) for r in some], rowvar=False)[0, 1]), 3)
        for name, some in (chosen | {"all": table}).items()
    }


def main() -> None:
    """Writes the table."""
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    capture = replace(open_capture(data_folder() / "lumberjack"), frame_count=FRAMES)
    table = [row for weight in WEIGHTS for row in rows(capture, weight)]
    correlation = correlations(table)
    write_result(
        RESULTS / "rate_term.json", {"frames": FRAMES, "quality": QUALITY, "correlation": correlation, "rows": table}
    )
    print(*table, f"correlation {correlation}", sep="\n")


if __name__ == "__main__":
    main()

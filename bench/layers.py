"""Size and quality of layered coding: one frame of the statue in 1 to 4 layers.

usage: GSCODEC_DATA=... python -m bench.layers        writes bench/results/layers.json

A row per prefix of the layers: bytes, codec PSNR, and the PSNR with the best of nine corrections of scale and opacity
(spec, "Layer correction").
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import product

import numpy as np

from gscodec import _native
from gscodec.encode.coder import GroupCoder
from gscodec.encode.settings import EncodeSettings
from gscodec.metrics.codec_cameras import codec_cameras
from gscodec.metrics.image import psnr
from gscodec.model.gaussians import Gaussians
from gscodec.model.parametric_group import ParametricGroup
from gscodec.render.image import render_image
from gscodec.splats import read_splat

from .data import data_folder
from .machine import RESULTS, write_result

SCALES, OPACITIES = (0.0, 0.15, 0.3), (0.0, 0.3, 0.7)
LEVEL, QUALITY = 4, 50


def main() -> None:
    """Writes the results."""
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    original = read_splat(data_folder() / "splats" / "statue.ply")
    cameras = codec_cameras([original])[::2]
    images = [render_image(original, c) for c in cameras]

    def quality(g: Gaussians) -> float:
        return round(float(np.mean([psnr(i, render_image(g, c)) for i, c in zip(images, cameras, strict=True)])), 2)

    rows, group = [], ParametricGroup(1, original)
    importance = GroupCoder(EncodeSettings()).measure(group, 0)
    for layers in range(1, 5):
        coder = GroupCoder(EncodeSettings(layers=layers, refine=0))
        coded, _ = coder.code(None, group, importance, QUALITY, 0)
        for k in range(1, layers + 1):
            g = Gaussians(**_native.DecodedGroup(coded.payload, LEVEL, layers=k).frame(0))
            size = sum(u["bytes"] for u in coded.units if u["layer"] < k)
            row = {"layers": layers, "prefix": k, "gaussians": len(g), "bytes": size, "codec_psnr": quality(g)}
            if k < layers:
                tried = {}
                for s, o in product(SCALES, OPACITIES):
                    shift = {"log_scales": g.log_scales + np.float32(s)}
                    shift["logit_opacities"] = g.logit_opacities + np.float32(o)
                    tried[quality(replace(g, **shift))] = {"log_scales": s, "logit_opacities": o}
                row["with_best_correction"] = {"codec_psnr": max(tried), **tried[max(tried)]}
            rows.append(row)
            print(row, flush=True)
    write_result(RESULTS / "layers.json", {"scene": f"statue, 101,275 Gaussians, quality {QUALITY}", "rows": rows})


if __name__ == "__main__":
    main()

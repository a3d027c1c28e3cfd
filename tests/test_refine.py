"""Refinement of a single frame: the picture comes nearer to the source for about the same bytes."""

import numpy as np
from synthetic import blob

from gscodec import _native
from gscodec.encode.group import group_integers
from gscodec.gaussians import Gaussians, GaussianSequence, Group
from gscodec.metrics.evaluate import evaluate_splats


def test_a_refined_frame_is_nearer(monkeypatch):
    monkeypatch.setattr("gscodec.encode.curves.LEAST", 1000)
    group = Group([blob(1500, sh_count=3)])
    sequence = GaussianSequence(30.0, [group])
    found = []
    for views in (0, 20):
        payload, _ = _native.encode_group(group_integers(group, 60, refine_steps=views))
        decoded = Gaussians(**_native.DecodedGroup(payload, 1).frame(0))
        found.append((len(payload), evaluate_splats(lambda _, g=decoded: g, sequence)["codec_psnr"]))
    (plain, before), (refined, after) = found
    assert after > before + 0.1
    assert refined < 1.03 * plain


def test_positions_and_order_stay():
    group = Group([blob(1200)])
    plain, refined = (group_integers(group, 70, refine_steps=n) for n in (0, 3))
    assert np.array_equal(plain["positions"], refined["positions"])
    assert plain["shifts"] == refined["shifts"]

"""The shortest stress cases, at a fraction of their size: no crash, no divergence, no explosion of the count."""

from dataclasses import replace

import numpy as np
import pytest
from training import AS_SET

from bench import stress
from bench.stress_scenes import CASES, SCENES, cut, walking
from gscodec.render import sensitivity

TINY = {
    "keyframe_steps": 100,
    "motion_steps": 20,
    "finetune_steps": 8,
    "gaussians_max": 300,
    "initial_points": 200,
    "budget": AS_SET,
}
SMALL = {"train": 5, "test": 1, "size": 48, "frames": 3}


def late(t: int) -> list:
    """A walking figure that is absent in the first frame."""
    return [] if t == 0 else walking(t)


@pytest.mark.parametrize(
    ("case", "changes"),
    [
        ("one frame", {"frames": 1}),
        ("empty frames", {"shapes": late}),
        ("empty frames", {"shapes": lambda t: [], "frames": 2}),
        ("scene cut", {"shapes": lambda t: cut(t + 14)}),
        ("static", {}),
    ],
    ids=["one frame", "late", "all empty", "scene cut", "static"],
)
def test_stress(case, changes, monkeypatch):
    monkeypatch.setattr(sensitivity, "SIZE", 128)
    monkeypatch.setattr(stress, "FACTORS", (1,))
    scene = replace(SCENES[case], **(SMALL | changes))
    found = stress.compare(scene.capture(case), **TINY)
    assert sum(found["groups"]) == scene.frames
    assert found["finite"]
    assert found["gaussians_most"] <= TINY["gaussians_max"]
    assert found["kb_per_frame"] > 0
    assert found["haze"] < 1, "nothing where nothing is"
    assert found["identity"] == (scene.frames == 1)
    if found["psnr_fg"] is None:
        assert case == "empty frames"
    else:
        assert found["psnr_fg"] > 18
        assert found["lost"] < 2


def test_each_case_has_a_floor_and_frames_enough():
    assert {"rig that moves", "rolling exposure", "motion blur", "leaves and comes back", "real room"} <= set(CASES)
    for name, case in CASES.items():
        assert case.frames >= (1 if name == "one frame" else 30), name
        assert bool(case.why) == (case.floor < 30), name
    assert CASES["300 frames"].frames == 300


def test_the_worst_frame_decides_as_well_as_the_mean():
    good = {"finite": True, "gaussians_most": 9, "gaussians_allowed": 10, "psnr_fg": 31.0, "psnr_fg_worst": 28.0}
    good |= {"kb_per_frame": 1.0, "kb_per_frame_alone": 9.0, "lost": 0.5, "lost_most": 2.0, "identity": False}
    case = CASES["static"]
    assert stress.verdict(good, case) == "holds"
    assert stress.verdict(good | {"identity": True}, case).startswith("holds, equal by identity")
    for bad, reason in (
        ({"finite": False}, "not finite"),
        ({"gaussians_most": 11}, "11 Gaussians"),
        ({"psnr_fg": 29.9}, "29.90 dB, at least 30"),
        ({"psnr_fg_worst": 26.9}, "26.90 dB in a frame"),
        ({"lost": 1.1}, "1.10 dB below every frame alone"),
        ({"lost_most": 2.6}, "2.60 dB below a frame alone"),
        ({"kb_per_frame": 2.0}, "22% of the bytes"),
    ):
        assert stress.verdict(good | bad, case).startswith("fails: "), reason
        assert reason in stress.verdict(good | bad, case)


def test_conditions_of_a_scene_are_seen():
    """Rolling exposure, an open shutter and a moving rig change pictures and poses."""
    small = {"train": 3, "test": 1, "size": 48, "frames": 30}
    blurred, moving, away = (
        replace(SCENES[name], **small).capture(name)
        for name in ("motion blur", "rig that moves", "leaves and comes back")
    )
    sharp = replace(SCENES["motion blur"], **small, shutter=0).capture("sharp")
    still = replace(SCENES["rolling exposure"], **small, shapes=SCENES["static"].shapes).capture("still")
    mean = [[still.view(c, t).rgb[still.view(c, t).alpha > 0].mean() for t in (0, 5, 10, 15)] for c in (0, 3)]
    assert max(mean[0]) > 1.1 * min(mean[0])
    assert max(mean[1]) < 1.001 * min(mean[1]), "test cameras are not exposed"
    edges = [np.square(np.diff(c.view(0, 4).alpha.astype(float), axis=1)).sum() for c in (blurred, sharp)]
    assert edges[0] < edges[1]
    assert (blurred.view(0, 4).alpha > 0).sum() > (sharp.view(0, 4).alpha > 0).sum()
    assert not (moving.camera(0, 0).viewmat == moving.camera(0, 9).viewmat).all()
    assert [away.view(3, t).alpha.any() for t in (0, 14, 29)] == [True, False, True]

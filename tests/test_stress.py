"""The shortest of the stress cases, at a fraction of their size: nothing crashes, diverges or explodes in count."""

from dataclasses import replace

import pytest

from bench.stress import compare
from bench.stress_scenes import SCENES, cut, walking
from gscodec.render import sensitivity

TINY = {"keyframe_steps": 100, "motion_steps": 20, "finetune_steps": 8, "gaussians_max": 300, "initial_points": 200}
SMALL = {"train": 5, "test": 1, "size": 48, "frames": 3}


def late(t: int) -> list:
    """Nothing in the first frame."""
    return [] if t == 0 else walking(t)


@pytest.mark.parametrize(
    ("case", "changes"),
    [
        ("one frame", {"frames": 1}),
        ("empty frames", {"shapes": late}),
        ("empty frames", {"shapes": lambda t: [], "frames": 2}),
        ("scene cut", {"shapes": lambda t: cut(t + 5)}),
        ("static", {}),
    ],
    ids=["one frame", "late", "all empty", "scene cut", "static"],
)
def test_stress(case, changes, monkeypatch):
    monkeypatch.setattr(sensitivity, "SIZE", 128)
    scene = replace(SCENES[case], **(SMALL | changes))
    found = compare(case, scene, **TINY)
    assert sum(found["groups"]) == scene.frames
    assert found["finite"]
    assert found["gaussians_most"] <= TINY["gaussians_max"]
    assert found["kb_per_frame"] > 0
    assert found["haze"] < 1, "nothing where nothing is"
    if found["psnr_fg"] is None:
        assert case == "empty frames"
    else:
        assert found["psnr_fg"] > 18
        assert found["lost"] < 2

"""`gscodec info` of a capture: recognised layout, measurements, defects, and the contact sheet."""

import json

import cv2
import numpy as np
import pytest
from drawn_wall import write_wall
from rig_layouts import dynamic3dgs
from test_cli import fails, run

from gscodec.capture.report import describe_capture
from gscodec.capture.sheet import BORDER, COLOURS, WIDTH, contact_sheet


def test_a_sound_capture_is_told_from_one_that_is_not(tmp_path):
    _, facts = describe_capture(write_wall(tmp_path, test=(3,)))
    assert (facts["layout"], facts["frames"], facts["moves"], facts["masks"]) == ("transforms", 1, False, None)
    assert [(c["name"], c["split"]) for c in facts["cameras"]][2:] == [("cam2", "train"), ("cam3", "test")]
    assert facts["cameras"][0]["angle"] == pytest.approx(2 * np.degrees(np.arctan(100 / 220)), abs=0.1)
    assert facts["epipolar_error"] < 0.3
    assert facts["matches"] > 100
    assert facts["colour_ratio"] < 1.02
    assert facts["missing"] == [
        "no masks: whole pictures are trained (gscodec masks makes some)",
        "no sparse points: training starts from matched features and a plane sweep",
        "3 training cameras: what lies between their views is hardly constrained",
    ]
    write_wall(tmp_path, tilts=(0.006, -0.006, 0.006, -0.006))
    _, facts = describe_capture(tmp_path)
    assert facts["epipolar_error"] > 0.75
    assert any("pixels off: training corrects the poses" in s for s in facts["missing"])
    assert "no test cameras: quality can only be measured on pictures that were trained on" in facts["missing"]


def test_the_camera_that_is_off_and_the_dark_one_are_named(tmp_path):
    write_wall(tmp_path, gains=(1, 0.75, 1, 1), tilts=(0, 0, 0, 0.008))
    _, facts = describe_capture(tmp_path)
    assert facts["colour_ratio"] == pytest.approx(1 / 0.75, rel=0.03)
    gains = np.array([c["gain"] for c in facts["cameras"]])
    np.testing.assert_allclose(gains[1] / gains[0], 0.75, atol=0.03)


def test_cameras_without_features_are_said(tmp_path):
    dynamic3dgs(tmp_path)
    _, facts = describe_capture(tmp_path)
    assert (facts["layout"], facts["masks"], facts["points"]) == ("dynamic3dgs", "files", 3)
    assert (facts["epipolar_error"], facts["colour_ratio"], facts["cameras"][0]["gain"]) == (None, None, None)
    assert any("too few to check the calibration" in s for s in facts["missing"])


def shows(sheet, colour):
    return (np.abs(sheet.astype(int) - colour).max(-1) <= 2).any()


def test_the_sheet_shows_pictures_masks_and_rig(tmp_path):
    capture, _ = describe_capture(write_wall(tmp_path, test=(0,), masks=True))
    sheet = contact_sheet(capture)
    assert sheet.shape[1] == WIDTH
    assert sheet.dtype == np.uint8
    for colour in (COLOURS["train"], COLOURS["test"], BORDER):
        assert shows(sheet, colour), colour
    plain = contact_sheet(describe_capture(write_wall(tmp_path / "plain"))[0])
    assert not shows(plain, COLOURS["test"])
    assert not shows(plain, BORDER)
    first = sheet[30:200, 10:300].astype(float).mean((0, 2))
    assert first[-100:].mean() > 1.5 * first[:100].mean(), "what the mask leaves out is dark"


def test_the_command_line_prints_and_draws(tmp_path):
    write_wall(tmp_path)
    done = run("info", tmp_path, "--sheet", tmp_path / "out.png")
    assert done.returncode == 0, done.stderr
    assert "transforms, 4 training and 0 test cameras, 1 frames" in done.stdout
    assert "! no masks" in done.stdout
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out.png")).shape[1], WIDTH)
    facts = json.loads(run("info", tmp_path / "transforms.json", "--json").stdout)
    assert len(facts["cameras"]) == 4
    fails(run("info", tmp_path, "--maps", tmp_path), "is a capture, expected a .gsv file; --sheet draws a capture")
    fails(run("info", tmp_path / "a.gsv", "--sheet", "x.png"), "is not a capture, expected its folder")
    fails(run("info", tmp_path / "images"), "neither a capture nor splats; looked for transforms.json")
    fails(run("info", tmp_path, "--frame", "7"), "no frame 7, there are 1")

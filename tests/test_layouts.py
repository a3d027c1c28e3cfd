"""One rig, static or moving, written in each layout that has a reader: cameras, pictures and points read back are the
same, and known points project to their blobs in the pictures."""

import numpy as np
import pytest
import rig_layouts
from rig_layouts import DOTS, FOCAL, FRAMES, LATER, LAYOUTS, MOVING, NAMES, SHADES, VIEWS, dots
from test_capture import H, W, pixels

from gscodec.capture import find_capture, open_capture

TEST = {"n3dv": [0], "dynamic3dgs": [1]}  # cameras for testing
WITHOUT_POINTS = {"actorshq", "easyvolcap", "zju_mocap", "qualisys"}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_same_rig_comes_back(tmp_path, layout):
    name, write = LAYOUTS[layout]
    write(tmp_path)
    assert find_capture(tmp_path) == name
    capture = open_capture(tmp_path)
    numbers = [int(c.name[3:]) for c in capture.cameras]
    assert sorted(numbers) == [0, 2, 10]
    assert capture.frame_count == FRAMES
    video = name in ("n3dv", "qualisys")  # videos: twice the size, no alpha
    scale, apart = (2, 6) if video else (1, 0)
    assert capture.has_alpha != video
    assert capture.indices("test") == TEST.get(name, [])
    for i, camera in enumerate(capture.cameras):
        k = [0, 2, 10].index(numbers[i])
        view = VIEWS[k]
        np.testing.assert_allclose(camera.viewmat, view, atol=1e-6)
        expected = [[scale * FOCAL, 0, scale * W / 2], [0, scale * FOCAL, scale * H / 2], [0, 0, 1]]
        np.testing.assert_allclose(camera.K, expected, atol=1e-6)
        for t in range(FRAMES):
            seen, truth = capture.view(i, t), pixels(k, t)
            assert np.abs(seen.rgb[::scale, ::scale].astype(int) - truth[..., :3]).max() <= apart
            alpha = np.where(truth[..., 3] > 40, 255, 0) if name == "zju_mocap" else truth[..., 3]
            assert video or np.array_equal(seen.alpha, alpha)
    assert not capture.moves
    assert capture.camera(2, 1) is capture.cameras[2]
    assert (capture.points is None) == (layout in WITHOUT_POINTS)
    if capture.points is not None:
        np.testing.assert_allclose(capture.points.means, DOTS, atol=1e-6)
        np.testing.assert_array_equal(capture.points.colors, SHADES)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_known_points_are_where_the_pictures_show_them(tmp_path, layout, monkeypatch):
    monkeypatch.setattr(rig_layouts, "pixels", dots)
    LAYOUTS[layout][1](tmp_path)
    capture = open_capture(tmp_path)
    for i, camera in enumerate(capture.cameras):
        p = (DOTS @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        assert np.abs(p[:, :2] / p[:, 2:] - centroids(capture.view(i, 0).rgb)).max() < 0.5


@pytest.mark.parametrize(
    ("layouts", "layout", "named"),
    [
        (LAYOUTS, "easyvolcap", "intri.yml"),
        (MOVING, "easyvolcap", "cameras/cam10/extri.yml"),
        (LAYOUTS, "colmap, one folder", "colmap/sparse/0/cameras.txt"),
    ],
)
def test_one_of_several_calibration_files_stands_for_the_folder(tmp_path, layouts, layout, named):
    name, write = layouts[layout]
    write(tmp_path)
    assert find_capture(tmp_path / named) == name
    capture = open_capture(tmp_path / named)
    assert (capture.name, len(capture.cameras), capture.frame_count) == (tmp_path.name, len(NAMES), FRAMES)


@pytest.mark.parametrize("terms", [4, 5, 8])
def test_a_lens_of_easyvolcap_has_the_terms_of_opencv(tmp_path, terms):
    rig_layouts.easyvolcap(tmp_path)
    row = f"rows: {terms}\n   cols: 1\n   dt: d\n   data: [ {', '.join(['0.'] * terms)} ]"
    five = "rows: 5\n   cols: 1\n   dt: d\n   data: [ 0., 0., 0., 0., 0. ]"
    text = (tmp_path / "intri.yml").read_text()
    assert five in text
    (tmp_path / "intri.yml").write_text(text.replace(five, row))
    assert len(open_capture(tmp_path).cameras) == len(NAMES)


def centroids(rgb):
    """[3, 2] centroid of the blob in each channel, pixels."""
    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]] + 0.5
    blobs = np.where(rgb > 30, rgb, 0).astype(float)
    return np.stack([(blobs * v[..., None]).sum((0, 1)) / blobs.sum((0, 1)) for v in (x, y)], 1)


@pytest.mark.parametrize("layout", MOVING)
def test_a_moving_rig_comes_back(tmp_path, layout):
    name, write = MOVING[layout]
    write(tmp_path)
    assert find_capture(tmp_path) == name
    capture = open_capture(tmp_path)
    assert [c.name for c in capture.cameras] == list(NAMES)
    assert (capture.frame_count, capture.moves) == (FRAMES, True)
    for t, views in enumerate((VIEWS, LATER)):
        for k, view in enumerate(views):
            camera = capture.camera(k, t)
            np.testing.assert_allclose(camera.viewmat, view, atol=1e-6)
            assert (camera.name, camera.K[0, 0]) == (NAMES[k], FOCAL)
            np.testing.assert_array_equal(capture.view(k, t).rgb, pixels(k, t)[..., :3])

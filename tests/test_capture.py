"""Capture readers on tiny captures made here: values read, entries left out with a warning, and errors."""

import json
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from gscodec.capture import View, find_capture, open_capture
from gscodec.capture.undistort import Undistortion
from gscodec.errors import CaptureError, UsageError, require
from gscodec.model.camera import PIXEL_LOW_PASS, Camera, look_at

W, H = 24, 16
GL = np.diag([1.0, -1, -1, 1])


def write_image(path, pixels, dtype="uint8", unassociated=True):
    path.parent.mkdir(parents=True, exist_ok=True)
    h, w, c = pixels.shape
    spec = oiio.ImageSpec(w, h, c, dtype)
    if unassociated:
        spec.attribute("oiio:UnassociatedAlpha", 1)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(pixels)
    out.close()


def pixels(camera, frame, channels=4):
    p = np.full((H, W, channels), 10 * camera + frame, np.uint8)
    p[..., 1] = 200
    if channels == 4:
        p[..., 3] = np.where(np.arange(W) < W // 2, 255, 40)
    return p


def pose(k):
    view = look_at((3 * np.cos(k), 3 * np.sin(k), 1), (0, 0, 0), (0, 0, 1))
    return np.linalg.inv(view) @ GL


@pytest.fixture
def rig(tmp_path):
    """A capture of 3 cameras x 2 frames; returns (folder, its data, a function that writes the data)."""
    data = {"w": W, "h": H, "fl_x": 30.0, "cx": 12.0, "cy": 8.0, "fps": 25, "frames": []}
    for k in range(3):
        for t in range(2):
            name = f"images/cam{k}/{t:03}.png"
            write_image(tmp_path / name, pixels(k, t))
            item = {"file_path": name, "camera": f"cam{k}", "frame": t, "split": "test" if k == 2 else "train"}
            data["frames"].append(item | {"transform_matrix": pose(k).tolist()})

    def save(path="transforms.json"):
        (tmp_path / path).write_text(json.dumps(data))
        return open_capture(tmp_path)

    return tmp_path, data, save


def test_reads_cameras_frames_and_alpha(rig):
    _, _, save = rig
    capture = save()
    assert (capture.fps, capture.frame_count, capture.has_alpha) == (25, 2, True)
    assert [c.name for c in capture.cameras] == ["cam0", "cam1", "cam2"]
    assert (capture.indices("train"), capture.indices("test")) == ([0, 1], [2])
    view = capture.view(1, 1)
    np.testing.assert_array_equal(np.dstack([view.rgb, view.alpha]), pixels(1, 1))


@pytest.mark.parametrize("masked", [[], [1]])
def test_an_alpha_channel_without_masks_says_nothing(rig, masked):
    """Many tools write an opaque alpha channel: as a mask it would make the whole picture the subject."""
    folder, _, save = rig
    for k in {0, 1, 2} - {*masked}:
        opaque = pixels(k, 0)
        opaque[..., 3] = 255
        write_image(folder / f"images/cam{k}/000.png", opaque)
    capture = save()
    assert capture.has_alpha == bool(masked)
    assert (capture.view(1, 1).alpha is not None) == bool(masked)
    write_image(folder / "images/cam0/000.png", pixels(0, 0, channels=3))
    assert save().has_alpha == bool(masked), "no alpha channel is an opaque one"


def test_pose_becomes_opencv_world_to_camera(rig):
    camera = rig[2]().cameras[1]
    expected = look_at((3 * np.cos(1), 3 * np.sin(1), 1), (0, 0, 0), (0, 0, 1))
    np.testing.assert_allclose(camera.viewmat, expected, atol=1e-9)
    assert (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2]) == (30, 30, 12)


def test_near_plane_is_the_files_or_a_share_of_the_distance(rig):
    _, data, save = rig
    assert [c.near for c in save().cameras] == pytest.approx([0.2 * 10**0.5] * 3), "all look at the origin"
    data["near"] = 0.5
    data["frames"][0]["near"] = 0.25
    data["frames"][2]["near"] = 0.01
    assert sorted({c.near for c in save().cameras}) == pytest.approx([0.01, 0.25, 0.5])
    assert {c.low_pass for c in save().cameras} == {PIXEL_LOW_PASS}


def test_a_world_of_map_coordinates_is_moved(rig):
    """Map coordinates in single precision have steps of half a metre."""
    _, data, save = rig
    usual = save()
    for f in data["frames"]:
        for row, shift in zip(f["transform_matrix"], (500_000, 5_000_000, 100, 0), strict=True):
            row[3] += shift
    with pytest.warns(UserWarning, match=r"\(500000.0, 5000000.0, 100.0\) is the origin"):
        moved = save()
    for a, b in zip(usual.cameras, moved.cameras, strict=True):
        np.testing.assert_allclose(a.viewmat, b.viewmat, atol=1e-8)
        assert a.near == pytest.approx(b.near)


def test_frame_range_and_scale(rig):
    capture = rig[2]().frames(1, None).scaled(0.5)
    assert capture.frame_count == 1
    assert (capture.cameras[0].width, capture.cameras[0].K[0, 0]) == (12, 15)
    view = capture.view(2, 0)
    assert view.rgb.shape == (8, 12, 3)
    assert view.rgb[0, 0, 0] == 21
    with pytest.raises(UsageError, match=r"frames 5:9 is empty, the capture has 1 frames"):
        capture.frames(5, 9)
    with pytest.raises(UsageError, match="scale 2 is outside"):
        capture.scaled(2)
    with pytest.raises(UsageError, match="no camera 3, there are 3"):
        capture.view(3, 0)
    with pytest.raises(UsageError, match="no frame 1, there are 1"):
        capture.view(0, 1)


def test_time_instead_of_frame_and_names_without_suffix(rig):
    _, data, save = rig
    for f in data["frames"]:
        f["time"] = f.pop("frame") / 60
        f["file_path"] = f["file_path"].removesuffix(".png")
    capture = save()
    assert capture.frame_count == 2
    assert capture.view(0, 1).rgb[0, 0, 0] == 1


def test_fps_from_frame_and_time(rig):
    _, data, save = rig
    del data["fps"]
    for f in data["frames"]:
        f["time"] = f["frame"] / 60
    assert save().fps == pytest.approx(60)


def test_cameras_told_apart_by_pose(rig):
    _, data, save = rig
    for f in data["frames"]:
        del f["camera"]
    assert (len(save().cameras), save().frame_count) == (3, 2)


def test_static_capture_of_two_files_is_one_frame(rig):
    path, data, save = rig
    for f in data["frames"]:
        for key in ("camera", "frame", "split"):
            f.pop(key, None)
    everything = [f for f in data["frames"] if f["file_path"].endswith("000.png")]
    (path / "transforms_test.json").write_text(json.dumps({"fl_x": 30.0, "frames": everything[2:]}))
    data["frames"] = everything[:2]
    capture = save("transforms_train.json")
    assert (capture.frame_count, len(capture.cameras), capture.indices("test")) == (1, 3, [2])
    assert capture.fps == 25, "only the first file states it"
    assert open_capture(path / "transforms_train.json").indices("test") == [2]


def test_nerfstudio_split_lists(rig):
    _, data, save = rig
    for f in data["frames"]:
        del f["split"]
    data["test_filenames"] = [f["file_path"] for f in data["frames"] if f["camera"] == "cam0"]
    assert save().indices("test") == [0]


def test_null_says_that_there_is_none(rig):
    _, data, save = rig
    data["test_filenames"] = data["frames"][0]["mask_path"] = None
    assert len(save().cameras) == 3


def test_a_frame_of_another_size_is_named(rig):
    path, data, save = rig
    write_image(path / "images/cam1/001.png", np.zeros((32, 48, 4), np.uint8))
    data["frames"][3] |= {"w": 48, "h": 32}
    message = "cam1 is left out: frame 1: image .*001.png is 48x32, expected 24x16 as the first image of its camera"
    with pytest.warns(UserWarning, match=message):
        save()


def test_images_that_have_no_frame_of_their_own_are_named(rig):
    _, data, save = rig
    for f in data["frames"]:
        del f["frame"]
    with pytest.warns(UserWarning, match="camera cam1: 1 of 2 images are left out: they have the frame or time of"):
        assert save().frame_count == 1


def test_focal_length_from_angle_and_per_frame(rig):
    _, data, save = rig
    del data["fl_x"]
    for f in data["frames"]:
        f["camera_angle_x"] = 2 * np.arctan(0.5)
    assert save().cameras[0].K[0, 0] == pytest.approx(W)


@pytest.mark.parametrize("folder", ["images/", "images_2/", ""])
def test_masks_folder(rig, folder):
    path, data, save = rig
    for i, f in enumerate(data["frames"]):
        f["file_path"] = f["file_path"].replace("images/", folder)
        write_image(path / f["file_path"], pixels(0, 0, channels=3))
        write_image(path / "masks" / f["file_path"].removeprefix(folder), np.full((H, W, 1), 77 + i, np.uint8))
    capture = save()
    assert capture.has_alpha
    assert [int(capture.view(k, 0).alpha[0, 0]) for k in range(3)] == [77, 79, 81]
    assert len({m for feed in capture.footage for m in feed.mask_files}) == 6
    write_image(path / "masks/cam0/000.png", np.zeros((3, 5, 1), np.uint8))
    with pytest.raises(CaptureError, match=r"masks/cam0/000.png: mask is 5x3, its image 24x16"):
        capture.view(0, 0)


def break_pose(values):
    return lambda f: f.__setitem__("transform_matrix", values)


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda f: f.pop("transform_matrix"), "cam1 is left out: frame 0: no pose, expected transform_matrix"),
        (break_pose(np.zeros((4, 4)).tolist()), "frame 0: transform_matrix is singular"),
        (break_pose(np.diag([1, 1, -1, 1]).tolist()), "singular, sheared or mirrored"),
        (break_pose([[1, 2], [3]]), "transform_matrix is not 4x4 finite numbers"),
        (lambda f: f.__setitem__("frame", 7), "frame 0 is missing"),
        (lambda f: f.__setitem__("file_path", "images/none.png"), r"frame 0: image .*none.png is missing"),
        (lambda f: f.__setitem__("mask_path", "none.png"), r"frame 0: mask .*none.png is missing"),
        (lambda f: f.__setitem__("w", 99), r"frame 0: image .*000.png is 24x16, expected 99x16"),
        (lambda f: f.__setitem__("fl_x", -1), "frame 0: focal length -1 x -1 is not positive"),
        (lambda f: f.__setitem__("cx", "left"), "frame 0: not a number"),
    ],
)
def test_a_broken_camera_is_left_out(rig, harm, message):
    _, data, save = rig
    harm(data["frames"][2])
    with pytest.warns(UserWarning, match=message):
        capture = save()
    assert [c.name for c in capture.cameras] == ["cam0", "cam2"]


def test_a_camera_may_move(rig):
    """Each frame has its own pose and intrinsics, also in a part of the capture and after scaling."""
    _, data, save = rig
    assert not save().moves
    data["frames"][3] |= {"transform_matrix": pose(9).tolist(), "fl_x": 40.0}
    capture = save()
    assert (len(capture.cameras), capture.moves) == (3, True)
    there = np.linalg.inv(pose(9) @ GL)
    np.testing.assert_allclose(capture.camera(1, 0).viewmat, np.linalg.inv(pose(1) @ GL), atol=1e-9)
    np.testing.assert_allclose(capture.camera(1, 1).viewmat, there, atol=1e-9)
    assert (capture.camera(1, 0).K[0, 0], capture.camera(1, 1).K[0, 0]) == (30, 40)
    np.testing.assert_array_equal(capture.camera(2, 0).viewmat, capture.camera(2, 1).viewmat)
    last = capture.scaled(0.5).frames(1)
    assert not last.moves, "it has one frame"
    for camera in (last.camera(1, 0), last.cameras[1]):
        np.testing.assert_allclose(camera.viewmat, there, atol=1e-9)
        assert (camera.name, camera.width, camera.K[0, 0]) == ("cam1", 12, 20)
    assert last.camera(2, 0).split == "test"
    with pytest.raises(UsageError, match="no frame 2, there are 2"):
        capture.camera(0, 2)
    with pytest.raises(UsageError, match="no camera 3, there are 3"):
        capture.camera(3, 0)


def test_rounding_errors_are_no_motion(rig):
    _, data, save = rig
    for f in data["frames"][1::2]:
        f["transform_matrix"] = (np.array(f["transform_matrix"]) * (1 + 1e-7)).tolist()
        f["fl_x"] = 30.00001
    capture = save()
    assert not capture.moves
    assert capture.poses is None
    assert capture.camera(0, 1) is capture.cameras[0]


def test_a_moving_camera_without_a_name(rig):
    """Entries of one folder, each with its own time, are one camera."""
    _, data, save = rig
    for i, f in enumerate(data["frames"]):
        del f["camera"]
        f["transform_matrix"] = pose(i).tolist()
    capture = save()
    assert [c.name for c in capture.cameras] == ["images_cam0", "images_cam1", "images_cam2"]
    assert (capture.frame_count, capture.moves) == (2, True)
    np.testing.assert_allclose(capture.camera(1, 1).viewmat, np.linalg.inv(pose(3) @ GL), atol=1e-9)


def test_test_images_of_the_training_camera_are_named(rig):
    _, data, save = rig
    for i, f in enumerate(data["frames"]):
        f |= {"camera": "one", "frame": i, "split": "test" if i == 3 else "train"}
    with pytest.warns(UserWarning, match=r"camera one: 1 of 6 images are left out, the first one is 001.png: a"):
        assert save().frame_count == 5


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda f: f.pop("transform_matrix"), "cam1 is left out: frame 1: no pose, expected transform_matrix"),
        (lambda f: f.__setitem__("fl_x", 0), "cam1 is left out: frame 1: focal length 0 x 0 is not positive"),
        (lambda f: f.__setitem__("h", 17), r"cam1 is left out: frame 1: image .*001.png is 24x16, expected 24x17"),
    ],
)
def test_a_broken_frame_of_a_camera_is_named(rig, harm, message):
    _, data, save = rig
    harm(data["frames"][3])
    with pytest.warns(UserWarning, match=message):
        assert [c.name for c in save().cameras] == ["cam0", "cam2"]


def test_a_lens_may_change_between_frames(rig):
    """Each frame is undistorted with its own lens."""
    _, data, save = rig
    data["frames"][0] |= {"k1": -0.3, "cx": 4.0}
    data["frames"][1] |= {"k1": -0.3, "cx": 4.0, "fl_x": 15.0}
    capture = save()
    for t, focal in enumerate((30.0, 15.0)):
        K = np.array([[focal, 0, 4], [0, focal, 8], [0, 0, 1]])
        camera = Camera("cam0", K, np.eye(4), W, H, np.array([-0.3, 0, 0, 0, 0]))
        lens, seen = Undistortion(), pixels(0, t)
        expected = lens.view(View(np.ascontiguousarray(seen[..., :3]), np.ascontiguousarray(seen[..., 3])), camera)
        np.testing.assert_allclose(capture.camera(0, t).K, lens.camera(camera).K, atol=1e-9)
        np.testing.assert_array_equal(capture.view(0, t).alpha, expected.alpha)
    assert np.abs(capture.view(0, 0).alpha.astype(int) - capture.view(0, 1).alpha).max() > 0


def test_no_camera_left_is_an_error(rig):
    _, data, save = rig
    del data["fl_x"]
    with (
        pytest.raises(CaptureError, match="no camera can be used; the last one: frame 0: no focal length"),
        pytest.warns(),
    ):
        save()


def test_all_test_cameras_is_an_error(rig):
    _, data, save = rig
    for f in data["frames"]:
        f["split"] = "test"
    with pytest.raises(CaptureError, match="all 3 cameras are test cameras"):
        save()


def test_an_image_that_changes_size_is_named(rig):
    path, _, save = rig
    write_image(path / "images/cam1/001.png", np.zeros((4, 4, 4), np.uint8))
    with pytest.raises(CaptureError, match=r"001.png: camera cam1, frame 1 is 4x4, expected 24x16"):
        save().view(1, 1)


def test_damaged_and_missing_images(rig):
    path, _, save = rig
    capture = save()
    (path / "images/cam1/001.png").write_bytes(b"not an image")
    with pytest.raises(CaptureError, match=r"001.png: not a readable image"):
        capture.view(1, 1)
    whole = (path / "images/cam0/001.png").read_bytes()
    (path / "images/cam0/001.png").write_bytes(whole[:60])
    with pytest.raises(CaptureError, match=r"001.png: (damaged|not a readable) image"):
        capture.view(0, 1)
    (path / "images/cam0/000.png").unlink()
    with pytest.raises(CaptureError, match=r"000.png: image is missing"):
        capture.view(0, 0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ('{"frames": []}', "no 'frames'"),
        ('{"frames": [{}]}', r"frames\[0\] has no file_path"),
        ('{"frames": [{"file_path": null}]}', r"frames\[0\] has no file_path"),
        ('{"frames": [{"file_path": 3}]}', r"file_path of frames\[0\] is 3, expected the name of an image"),
        ('{"frames": [{"file_path": "a", "mask_path": 3}]}', r"mask_path of frames\[0\] is 3, expected the name"),
        ('{"test_filenames": 3, "frames": [{"file_path": "a"}]}', r"test_filenames is 3, expected a list of the names"),
        ('{"frames": [{"file_path": "a", "frame": "x"}]}', r"frame or time of frames\[0\] is not a number"),
        ('{"fps": "fast", "frames": [{"file_path": "a"}]}', r"fps, frame or time is not a number"),
        (
            '{"camera_model": "EQUIRECTANGULAR", "frames": [{}]}',
            "camera_model EQUIRECTANGULAR is not supported, expected OPENCV, .*OPENCV_FISHEYE; undistort it first",
        ),
        ('{"ply_file_path": 3, "frames": [{"file_path": "a"}]}', "ply_file_path is 3, expected the name of a .ply"),
        ('{"ply_file_path": "a.ply", "frames": [{"file_path": "a"}]}', "a.ply: no such file, expected a .ply"),
    ],
)
def test_bad_transforms_files(tmp_path, text, message):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_detector_says_what_it_looked_for(tmp_path):
    with pytest.raises(CaptureError, match=r"the folder is empty; looked for transforms.json .*, for images/ with"):
        open_capture(tmp_path)
    (tmp_path / "readme").touch()
    with pytest.raises(CaptureError, match="not a capture; looked for"):
        open_capture(tmp_path)
    with pytest.raises(CaptureError, match="no such file or folder"):
        open_capture(tmp_path / "gone")
    assert find_capture(tmp_path) is None


def test_missing_library_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(UsageError, match=r"reading videos needs cv2; install it with: pip install 'gscodec\[encode\]'"):
        require("cv2", "reading videos")


# -- undistortion


def test_undistortion_moves_pixels_where_opencv_projects_them():
    K = np.array([[80.0, 0, 48], [0, 80, 32], [0, 0, 1]])
    camera = Camera("a", K, np.eye(4), 96, 64, np.array([-0.2, 0.05, 0.01, -0.01]))
    lens = Undistortion()
    pinhole = lens.camera(camera)
    assert not pinhole.distortion.size
    point = np.array([[[0.15, -0.1, 1.0]]])
    zero = np.zeros(3)
    u, v = cv2.projectPoints(point, zero, zero, K, camera.distortion)[0].ravel()  # pixel centres are at half-integers
    y, x = np.mgrid[:64, :96] + 0.5
    image = np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8) * 255
    out = lens.view(View(np.dstack([image] * 3).astype(np.uint8)), camera).rgb[..., 0].astype(float)
    at = pinhole.K @ point[0, 0]
    assert (out * x).sum() / out.sum() == pytest.approx(at[0], abs=0.15)
    assert (out * y).sum() / out.sum() == pytest.approx(at[1], abs=0.15)


def test_nothing_warns_on_a_sound_capture(rig):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(rig[2]().cameras) == 3


# -- the bundled example


def test_bundled_example():
    capture = open_capture(Path(__file__).parent.parent / "examples" / "lumberjack")
    assert (capture.frame_count, capture.fps, capture.has_alpha) == (20, 30, True)
    assert (len(capture.indices("train")), len(capture.indices("test"))) == (12, 2)
    view = capture.view(13, 19)
    assert view.rgb.shape == (256, 256, 3)
    assert 0.15 < (view.alpha > 0).mean() < 0.35
    feet, head = (capture.cameras[0].viewmat @ (0, 0, z, 1) for z in (0, 1.8))
    assert feet[1] > head[1]  # z is up in the world, y is down in the image

"""Lenses of real rigs: known points, drawn through each lens by OpenCV, are at their projections by the pinhole
cameras of the capture. Fisheye lenses, several lenses in one model, and D-NeRF's single moving camera."""

import json
import struct

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_capture import GL, write_image

from gscodec.capture import blend, open_capture
from gscodec.capture.undistort import WIDEST, Undistortion
from gscodec.errors import CaptureError
from gscodec.model.camera import Camera, look_at

W, H = 160, 120
DOTS = np.array([(0.5, 0.1, 0.2), (-0.4, 0.3, -0.2), (0.1, -0.5, 0.1)])
VIEWS = [look_at((1.6 * np.cos(k), 1.6 * np.sin(k), 0.4), (0, 0, 0), (0, 0, 1)) for k in range(4)]
PINHOLE = (1, (110.0, 112.0, 78.0, 61.0), 0)
OPENCV = (4, (100.0, 102.0, 82.0, 58.0, -0.2, 0.05, 0.004, -0.003), 4)
FISHEYE = (5, (60.0, 61.0, 81.0, 59.0, 0.05, -0.02, 0.01, -0.003), 4)
EQUIDISTANT = (8, (62.0, 80.0, 60.0, 0.03), 1)
FULL = (6, (105.0, 104.0, 79.0, 60.0, 0.1, -0.05, 0.002, 0.001, 0.01, 0.3, -0.1, 0.02), 8)
LENSES = [OPENCV, FISHEYE, EQUIDISTANT, FULL]  # COLMAP's model id, parameters, number of distortion parameters


def pinhole_of(lens):
    _, params, terms = lens
    params = params[: len(params) - terms]
    fx, fy, cx, cy = (params[0], *params) if len(params) == 3 else params
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def drawn(view, lens):
    """A picture with a blob in each channel at the projection of one of DOTS by OpenCV."""
    number, params, terms = lens
    K, zero = pinhole_of(lens), np.zeros(3)
    x = (DOTS @ view[:3, :3].T + view[:3, 3])[:, None]
    distortion = np.array([*params[len(params) - terms :]], float)
    if number in (5, 8):
        p = cv2.fisheye.projectPoints(x, zero, zero, K, np.pad(distortion, (0, 4 - terms)))[0]
    else:
        p = cv2.projectPoints(x, zero, zero, K, distortion)[0]
    y, x = np.mgrid[:H, :W] + 0.5
    blobs = [np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8) for u, v in p.reshape(-1, 2)]
    return (255 * np.dstack(blobs)).astype(np.uint8)


def assert_dots_are_there(capture):
    for t in range(capture.frame_count):
        for i in range(len(capture.cameras)):
            camera, rgb = capture.camera(i, t), blend(capture.view(i, t), (0, 0, 0))  # alpha cuts the black background
            assert not camera.fisheye
            assert not camera.distortion.size
            p = (DOTS @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
            y, x = np.mgrid[:H, :W] + 0.5
            blobs = np.where(rgb > 30, rgb, 0).astype(float)
            seen = np.stack([(blobs * v[..., None]).sum((0, 1)) / blobs.sum((0, 1)) for v in (x, y)], 1)
            assert np.abs(p[:, :2] / p[:, 2:] - seen).max() < 0.5


def test_colmap_with_a_lens_for_each_camera(tmp_path):
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True)
    cameras, images = struct.pack("<Q", len(LENSES)), struct.pack("<Q", len(LENSES))
    for k, (lens, view) in enumerate(zip(LENSES, VIEWS, strict=True)):
        write_image(tmp_path / f"images/{k}.png", drawn(view, lens))
        cameras += struct.pack(f"<iiQQ{len(lens[1])}d", 7 + k, lens[0], W, H, *lens[1])
        quat = np.roll(Rotation.from_matrix(view[:3, :3]).as_quat(), 1)
        images += (
            struct.pack("<i7di", k, *quat, *view[:3, 3], 7 + k) + f"{k}.png".encode() + b"\0" + struct.pack("<Q", 0)
        )
    (model / "cameras.bin").write_bytes(cameras)
    (model / "images.bin").write_bytes(images)
    capture = open_capture(tmp_path)
    assert len(capture.cameras) == len(LENSES)
    assert_dots_are_there(capture)


def nerfstudio(root, lenses, **head):
    data = {"frames": [], **head}
    for k, (lens, view) in enumerate(zip(lenses, VIEWS, strict=False)):
        write_image(root / f"images/{k}.png", drawn(view, lens))
        K, terms = pinhole_of(lens), lens[1][len(lens[1]) - lens[2] :]
        keys = ("k1", "k2", "k3", "k4") if lens[0] == 5 else ("k1", "k2", "p1", "p2")
        own = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **dict(zip(keys, terms, strict=False))}
        if not head:
            own["camera_model"] = "OPENCV_FISHEYE" if lens[0] == 5 else "OPENCV"
        own |= {"file_path": f"images/{k}.png", "transform_matrix": (np.linalg.inv(view) @ GL).tolist()}
        data["frames"].append(own)
    (root / "transforms.json").write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("lenses", "head"),
    [
        ((OPENCV, PINHOLE, FISHEYE), {}),
        ((FISHEYE, FISHEYE), {"camera_model": "OPENCV_FISHEYE"}),
        ((FISHEYE, FISHEYE), {"is_fisheye": True}),
    ],
)
def test_nerfstudio_with_a_lens_for_each_image(tmp_path, lenses, head):
    nerfstudio(tmp_path, lenses, **head)
    assert_dots_are_there(open_capture(tmp_path))


def test_a_fisheye_lens_shows_as_much_as_its_image_has():
    K = pinhole_of(FISHEYE)
    camera = Camera("a", K, np.eye(4), W, H, np.array(FISHEYE[1][4:]), fisheye=True)
    pinhole = Undistortion().camera(camera)
    corners = np.array([(0, 0, 1), (W, 0, 1), (0, H, 1), (W, H, 1)]) @ np.linalg.inv(pinhole.K).T
    seen = cv2.fisheye.projectPoints(corners[:, None], np.zeros(3), np.zeros(3), K, camera.distortion)[0].reshape(-1, 2)
    assert ((seen >= -1e-6) & (seen <= [W + 1e-6, H + 1e-6])).all()
    angle = np.degrees(np.arccos(1 / np.linalg.norm(corners / corners[:, 2:], axis=1)))
    assert angle.max() < WIDEST + 1e-6
    assert angle.max() > WIDEST - 1  # the lens is wider than the widest pinhole view


def test_what_is_no_lens_is_refused(tmp_path):
    nerfstudio(tmp_path, ((5, (60.0, 61.0, 81.0, 59.0, -1e9, 0.0, 0.0, 0.0), 4),), camera_model="OPENCV_FISHEYE")
    with pytest.raises(CaptureError, match=r"fisheye distortion .* is not that of a lens, expected k1, k2, k3, k4"):
        open_capture(tmp_path)


def test_a_camera_that_has_no_lens_is_named(tmp_path):
    wrong = (5, (60.0, 61.0, 81.0, 59.0, -50.0, 0.0, 0.0, 0.0), 4)
    nerfstudio(tmp_path, (FISHEYE, wrong, FISHEYE), camera_model="OPENCV_FISHEYE")
    with pytest.warns(UserWarning, match=r"camera images_1 is left out: fisheye distortion .* is not that of a lens"):
        assert [c.name for c in open_capture(tmp_path).cameras] == ["images_0", "images_2"]


def d_nerf(root, file, times):
    frames = []
    for i, time in enumerate(times):
        view = VIEWS[i % len(VIEWS)]
        shown = np.dstack([drawn(view, (0, (110.0, W / 2, H / 2), 0)), np.full((H, W), 255 - i, np.uint8)])
        write_image(root / file / f"r_{i:03}.png", shown)
        pose = (np.linalg.inv(view) @ GL).tolist()
        frames.append({"file_path": f"./{file}/r_{i:03}", "rotation": 0.1, "time": time, "transform_matrix": pose})
    data = {"camera_angle_x": 2 * np.arctan(W / 220), "frames": frames}
    (root / f"transforms_{file}.json").write_text(json.dumps(data))


def test_d_nerf_has_one_view_a_time_step(tmp_path):
    d_nerf(tmp_path, "train", [0.0, 0.25, 0.5, 0.75, 1.0])
    d_nerf(tmp_path, "val", [0.0, 0.5, 1.0])
    d_nerf(tmp_path, "test", [1.0, 0.75, 0.5, 0.25, 0.0])
    capture = open_capture(tmp_path)
    assert (capture.frame_count, capture.moves, capture.has_alpha) == (5, True, True)
    assert [(c.name, c.split) for c in capture.cameras] == [("test", "test"), ("train", "train")]
    assert [capture.view(1, t).alpha[0, 0] for t in range(5)] == [255, 254, 253, 252, 251]
    assert [capture.view(0, t).alpha[0, 0] for t in range(5)] == [251, 252, 253, 254, 255]  # frames are ordered by time
    assert_dots_are_there(capture)


def test_d_nerf_test_views_of_other_times_are_left_out(tmp_path):
    d_nerf(tmp_path, "train", [0.0, 0.25, 0.5, 0.75, 1.0])
    d_nerf(tmp_path, "test", [0.0, 0.5, 1.0])
    with pytest.warns(UserWarning, match=r"camera test is left out: frame 0.25 is missing \(2 of 5 frames\)"):
        assert [c.name for c in open_capture(tmp_path).cameras] == ["train"]

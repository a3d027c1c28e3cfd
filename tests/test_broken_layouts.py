"""Damaged and incomplete captures: the error is named, and a camera that cannot be used is left out."""

import json
import shutil
import struct

import numpy as np
import pytest
from rig_layouts import (
    FOCAL,
    LATER,
    NAMES,
    VIEWS,
    H,
    W,
    actorshq,
    colmap_bin,
    dynamic3dgs,
    easyvolcap,
    frame_folders,
    moving_easyvolcap,
    moving_frame_folders,
    moving_one_model,
    n3dv,
    one_model,
    pixels,
    quat,
    transforms,
    write_image,
    zju_mocap,
)

from gscodec.capture import open_capture
from gscodec.errors import CaptureError
from gscodec.ply_table import write_table


def truncated(root):
    path = root / "frame9/sparse/0/images.bin"
    path.write_bytes(path.read_bytes()[:90])


def thin_prism(root):
    shutil.rmtree(root / "frame9/sparse/0")
    colmap_bin(root / "frame9/sparse/0", number=10)


def one_row_less(root):
    np.save(root / "poses_bounds.npy", np.load(root / "poses_bounds.npy")[1:])


def at_another_shape(root):
    path = root / "frame10/sparse/0/cameras.bin"
    path.write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 2 * W, H, FOCAL, FOCAL, W / 2, H / 2))


def without_its_lens(root):
    path = root / "frame10/sparse/0/cameras.bin"
    path.write_bytes(struct.pack("<QiiQQ4d", 1, 9, 1, W, H, FOCAL, FOCAL, W / 2, H / 2))


def without_rotation(root):
    path = root / "colmap/sparse/0/images.txt"
    path.write_text(path.read_text().replace(repr(quat(LATER[2])[0].item()), "nan"))


def without_a_translation(root):
    path = root / "cameras/cam10/extri.yml"
    path.write_text(path.read_text().replace("T_000001", "T_000007"))


def camera_short_of_a_frame(root):
    path = root / "train_meta.json"
    data = json.loads(path.read_text())
    for name in ("k", "w2c", "fn", "cam_id"):
        data[name][1] = data[name][1][:1]
    path.write_text(json.dumps(data))


def pose_of_text(root):
    path = root / "train_meta.json"
    data = json.loads(path.read_text())
    data["w2c"][1][0] = "x"
    path.write_text(json.dumps(data))


class _Evil:
    def __reduce__(self):
        return print, ("code of the file ran",)


def pickled(content):
    return lambda root: np.save(root / "annots.npy", content, allow_pickle=True)


def annotations(key, value):
    def harm(root):
        data = np.load(root / "annots.npy", allow_pickle=True).item()
        data["cams"][key] = value
        pickled(data)(root)

    return harm


def damaged_points(root):
    path = root / "frame9/sparse/0/points3D.bin"
    path.write_bytes(path.read_bytes()[:60])


def points_without_end(root):
    (root / "frame9/sparse/0/points3D.bin").write_bytes(struct.pack("<Q", 1 << 60))


def without_z(root):
    rows = np.zeros(1, [("x", "<f4"), ("y", "<f4")])
    write_table(root / "sparse_pc.ply", {"vertex": rows})


def nothing_finite(root):
    rows = np.full(1, np.nan, [(n, "<f4") for n in "xyz"])
    write_table(root / "sparse_pc.ply", {"vertex": rows})


def cut_points(root):
    path = root / "init_pt_cld.npz"
    path.write_bytes(path.read_bytes()[:100])


def calibrated_by(text):
    """intri.yml where the matrix of cam10 is `text`."""

    def harm(root):
        before, matrix = (root / "intri.yml").read_text().split("K_cam10: ")
        (root / "intri.yml").write_text(f"{before}K_cam10: {text}\n{matrix[matrix.index('dist_cam10') :]}")

    return harm


def overwrite(name, text):
    return lambda root: (root / name).write_text(text)


@pytest.mark.filterwarnings("ignore:.*is left out")
@pytest.mark.parametrize(
    ("write", "harm", "message"),
    [
        (frame_folders, truncated, r"images.bin: damaged .*, expected a COLMAP model"),
        (frame_folders, thin_prism, r"camera model 10 is not supported, undistort to PINHOLE first"),
        (n3dv, one_row_less, r"poses_bounds.npy: 2 cameras, expected as many as there are videos: 3"),
        (n3dv, overwrite("poses_bounds.npy", "x"), r"poses_bounds.npy: not a numpy file"),
        (actorshq, overwrite("calibration.csv", "name,w\na,1\n"), r"expected a line for each camera with the columns"),
        (easyvolcap, overwrite("intri.yml", "%YAML:1.0\n---\n{"), r"intri.yml: not a calibration file of OpenCV"),
        (
            moving_frame_folders,
            at_another_shape,
            r"cam10.png is 24x16, expected 48x16 as the calibration of frame 1 says",
        ),
        (moving_frame_folders, without_its_lens, r"frame10/sparse/0 has no camera 1, which took image cam10.png"),
        (
            dynamic3dgs,
            overwrite("train_meta.json", "{"),
            r"train_meta.json: .*expected w, h and lists k, w2c",
        ),
        (dynamic3dgs, camera_short_of_a_frame, r"train_meta.json: camera cam00 has 1 of 2 frames, expected w, h"),
        (dynamic3dgs, overwrite("init_pt_cld.npz", "x"), r"init_pt_cld.npz: not a point cloud of Dynamic 3D Gaussians"),
        (dynamic3dgs, cut_points, r"init_pt_cld.npz: not a point cloud of Dynamic 3D Gaussians"),
        (
            zju_mocap,
            overwrite("annots.npy", "x"),
            r"annots.npy: .*, expected annots.npy of ZJU-MoCap: cams",
        ),
        (zju_mocap, pickled({"cams": _Evil()}), r"annots.npy: .*it names builtins.print, which no annotation needs"),
        (zju_mocap, pickled([1, 2]), r"annots.npy: .*expected annots.npy of ZJU-MoCap"),
        (
            zju_mocap,
            annotations("K", [np.eye(3)]),
            r"annots.npy: 2 frames, cameras by list: \[1, 3\]; expected",
        ),
        (frame_folders, damaged_points, r"points3D.bin: damaged .*, expected the points of a COLMAP model"),
        (frame_folders, points_without_end, r"points3D.bin: damaged .* do not fit into 8 bytes"),
        (one_model, overwrite("colmap/sparse/0/points3D.txt", "1 2 3\n"), r"points3D.txt: damaged \(a line has 2 of 6"),
        (transforms, without_z, r"sparse_pc.ply: no points, expected an element 'vertex' with x, y and z"),
        (transforms, nothing_finite, r"sparse_pc.ply: no points, expected sparse points of the scene; delete the file"),
    ],
)
def test_a_broken_calibration_is_named(tmp_path, write, harm, message):
    write(tmp_path)
    harm(tmp_path)
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("write", "harm", "message"),
    [
        (moving_one_model, without_rotation, r"sparse/0, image cam10/1.png: its pose is singular or not a rotation"),
        (
            moving_easyvolcap,
            without_a_translation,
            r"frame 000001: .*extri.yml: T_000001 is missing or wrong, expected 3",
        ),
        (easyvolcap, calibrated_by("3.0"), "intri.yml: K_cam10 is missing or wrong, expected 3 x 3 finite numbers"),
        (easyvolcap, calibrated_by("{ a: 1 }"), "intri.yml: K_cam10 is missing or wrong, expected 3 x 3"),
        (zju_mocap, annotations("D", [[], [], [1, 2]]), r"D has 2 values, expected 4, 5 or 8 finite ones"),
        (zju_mocap, annotations("R", [VIEWS[0][:3, :3], VIEWS[1][:3, :3], "x"]), r"K, D, R or T is not of numbers"),
    ],
)
def test_a_broken_frame_of_a_camera_is_named(tmp_path, write, harm, message):
    write(tmp_path)
    harm(tmp_path)
    with pytest.warns(UserWarning, match=f"camera cam10 is left out: .*{message}"):
        assert [c.name for c in open_capture(tmp_path).cameras] == ["cam0", "cam2"]


@pytest.mark.parametrize(
    ("write", "gone", "message"),
    [
        (frame_folders, "frame10/images/cam2.png", "cam2 is left out: image .* is missing"),
        (zju_mocap, "cam2/000001.png", "cam2 is left out: image .* is missing"),
        (one_model, "masks/cam2/1.png.png", "cam2 is left out: .*: 1 masks for 2 frames"),
        (actorshq, "masks/cam2/cam2_mask000001.png", "cam2 is left out: .*: 1 masks for 2 frames"),
        (easyvolcap, "images/cam2", "cam2 is left out: no video, looked for cam2"),
        (easyvolcap, "images/cam2/000000.png", "cam2 is left out: picture 0 is missing, though .*images/cam0 has it"),
        (actorshq, "rgbs/cam2/cam2_rgb000000.png", "cam2 is left out: picture 0 is missing, though .*rgbs/cam0 has it"),
        (moving_easyvolcap, "images/cam2/000001.png", r"cam2 is left out: .*: 1 frames, but poses of 2; expected one"),
    ],
)
def test_a_broken_camera_is_left_out(tmp_path, write, gone, message):
    write(tmp_path)
    path = tmp_path / gone
    path.rename(tmp_path / "gone")
    with pytest.warns(UserWarning, match=message):
        assert [c.name for c in open_capture(tmp_path).cameras] == ["cam0", "cam10"]


@pytest.mark.parametrize("first", [1, 7])
def test_masks_of_other_frames_are_no_masks_of_these(tmp_path, first):
    """Masks of the frames 0 to 3; images from `first` on."""
    easyvolcap(tmp_path)
    for name in NAMES:
        for t in (1, 0):
            (tmp_path / f"images/{name}/{t:06}.png").rename(tmp_path / f"images/{name}/{first + t:06}.png")
        for t in range(4):
            write_image(tmp_path / f"masks/{name}/{t}.png", np.full((H, W, 1), 50 + t, np.uint8))
    if first == 1:
        assert [int(open_capture(tmp_path).view(2, t).alpha[0, 0]) for t in range(2)] == [51, 52]
        return
    message = "no camera can be used; .*masks/cam10: 4 masks for 2 frames, expected the numbers of frames"
    with pytest.raises(CaptureError, match=message), pytest.warns():
        open_capture(tmp_path)


def test_notes_of_macos_are_no_pictures(tmp_path):
    easyvolcap(tmp_path)
    for name in NAMES:
        (tmp_path / f"images/{name}/._000000.png").write_bytes(b"\0\5\x16\7")
    capture = open_capture(tmp_path)
    assert (capture.frame_count, int(capture.view(2, 1).rgb[0, 0, 0])) == (2, 21)


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (
            lambda root: (root / "ims/2/000001.png").unlink(),
            "cam02 is left out: frame 1: image .* is missing",
        ),
        (pose_of_text, "cam10 is left out: frame 1: k and w2c are not numbers, expected 3 x 3 and 4 x 4"),
    ],
)
def test_a_broken_camera_of_dynamic3dgs_is_left_out(tmp_path, harm, message):
    dynamic3dgs(tmp_path)
    harm(tmp_path)
    with pytest.warns(UserWarning, match=message):
        assert len(open_capture(tmp_path).cameras) == 2


@pytest.mark.filterwarnings("ignore:.*is left out")
@pytest.mark.parametrize(
    ("write", "image"),
    [(moving_frame_folders, "frame11/images/{}.png"), (moving_one_model, "images/{}/2.png")],
)
def test_a_moving_camera_needs_every_pose(tmp_path, write, image):
    write(tmp_path)
    for name in NAMES:
        write_image(tmp_path / image.format(name), pixels(0, 2))
        write_image(tmp_path / f"masks/{name}/2.png.png", pixels(0, 2)[..., 3:])
    gone = f"frame 2: the camera moves, but no model has a pose of image .*{image.format('cam10')}"
    with pytest.raises(CaptureError, match=f"no camera can be used; the last one: {gone}"):
        open_capture(tmp_path)

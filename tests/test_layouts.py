"""One rig written in each layout that has a reader: the same cameras and pictures come back, also of a moving rig."""

import struct

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_capture import H, W, pixels, write_image

from gscodec.capture import find_capture, open_capture
from gscodec.errors import CaptureError
from gscodec.model.camera import look_at

NAMES = ("cam0", "cam2", "cam10")  # in the order of their numbers
FRAMES = 2
FOCAL = 30.0
VIEWS = [look_at((3 * np.cos(k), 3 * np.sin(k), 1), (0, 0, 0), (0, 0, 1)) for k in range(len(NAMES))]
LATER = [look_at((3 * np.cos(k + 0.1), 3 * np.sin(k + 0.1), 1.2), (0, 0, 0), (0, 0, 1)) for k in range(len(NAMES))]


def write_images(pattern, channels=4):
    for k, name in enumerate(NAMES):
        for t in range(FRAMES):
            write_image(pattern(name, t), pixels(k, t, channels))


def quat(view):
    return np.roll(Rotation.from_matrix(view[:3, :3]).as_quat(), 1)


def colmap_txt(folder, name=lambda n: f"{n}.png"):
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"# list\n1 SIMPLE_RADIAL {W} {H} {FOCAL} {W / 2} {H / 2} 0.0\n")
    lines = [f"{k} {' '.join(map(repr, [*quat(v).tolist(), *v[:3, 3].tolist()]))} 1" for k, v in enumerate(VIEWS)]
    images = [f"{line} {name(n)}\n1.0 2.0 -1" for line, n in zip(lines, NAMES, strict=True)]
    (folder / "images.txt").write_text("# list\n" + "\n".join(images) + "\n")


def colmap_bin(folder, number=1, views=VIEWS):
    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, number, W, H, FOCAL, FOCAL, W / 2, H / 2))
    out = struct.pack("<Q", len(NAMES))
    for k, (name, view) in enumerate(zip(NAMES, views, strict=True)):
        out += struct.pack("<i7di", k, *quat(view), *view[:3, 3], 1) + f"{name}.png".encode() + b"\0"
        out += struct.pack("<Q2dq", 1, 3.0, 4.0, -1)
    (folder / "images.bin").write_bytes(out)


def frame_folders(root):
    write_images(lambda name, t: root / f"frame{9 + t}/images/{name}.png")
    colmap_bin(root / "frame9/sparse/0")


def one_model(root):
    write_images(lambda name, t: root / f"images/{name}/{t}.png", channels=3)
    for k, name in enumerate(NAMES):
        for t in range(FRAMES):
            write_image(root / f"masks/{name}/{t}.png.png", pixels(k, t)[..., 3:])
    colmap_txt(root / "colmap/sparse/0", lambda n: f"{n}/0.png")


def moving_frame_folders(root):
    frame_folders(root)
    colmap_bin(root / "frame10/sparse/0", views=LATER)


def moving_one_model(root):
    one_model(root)
    path = root / "colmap/sparse/0/images.txt"
    poses = [[*quat(v).tolist(), *v[:3, 3].tolist()] for v in LATER]
    more = [
        f"{9 + k} {' '.join(map(repr, p))} 1 {n}/1.png\n" for k, (p, n) in enumerate(zip(poses, NAMES, strict=True))
    ]
    path.write_text(path.read_text() + "\n".join(more) + "\n")


def actorshq(root):
    write_images(lambda name, t: root / f"rgbs/{name}/{name}_rgb{t:06}.png", channels=3)
    for k, name in enumerate(NAMES):
        for t in range(FRAMES):
            write_image(root / f"masks/{name}/{name}_mask{t:06}.png", pixels(k, t)[..., 3:])
    lines = ["name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"]
    for name, view in zip(NAMES, VIEWS, strict=True):
        turn, place = cv2.Rodrigues(view[:3, :3].T)[0].ravel(), -view[:3, :3].T @ view[:3, 3]
        lines.append(",".join(map(str, [name, W, H, *turn, *place, FOCAL / W, FOCAL / H, 0.5, 0.5])))
    (root / "calibration.csv").write_text("\n".join(lines))


def easyvolcap(root):
    write_images(lambda name, t: root / f"images/{name}/{t:06}.png")
    yaml_pair(root, dict(zip(NAMES, VIEWS, strict=True)))


def moving_easyvolcap(root):
    write_images(lambda name, t: root / f"images/{name}/{t:06}.png")
    for k, name in enumerate(NAMES):
        folder = root / "cameras" / name
        folder.mkdir(parents=True)
        yaml_pair(folder, {"000000": VIEWS[k], "000001": LATER[k]})


def yaml_pair(folder, views):
    """intri.yml and extri.yml with the viewmats `views`, by name."""
    K = np.array([[FOCAL, 0, W / 2 - 0.5], [0, FOCAL, H / 2 - 0.5], [0, 0, 1]])
    intrinsics, extrinsics = (cv2.FileStorage(str(folder / f), 1) for f in ("intri.yml", "extri.yml"))
    intrinsics.startWriteStruct("names", cv2.FileNode_SEQ)
    for name in views:
        intrinsics.write("", name)
    intrinsics.endWriteStruct()
    for name, view in views.items():
        intrinsics.write(f"K_{name}", K)
        intrinsics.write(f"dist_{name}", np.zeros((5, 1)))
        extrinsics.write(f"R_{name}", cv2.Rodrigues(view[:3, :3])[0])
        extrinsics.write(f"T_{name}", view[:3, 3:])
    intrinsics.release()
    extrinsics.release()


def n3dv(root):
    rows = []
    for k, (name, view) in enumerate(zip(NAMES, VIEWS, strict=True)):
        video = cv2.VideoWriter(str(root / f"{name}.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, (2 * W, 2 * H))
        for t in range(FRAMES):
            video.write(np.repeat(np.repeat(pixels(k, t, 3)[..., ::-1], 2, 0), 2, 1))
        video.release()
        R, place = view[:3, :3].T, -view[:3, :3].T @ view[:3, 3]
        m = np.stack([R[:, 1], R[:, 0], -R[:, 2], place, [4 * H, 4 * W, 4 * FOCAL]], 1)
        rows.append([*m.ravel(), 0.1, 10.0])
    np.save(root / "poses_bounds.npy", np.array(rows))


LAYOUTS = {
    "colmap, a folder each frame": ("colmap", frame_folders),
    "colmap, one folder": ("colmap", one_model),
    "actorshq": ("actorshq", actorshq),
    "easyvolcap": ("easyvolcap", easyvolcap),
    "n3dv": ("n3dv", n3dv),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_same_rig_comes_back(tmp_path, layout):
    name, write = LAYOUTS[layout]
    write(tmp_path)
    assert find_capture(tmp_path) == name
    capture = open_capture(tmp_path)
    assert [c.name for c in capture.cameras] == list(NAMES)
    assert capture.frame_count == FRAMES
    video = name == "n3dv"  # at twice the size, without alpha, the first camera for testing
    scale, apart = (2, 6) if video else (1, 0)
    assert capture.has_alpha != video
    assert [c.split for c in capture.cameras] == ["test" if video else "train", "train", "train"]
    for k, (camera, view) in enumerate(zip(capture.cameras, VIEWS, strict=True)):
        np.testing.assert_allclose(camera.viewmat, view, atol=1e-6)
        expected = [[scale * FOCAL, 0, scale * W / 2], [0, scale * FOCAL, scale * H / 2], [0, 0, 1]]
        np.testing.assert_allclose(camera.K, expected, atol=1e-6)
        for t in range(FRAMES):
            seen, truth = capture.view(k, t), pixels(k, t)
            assert np.abs(seen.rgb[::scale, ::scale].astype(int) - truth[..., :3]).max() <= apart
            assert video or np.array_equal(seen.alpha, truth[..., 3])
    assert not capture.moves
    assert capture.camera(2, 1) is capture.cameras[2]


MOVING = {
    "colmap, a folder each frame": ("colmap", moving_frame_folders),
    "colmap, one folder": ("colmap", moving_one_model),
    "easyvolcap": ("easyvolcap", moving_easyvolcap),
}


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


def truncated(root):
    path = root / "frame9/sparse/0/images.bin"
    path.write_bytes(path.read_bytes()[:90])


def thin_prism(root):
    (root / "frame9/sparse/0/cameras.bin").unlink()
    (root / "frame9/sparse/0/images.bin").unlink()
    (root / "frame9/sparse/0").rmdir()
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
        (one_model, "masks/cam2/1.png.png", "cam2 is left out: .*: 1 masks for 2 frames"),
        (actorshq, "masks/cam2/cam2_mask000001.png", "cam2 is left out: .*: 1 masks for 2 frames"),
        (easyvolcap, "images/cam2", "cam2 is left out: no video, looked for cam2"),
        (moving_easyvolcap, "images/cam2/000001.png", r"cam2 is left out: .*: 1 frames, but poses of 2; expected one"),
    ],
)
def test_a_broken_camera_is_left_out(tmp_path, write, gone, message):
    write(tmp_path)
    path = tmp_path / gone
    path.rename(tmp_path / "gone")
    with pytest.warns(UserWarning, match=message):
        assert [c.name for c in open_capture(tmp_path).cameras] == ["cam0", "cam10"]


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

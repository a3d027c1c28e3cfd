"""One rig written in each layout that has a reader: the same cameras, pictures and points come back, also of a moving
rig, and known points are where the pictures show them."""

import json
import shutil
import struct
import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_capture import GL, H, W, pixels, write_image

from gscodec.capture import find_capture, open_capture
from gscodec.errors import CaptureError
from gscodec.model.camera import look_at
from gscodec.ply_table import write_table

NAMES = ("cam0", "cam2", "cam10")  # in the order of their numbers
FRAMES = 2
FOCAL = 30.0
VIEWS = [look_at((3 * np.cos(k), 3 * np.sin(k), 1), (0, 0, 0), (0, 0, 1)) for k in range(len(NAMES))]
LATER = [look_at((3 * np.cos(k + 0.1), 3 * np.sin(k + 0.1), 1.2), (0, 0, 0), (0, 0, 1)) for k in range(len(NAMES))]
DOTS = np.array([(0.5, 0.1, 0.2), (-0.3, 0.3, -0.2), (0.1, -0.5, 0.0)])  # seen by all cameras
SHADES = np.array([(255, 0, 0), (10, 20, 30), (0, 0, 255)], np.uint8)


def dots(camera, frame, channels=4):
    """A picture with a blob in each channel, where the rig has one of DOTS."""
    x = DOTS @ VIEWS[camera][:3, :3].T + VIEWS[camera][:3, 3]
    p = FOCAL * x[:, :2] / x[:, 2:] + [W / 2, H / 2]
    y, x = np.mgrid[:H, :W] + 0.5
    blobs = [np.exp(-((x - u) ** 2 + (y - v) ** 2) / 4) for u, v in p]
    return np.dstack([255 * np.dstack(blobs), np.full((H, W), 255)])[..., :channels].astype(np.uint8)


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


def colmap_points(folder):
    """points3D.bin, each point seen by two images."""
    out = struct.pack("<Q", len(DOTS))
    for i, (x, rgb) in enumerate(zip(DOTS, SHADES, strict=True)):
        out += struct.pack("<Q3d3BdQ4i", i, *x, *rgb, 0.5, 2, 0, 7, 1, 8)
    (folder / "points3D.bin").write_bytes(out)


def ply_points(path):
    rows = np.zeros(len(DOTS), [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for i, n in enumerate(rows.dtype.names):
        rows[n] = (DOTS if i < 3 else SHADES)[:, i % 3]
    write_table(path, {"vertex": rows})


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
    colmap_points(root / "frame9/sparse/0")


def one_model(root):
    write_images(lambda name, t: root / f"images/{name}/{t}.png", channels=3)
    for k, name in enumerate(NAMES):
        for t in range(FRAMES):
            write_image(root / f"masks/{name}/{t}.png.png", pixels(k, t)[..., 3:])
    colmap_txt(root / "colmap/sparse/0", lambda n: f"{n}/0.png")
    rows = [[i, *DOTS[i], *SHADES[i], 0.5, 1, 2] for i in range(len(DOTS))]
    lines = [" ".join(map(str, row)) + "\n" for row in rows]
    (root / "colmap/sparse/0/points3D.txt").write_text("# list\n" + "".join(lines))


def transforms(root):
    """Each entry with intrinsics of its own."""
    write_images(lambda name, t: root / f"images/{name}/{t}.png")
    data = {"ply_file_path": "sparse_pc.ply", "fps": 30, "frames": []}
    for name, view in zip(NAMES, VIEWS, strict=True):
        pose = (np.linalg.inv(view) @ GL).tolist()
        own = {"camera": name, "fl_x": FOCAL, "w": W, "h": H, "cx": W / 2, "cy": H / 2, "transform_matrix": pose}
        data["frames"] += [own | {"file_path": f"images/{name}/{t}.png", "frame": t} for t in range(FRAMES)]
    (root / "transforms.json").write_text(json.dumps(data))
    ply_points(root / "sparse_pc.ply")


def dynamic3dgs(root):
    write_images(lambda name, t: root / f"ims/{int(name[3:])}/{t:06}.png", channels=3)
    for k, name in enumerate(NAMES):
        for t in range(FRAMES):
            write_image(root / f"masks/{int(name[3:])}/{t:06}.png", pixels(k, t)[..., 3:])
    K = [[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1]]
    for file, chosen in (("train_meta.json", [2, 0]), ("test_meta.json", [1])):
        numbers = [int(NAMES[k][3:]) for k in chosen]
        data = {"w": W, "h": H, "k": [[K] * len(chosen)] * FRAMES, "cam_id": [numbers] * FRAMES}
        data["w2c"] = [[VIEWS[k].tolist() for k in chosen]] * FRAMES
        data["fn"] = [[f"{n}/{t:06}.png" for n in numbers] for t in range(FRAMES)]
        (root / file).write_text(json.dumps(data))
    np.savez(root / "init_pt_cld.npz", data=np.hstack([DOTS, SHADES / 255, np.ones((len(DOTS), 1))]))


def zju_mocap(root):
    write_images(lambda name, t: root / f"{name}/{t:06}.png", channels=3)
    for k, name in enumerate(NAMES):
        for t in range(FRAMES):  # labels: not 0 is the subject
            write_image(root / f"mask_cihp/{name}/{t:06}.png", (pixels(k, t)[..., 3:] > 40).astype(np.uint8) * 5)
    K = np.array([[FOCAL, 0, W / 2 - 0.5], [0, FOCAL, H / 2 - 0.5], [0, 0, 1]])
    cams = {"K": [K] * 3, "D": [np.zeros((5, 1))] * 3, "R": [v[:3, :3] for v in VIEWS]}
    cams["T"] = [1000 * v[:3, 3:] for v in VIEWS]
    ims = [{"ims": [f"{n}/{t:06}.png" for n in NAMES]} for t in range(FRAMES)]
    np.save(root / "annots.npy", {"cams": cams, "ims": ims}, allow_pickle=True)


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
    ply_points(root / "points3D_downsample2.ply")


LAYOUTS = {
    "colmap, a folder each frame": ("colmap", frame_folders),
    "colmap, one folder": ("colmap", one_model),
    "actorshq": ("actorshq", actorshq),
    "easyvolcap": ("easyvolcap", easyvolcap),
    "n3dv": ("n3dv", n3dv),
    "transforms": ("transforms", transforms),
    "dynamic3dgs": ("dynamic3dgs", dynamic3dgs),
    "zju_mocap": ("zju_mocap", zju_mocap),
}
TEST = {"n3dv": [0], "dynamic3dgs": [1]}  # cameras for testing
WITHOUT_POINTS = {"actorshq", "easyvolcap", "zju_mocap"}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_same_rig_comes_back(tmp_path, layout):
    name, write = LAYOUTS[layout]
    write(tmp_path)
    assert find_capture(tmp_path) == name
    capture = open_capture(tmp_path)
    numbers = [int(c.name[3:]) for c in capture.cameras]
    assert sorted(numbers) == [0, 2, 10]
    assert capture.frame_count == FRAMES
    video = name == "n3dv"  # at twice the size, without alpha, the first camera for testing
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
    monkeypatch.setattr(sys.modules[__name__], "pixels", dots)
    LAYOUTS[layout][1](tmp_path)
    capture = open_capture(tmp_path)
    for i, camera in enumerate(capture.cameras):
        p = (DOTS @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        assert np.abs(p[:, :2] / p[:, 2:] - centroids(capture.view(i, 0).rgb)).max() < 0.5


def centroids(rgb):
    """[3, 2] middle of what each channel shows, pixels."""
    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]] + 0.5
    blobs = np.where(rgb > 30, rgb, 0).astype(float)
    return np.stack([(blobs * v[..., None]).sum((0, 1)) / blobs.sum((0, 1)) for v in (x, y)], 1)


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
        (moving_easyvolcap, "images/cam2/000001.png", r"cam2 is left out: .*: 1 frames, but poses of 2; expected one"),
    ],
)
def test_a_broken_camera_is_left_out(tmp_path, write, gone, message):
    write(tmp_path)
    path = tmp_path / gone
    path.rename(tmp_path / "gone")
    with pytest.warns(UserWarning, match=message):
        assert [c.name for c in open_capture(tmp_path).cameras] == ["cam0", "cam10"]


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

"""One rig, static or moving, written in each layout that has a reader."""

import json
import struct

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from test_capture import GL, H, W, pixels, write_image

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
    """A picture with a blob in each channel, at the projection of one of DOTS."""
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
    """transforms.json; each entry has intrinsics of its own."""
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
        for t in range(FRAMES):  # labels: values other than 0 are the subject
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


def write_videos(path):
    """A video for each camera, at twice the size, at `path(name)`."""
    for k, name in enumerate(NAMES):
        path(name).parent.mkdir(exist_ok=True)
        video = cv2.VideoWriter(str(path(name)), cv2.VideoWriter_fourcc(*"mp4v"), 30, (2 * W, 2 * H))
        for t in range(FRAMES):
            video.write(np.repeat(np.repeat(pixels(k, t, 3)[..., ::-1], 2, 0), 2, 1))
        video.release()


def n3dv(root):
    write_videos(lambda name: root / f"{name}.mp4")
    rows = []
    for view in VIEWS:
        R, place = view[:3, :3].T, -view[:3, :3].T @ view[:3, 3]
        m = np.stack([R[:, 1], R[:, 0], -R[:, 2], place, [4 * H, 4 * W, 4 * FOCAL]], 1)
        rows.append([*m.ravel(), 0.1, 10.0])
    np.save(root / "poses_bounds.npy", np.array(rows))
    ply_points(root / "points3D_downsample2.ply")


def qualisys(root):
    """Videos at twice the calibrated size, and a calibration in mm and 1/64 pixel."""
    write_videos(lambda name: root / f"videos/{name}.mp4")
    numbers = lambda keys, values: " ".join(f'{k}="{v}"' for k, v in zip(keys, values, strict=True))  # noqa: E731
    elements = []
    for name, view in zip(NAMES, VIEWS, strict=True):
        place, turn = -1000 * view[:3, :3].T @ view[:3, 3], np.diag([1, -1, -1]) @ view[:3, :3]
        axes = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
        lens = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        elements.append(
            f'<camera serial="{name}"><fov_video left="0" top="0" right="{W - 1}" bottom="{H - 1}"/>'
            f"<transform {numbers(['x', 'y', 'z', *axes], [*place, *turn.ravel()])}/>"
            f"<intrinsic {numbers(lens, 64 * np.array([FOCAL, FOCAL, W / 2 - 0.5, H / 2 - 0.5]))}/></camera>"
        )
    (root / "calibration").mkdir()
    text = f"<calibration><cameras>{''.join(elements)}</cameras></calibration>"
    (root / "calibration" / "rig.qca.txt").write_text(text)


LAYOUTS = {
    "colmap, a folder each frame": ("colmap", frame_folders),
    "colmap, one folder": ("colmap", one_model),
    "actorshq": ("actorshq", actorshq),
    "easyvolcap": ("easyvolcap", easyvolcap),
    "n3dv": ("n3dv", n3dv),
    "transforms": ("transforms", transforms),
    "dynamic3dgs": ("dynamic3dgs", dynamic3dgs),
    "zju_mocap": ("zju_mocap", zju_mocap),
    "qualisys": ("qualisys", qualisys),
}
MOVING = {
    "colmap, a folder each frame": ("colmap", moving_frame_folders),
    "colmap, one folder": ("colmap", moving_one_model),
    "easyvolcap": ("easyvolcap", moving_easyvolcap),
}

"""A capture of a textured wall, drawn by homographies: features match, and the ground truth is known."""

import json

import cv2
import numpy as np
from test_capture import GL, write_image

from gscodec.model.camera import look_at

W, H, FOCAL = 200, 150, 220.0


def texture(side=600):
    """[side, side, 3] u8 with detail at several scales; it covers the square from -1.5 to 1.5 of the plane y = 0."""
    rng = np.random.default_rng(5)
    noise = [rng.uniform(60, 190, (n, n, 3)) for n in (20, 60)]
    layers = [cv2.resize(n, (side, side), interpolation=cv2.INTER_CUBIC) for n in noise]
    return np.clip(np.mean(layers, 0), 0, 255).astype(np.uint8)


def wall_picture(view, gain=1.0):
    """[H, W, 3] u8, the wall from the pose `view`."""
    K = np.array([[FOCAL, 0, W / 2 - 0.5], [0, FOCAL, H / 2 - 0.5], [0, 0, 1]])
    plane = np.stack([view[:3, 0], view[:3, 2], view[:3, 3]], 1)  # axes x and z, and the origin
    to_plane = np.array([[3 / 600, 0, -1.5 + 1.5 / 600], [0, 3 / 600, -1.5 + 1.5 / 600], [0, 0, 1]])
    picture = cv2.warpPerspective(texture(), K @ plane @ to_plane, (W, H), flags=cv2.INTER_LINEAR)
    return np.clip(gain * picture, 0, 255).astype(np.uint8)


def write_wall(root, gains=(1, 1, 1, 1), tilts=(0, 0, 0, 0), test=(), masks=False):
    """Writes the capture as transforms.json; `tilts`: errors of the poses in the file, radians about x."""
    data = {"w": W, "h": H, "fl_x": FOCAL, "frames": []}
    for k, (gain, tilt) in enumerate(zip(gains, tilts, strict=True)):
        view = look_at((0.5 * k - 0.75, -2.5, 0.2 * (-1) ** k), (0, 0, 0), (0, 0, 1))
        write_image(root / f"images/cam{k}/0.png", wall_picture(view, gain))
        if masks:
            write_image(root / f"masks/cam{k}/0.png", np.uint8(255 * (np.mgrid[:H, :W][1] > W // 2))[..., None])
        wrong = np.eye(4)
        wrong[:3, :3] = cv2.Rodrigues(np.array([tilt, 0.0, 0.0]))[0]
        pose = (np.linalg.inv(wrong @ view) @ GL).tolist()
        split = "test" if k in test else "train"
        entry = {"file_path": f"images/cam{k}/0.png", "camera": f"cam{k}", "split": split, "transform_matrix": pose}
        data["frames"].append(entry | {"frame": 0})
    (root / "transforms.json").write_text(json.dumps(data))
    return root

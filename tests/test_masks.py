"""Generated masks, from a plate or from motion, against the drawn ground truth; their files; refused inputs."""

import json

import cv2
import numpy as np
import pytest
from rig_layouts import LAYOUTS, NAMES, easyvolcap, qualisys, zju_mocap
from rig_layouts import H as SMALL_H
from rig_layouts import W as SMALL_W
from test_capture import GL, write_image
from test_cli import fails, run

from gscodec.capture import open_capture
from gscodec.capture.masks import make_masks
from gscodec.errors import CaptureError, UsageError
from gscodec.model.camera import look_at

W, H, FRAMES = 160, 120, 7


def background(camera):
    rng = np.random.default_rng(camera)
    return cv2.resize(rng.uniform(70, 130, (30, 40, 3)), (W, H), interpolation=cv2.INTER_CUBIC).clip(0, 255)


def truth(t):
    """[H, W] bool: ground truth mask, a disc that crosses the picture."""
    y, x = np.mgrid[:H, :W]
    return (x - 35 - 14 * t) ** 2 + (y - 60) ** 2 < 22**2


def picture(camera, t, light=1.0, shadow=False, alike=False):
    seen = background(camera) * light
    if shadow:
        seen[95:110, 20:140] *= 0.7
    y, x = np.mgrid[:H, :W]
    disc = np.dstack([200 + 40 * np.sin((x - 14 * t) / 3), 40 + 30 * np.sin(y / 4), np.full((H, W), 30)]) * light
    disc = np.roll(background(camera + 7), 14 * t, 1) if alike else disc
    noise = np.random.default_rng(99 + t).normal(0, 1.5, (H, W, 3))
    return (np.where(truth(t)[..., None], disc, seen) + noise).clip(0, 255).astype(np.uint8)


def write_scene(root, light=lambda t: 1.0, frames=FRAMES, **options):
    data = {"w": W, "h": H, "fl_x": 150.0, "frames": []}
    for k in range(2):
        pose = (np.linalg.inv(look_at((k - 0.5, -3, 0), (0, 0, 0), (0, 0, 1))) @ GL).tolist()
        for t in range(frames):
            write_image(root / f"images/cam{k}/{t:03}.png", picture(k, t, light(t), **options))
            entry = {"file_path": f"images/cam{k}/{t:03}.png", "camera": f"cam{k}", "frame": t}
            data["frames"].append(entry | {"transform_matrix": pose})
    (root / "transforms.json").write_text(json.dumps(data))
    return root


def plates(root, name="plate"):
    for k in range(2):
        write_image(root / name / f"cam{k}.png", (1.1 * background(k)).astype(np.uint8))  # with another exposure
    return root / name


def overlaps(root):
    """Intersection over union of each mask and the truth."""
    capture, out = open_capture(root), []
    assert capture.has_alpha
    for k in range(2):
        for t in range(capture.frame_count):
            seen, true = capture.view(k, t).alpha > 127, truth(t)
            out.append((seen & true).sum() / (seen | true).sum())
    return np.array(out)


def test_a_plate_gives_the_subject_without_its_shadow(tmp_path):
    write_scene(tmp_path, shadow=True)
    assert make_masks(open_capture(tmp_path), plates(tmp_path)) == 2 * FRAMES
    assert overlaps(tmp_path).min() > 0.93
    assert not list(tmp_path.rglob("*.part"))


def test_what_moves_is_the_subject_and_light_is_not(tmp_path):
    write_scene(tmp_path, light=lambda t: 1 + 0.06 * t)
    make_masks(open_capture(tmp_path))
    assert overlaps(tmp_path).min() > 0.75
    assert overlaps(tmp_path).mean() > 0.85


@pytest.mark.filterwarnings("ignore:.*nothing is found")
def test_a_subject_of_the_colours_of_the_background_is_seen_where_other_frames_show_that(tmp_path):
    write_scene(tmp_path, alike=True, frames=20)  # the disc leaves the picture after ten
    make_masks(open_capture(tmp_path))
    capture = open_capture(tmp_path)
    seen = np.stack([capture.view(0, t).alpha > 127 for t in range(20)])
    true = np.stack([truth(t) for t in range(20)])
    assert (seen & true).sum() > 0.75 * (seen | true).sum()


@pytest.mark.parametrize("layout", sorted(LAYOUTS))
def test_masks_go_where_the_reader_of_the_layout_looks(tmp_path, layout):
    """Training reads the edited masks."""
    _, write = LAYOUTS[layout]
    write(tmp_path)
    capture = open_capture(tmp_path)
    for feed in capture.footage:
        for t in range(capture.frame_count):
            mask = np.zeros((feed.height, feed.width, 1), np.uint8)
            mask[:5] = 255
            write_image(feed.mask_files[t], mask)
    again = open_capture(tmp_path)
    assert again.has_alpha
    for i in range(len(again.cameras)):
        assert (again.view(i, 1).alpha[:4] == 255).all(), layout


def test_every_picture_has_a_mask_also_those_after_the_shortest_camera(tmp_path):
    easyvolcap(tmp_path)
    for k, name in enumerate(NAMES):
        for t in range(5 if k else 4):
            write_image(tmp_path / f"images/{name}/{t:06}.png", picture(k, t))
    with pytest.warns(UserWarning, match="the capture ends at frame 4"):
        capture = open_capture(tmp_path)
    assert make_masks(capture.frames(1)) == 4 + 5 + 5
    with pytest.warns(UserWarning, match="the capture ends at frame 4"):
        assert len(open_capture(tmp_path).cameras) == 3


def test_a_picture_that_cannot_be_read_leaves_no_masks(tmp_path):
    write_scene(tmp_path, frames=3)
    (tmp_path / "images/cam0/002.png").write_bytes(b"broken")
    with pytest.raises(CaptureError, match=r"002.png: not a readable image"):
        make_masks(open_capture(tmp_path), plates(tmp_path))
    assert not [p for p in (tmp_path / "masks").rglob("*") if p.is_file()]


def test_the_command_takes_plates_and_keeps_what_was_edited(tmp_path):
    write_scene(tmp_path, frames=3)
    plates(tmp_path)
    done = run("masks", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "6 masks from plates, the first one is" in done.stdout
    fails(run("masks", tmp_path, "--plate", tmp_path, "--moving"), "--moving and --plate", "exclude each other")
    fails(run("masks", tmp_path), "000.png: there are masks already; delete them, or say --overwrite to replace them")
    done = run("masks", tmp_path, "--moving", "--overwrite")
    assert "6 masks from moving objects" in done.stdout


def test_plates_of_a_named_calibration_file_are_in_the_folder(tmp_path):
    qualisys(tmp_path)
    for name in NAMES:
        write_image(tmp_path / "plate" / f"{name}.png", np.zeros((2 * SMALL_H, 2 * SMALL_W, 3), np.uint8))
    done = run("masks", tmp_path / "calibration" / "rig.qca.txt")
    assert "masks from plates" in done.stdout, done.stderr


def test_what_cannot_be_masked_is_said(tmp_path):
    write_scene(tmp_path / "a", frames=2)
    capture = open_capture(tmp_path / "a")
    with pytest.raises(CaptureError, match="2 frames, expected 3 or more to see what moves, or --plate DIR"):
        make_masks(capture)
    with pytest.raises(CaptureError, match=r"no picture of camera cam0 without the subject, expected cam0.png"):
        make_masks(capture, tmp_path)
    write_image(tmp_path / "cam0.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(CaptureError, match=r"cam0.png: 8x8, expected 160x120 as the images of its camera"):
        make_masks(capture, tmp_path)
    zju_mocap(tmp_path)
    with pytest.raises(UsageError, match="there are masks already"):
        make_masks(open_capture(tmp_path))


def test_pictures_with_alpha_have_their_masks(tmp_path):
    LAYOUTS["transforms"][1](tmp_path)
    with pytest.raises(UsageError, match="its images have an alpha channel"):
        make_masks(open_capture(tmp_path))


def test_a_camera_that_moves_is_refused_and_nothing_is_left(tmp_path):
    write_scene(tmp_path, frames=3)
    rng = np.random.default_rng(0)
    for t in range(3):
        blocks = rng.integers(0, 255, (H // 10, W // 10, 3), np.uint8)
        write_image(tmp_path / f"images/cam1/{t:03}.png", np.kron(blocks, np.ones((10, 10, 1), np.uint8)))
    with pytest.raises(CaptureError, match="nearly everything changes, expected a camera that stands still"):
        make_masks(open_capture(tmp_path))
    assert not (tmp_path / "masks").exists() or not [p for p in (tmp_path / "masks").rglob("*") if p.is_file()]

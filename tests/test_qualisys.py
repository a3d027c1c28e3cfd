"""Qualisys calibrations, and the videos of a capture: any order of frames, threads, short and damaged files."""

import subprocess
import threading

import cv2
import numpy as np
import pytest
from test_capture import write_image

from gscodec.capture import open_capture
from gscodec.capture.video import Video
from gscodec.errors import CaptureError

CALIBRATION = """<calibration><cameras>{}</cameras></calibration>"""
CAMERA = """<camera serial="{name}"><fov_video bottom="{b}" left="0" right="63" top="0"/>
<transform x="{x}" y="0" z="0" r11="{r}" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/>
<intrinsic focalLengthU="{f}" focalLengthV="6400" centerPointU="2016" centerPointV="1504" radialDistortion1="0"
radialDistortion2="0" tangentalDistortion1="0" tangentalDistortion2="0"/></camera>"""


def write_video(path, frames, size=(64, 48)):
    path.parent.mkdir(exist_ok=True)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 50, size)
    for t in range(frames):
        video.write(np.full((size[1], size[0], 3), (0, 0, 4 * t), np.uint8))
    video.release()


@pytest.fixture
def qualisys(tmp_path):
    def save(**cameras):
        values = {"b": 47, "x": 1000, "r": 1, "f": 6400}
        text = "".join(CAMERA.format(name=n, **(values | c)) for n, c in cameras.items())
        (tmp_path / "calibration").mkdir(exist_ok=True)
        (tmp_path / "calibration" / "Calib.qca.txt").write_text(CALIBRATION.format(text))
        return lambda: open_capture(tmp_path)

    for n in ("a", "b"):
        write_video(tmp_path / f"videos/{n}.mp4", 60)
    return tmp_path, save


def test_qualisys_units_and_axes(qualisys):
    capture = qualisys[1](a={}, b={"x": -500})()
    camera = capture.cameras[0]
    assert (capture.fps, capture.frame_count, capture.has_alpha) == (50, 60, False)
    assert camera.K.tolist() == [[100, 0, 32], [0, 100, 24], [0, 0, 1]]
    np.testing.assert_allclose(camera.center, (1, 0, 0))
    x, y, z, _ = camera.viewmat @ (1, 2, -10, 1)  # calibration axes: y up, z backwards
    assert (x, y, z) == (0, -2, 10)


def test_video_frames_in_any_order(qualisys):
    video = Video(qualisys[0] / "videos/a.mp4")
    order = [0, 1, 2, 1, 59, 3, 30, 30, 4, 58]
    for t in order:
        assert abs(int(video.frame(t)[24, 32, 0]) - 4 * t) <= 6, t
    with pytest.raises(CaptureError, match=r"a.mp4: frame 99 cannot be decoded, the video has 60 frames"):
        video.frame(99)
    assert abs(int(video.frame(5)[24, 32, 0]) - 20) <= 6


SLOWER = "setpts='if(lt(N,20),N,20+3*(N-20))/50/TB'"


@pytest.mark.parametrize(
    ("before", "after", "frames"),
    [
        ((), ("-vf", SLOWER, "-fps_mode", "vfr", "-g", "10", "a.mp4"), 60),  # of two rates
        ((), ("-c", "copy", "-f", "matroska", "-"), 60),  # without a duration
        (("-ss", "0.3"), ("-c", "copy", "a.mp4"), 45),  # with frames before its start
    ],
)
def test_videos_whose_headers_mislead(qualisys, tmp_path, before, after, frames):
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    coded = ("-i", "videos/a.mp4", "-c:v", "libx264", "-g", "40", "whole.mp4")
    for command in (coded, (*before, "-i", "whole.mp4", *after)):
        done = subprocess.run([ffmpeg, "-v", "error", *command], cwd=tmp_path, capture_output=True, check=True)
    path = tmp_path / "a.mp4"
    if done.stdout:
        path.write_bytes(done.stdout)
    video, other = Video(path), Video(path)
    assert video.frame_count == frames
    in_order = [other.frame(t) for t in range(frames)]
    for t in (0, frames - 1, 3, 40, 20, 41, 2):
        np.testing.assert_array_equal(video.frame(t), in_order[t])
    assert abs(int(in_order[-1][24, 32, 0]) - 4 * 59) <= 6


def test_views_from_threads(qualisys):
    capture = qualisys[1](a={}, b={})()
    wrong = []

    def check(camera):
        for t in range(0, 20):
            if abs(int(capture.view(camera, t).rgb[24, 32, 0]) - 4 * t) > 6:
                wrong.append((camera, t))

    threads = [threading.Thread(target=check, args=(i % 2,)) for i in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert not wrong


def test_short_videos_are_named(qualisys):
    path, save = qualisys
    write_video(path / "videos/a.mp4", 40)
    with pytest.warns(UserWarning, match=r"a.mp4: short, 40 of 60 frames; the capture ends at frame 40"):
        assert save(a={}, b={})().frame_count == 40
    write_video(path / "videos/a.mp4", 20)
    with pytest.warns(UserWarning, match=r"a.mp4: short, 20 of 60 frames; the camera is left out"):
        capture = save(a={}, b={})()
    assert (capture.frame_count, len(capture.cameras)) == (60, 1)


def test_video_at_another_scale(qualisys):
    path, save = qualisys
    write_video(path / "videos/a.mp4", 60, (32, 24))
    capture = save(a={}, b={})()
    assert capture.cameras[0].K[0].tolist() == [50, 0, 16]
    assert capture.view(0, 3).rgb.shape == (24, 32, 3)


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        ({"b": 9}, "a.mp4 is 64x48, expected 64x10"),
        ({"r": 0}, "its pose is singular"),
        ({"x": "nan"}, "<transform> is missing or incomplete"),
        ({"f": ""}, "<intrinsic> is missing or incomplete, expected numbers focalLengthU"),
        ({"f": -1}, "focal length .* is not positive"),
    ],
)
def test_a_broken_qualisys_camera_is_left_out(qualisys, harm, message):
    with pytest.warns(UserWarning, match=message):
        assert len(qualisys[1](a=harm, b={})().cameras) == 1


def test_missing_and_damaged_videos(qualisys):
    path, save = qualisys
    (path / "videos/a.mp4").write_bytes(b"nothing")
    with pytest.warns(UserWarning, match="left out") as seen:
        save(a={}, b={}, c={})()
    text = " ".join(str(w.message) for w in seen)
    assert "a.mp4: not a readable video" in text
    assert "camera c is left out: no video, looked for c with .mp4" in text
    with pytest.raises(CaptureError, match="no camera can be used"), pytest.warns():
        save(c={})()
    with pytest.raises(CaptureError, match="video is missing"):
        Video(path / "none.mp4")


@pytest.mark.parametrize(("text", "message"), [("<a>", "not valid XML"), ("<a/>", "no cameras, expected a Qualisys")])
def test_bad_calibration_files(tmp_path, text, message):
    (tmp_path / "x.qca.txt").write_text(text)
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_qualisys_masks(qualisys):
    path, save = qualisys
    for t in range(60):
        write_image(path / f"masks/a/{t:03}.png", np.full((48, 64, 1), t, np.uint8))
    capture = save(a={}, b={})()
    assert capture.has_alpha
    assert (capture.view(0, 7).alpha == 7).all()
    (path / "masks/a/000.png").unlink()
    with pytest.warns(UserWarning, match="camera a is left out: .*: 59 masks for 60 frames"):
        save(a={}, b={})()

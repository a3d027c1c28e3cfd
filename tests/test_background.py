"""Pictures before a background of one colour, without masks: pixels that differ from it are the subject."""

import cv2
import numpy as np
import pytest
from rig_layouts import easyvolcap
from test_capture import write_image
from test_cli import fails, run

from gscodec.capture import open_capture
from gscodec.capture.background import background_of, cut_out

SIDE = 160
BLACK, WHITE = (0, 0, 0), (255, 255, 255)


def subject(shift=0):
    """[SIDE, SIDE, 3] colours and [SIDE, SIDE] alpha of a textured ring; borders are soft (4 x 4 supersampling)."""
    fine = 4 * SIDE
    alpha = np.zeros((fine, fine), np.float32)
    cv2.circle(alpha, (fine // 2 + shift, fine // 2), fine // 4, 1, -1)
    cv2.circle(alpha, (fine // 2 + shift, fine // 2), fine // 10, 0, -1)
    noise = np.random.default_rng(shift).uniform(60, 200, (10, 10, 3)).astype(np.float32)
    return cv2.resize(noise, (SIDE, SIDE)), cv2.resize(alpha, (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def over(rgb, alpha, color):
    return np.rint(rgb * alpha[..., None] + np.asarray(color) * (1 - alpha[..., None])).astype(np.uint8)


def jpeg(rgb, quality):
    return cv2.imdecode(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1)


@pytest.mark.parametrize("color", [BLACK, WHITE, (20, 200, 40)])
@pytest.mark.parametrize(("quality", "most"), [(None, 1), (90, 8)])
def test_a_subject_is_cut_out_as_if_its_alpha_were_known(color, quality, most):
    rgb, alpha = subject()
    seen = over(rgb, alpha, color)
    seen = seen if quality is None else jpeg(seen, quality)
    assert (np.abs(background_of([seen, seen]) - color) <= 1).all()
    found = cut_out(seen, np.asarray(color, np.float32))
    assert found[1][SIDE // 2, SIDE // 2] == 0, "the hole does not touch the border"
    for other in (BLACK, WHITE, (128, 128, 128)):  # composited over any other background it is correct
        error = over(found[0], found[1] / 255, other).astype(float) - over(rgb, alpha, other)
        assert np.sqrt((error**2).mean()) < most


def test_noise_a_room_and_nothing_at_all_are_no_background():
    rng = np.random.default_rng(0)
    seen = [over(*subject(s), BLACK) for s in range(4)]
    assert background_of(seen) is not None
    assert background_of([np.clip(s + rng.normal(4, 1.5, s.shape), 0, 255).astype(np.uint8) for s in seen]) is None
    assert background_of([s + np.uint8(3 * i) for i, s in enumerate(seen)]) is None, (
        "one colour in each camera, not all"
    )
    assert background_of([subject(s)[0].astype(np.uint8) for s in range(4)]) is None
    assert background_of([np.zeros((9, 9, 3), np.uint8)] * 3) is None, "nothing stands before it"


def before_black(root):
    easyvolcap(root)
    for path in sorted(root.glob("images/*/*")):
        rgb, alpha = subject()
        size = cv2.imread(str(path)).shape[1::-1]
        write_image(path, cv2.resize(over(rgb, alpha, BLACK), size, interpolation=cv2.INTER_AREA))
    return root


def test_a_capture_before_black_is_read_with_masks(tmp_path):
    with pytest.warns(UserWarning, match=r"no masks, and a background of one colour, \(0, 0, 0\)"):
        capture = open_capture(before_black(tmp_path / "a"))
    assert capture.has_alpha
    assert 0.1 < (capture.view(1, 1).alpha > 127).mean() < 0.3
    done = run("info", tmp_path / "a")
    assert "masks from background" in done.stdout
    fails(run("encode", tmp_path / "a", tmp_path / "out.gsv", "--tracks", "masks"), "nothing is known of the room")


def test_masks_of_files_go_before_the_background(tmp_path):
    with pytest.warns(UserWarning, match="no masks"):
        feeds = open_capture(before_black(tmp_path)).footage
    for feed in feeds:
        for path in feed.mask_files:
            write_image(path, np.full((feed.height, feed.width, 1), 255, np.uint8))
    assert (open_capture(tmp_path).view(0, 0).alpha == 255).all()

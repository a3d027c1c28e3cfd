"""Image files -> views: colour, alpha, resampling and compositing."""

import numpy as np
import pytest
from test_capture import write_image

from gscodec.capture import View, composite
from gscodec.capture.images import read_image, read_mask, resize_area
from gscodec.errors import CaptureError


@pytest.mark.parametrize(
    ("suffix", "dtype"), [("png", "uint8"), ("png", "uint16"), ("tif", "uint16"), ("webp", "uint8")]
)
def test_integer_images_are_srgb_and_unassociated(tmp_path, suffix, dtype):
    source = np.dstack([np.full((8, 8), v, np.uint8) for v in (200, 100, 50, 128)])
    scaled = source if dtype == "uint8" else (source.astype(np.uint16) * 257)
    write_image(tmp_path / f"a.{suffix}", scaled, dtype)
    view = read_image(tmp_path / f"a.{suffix}")
    assert np.abs(view.rgb.astype(int) - source[..., :3]).max() <= (6 if suffix == "webp" else 0)
    assert (view.alpha == 128).all()


def test_exr_is_linear_and_premultiplied(tmp_path):
    linear = np.array([0.5, 0.2, 0.01, 1.0], np.float32)
    image = np.tile(linear * 0.5, (4, 4, 1)).astype(np.float32)  # premultiplied with alpha 0.5
    write_image(tmp_path / "a.exr", image, "half", unassociated=False)
    view = read_image(tmp_path / "a.exr")
    np.testing.assert_array_equal(view.rgb[0, 0], [188, 124, 25])
    assert view.alpha[0, 0] == 128


def test_a_truncated_image_is_named_in_one_line(tmp_path):
    path = tmp_path / "a.png"
    write_image(path, np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8))
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(CaptureError, match=r"^.*a.png: damaged image \(.+\), expected a whole file; copy it again$"):
        read_image(path)


@pytest.mark.parametrize(
    ("values", "dtype", "expected"),
    [
        ([(9, 255), (200, 255)], "uint8", [9, 200]),  # opaque alpha says nothing
        ([(9, 255), (200, 7)], "uint8", [255, 7]),
        ([(0,), (1,)], "uint8", [0, 255]),
        ([(0,), (1,)], "uint16", [0, 255]),
        ([(0.25,), (1.0,)], "float", [64, 255]),
        ([(0,), (0,)], "uint8", [0, 0]),
    ],
)
def test_masks_say_coverage(tmp_path, values, dtype, expected):
    colour = [(v[0],) * 3 + v[1:] for v in values]
    path = tmp_path / ("a.tif" if dtype == "float" else "a.png")
    write_image(path, np.array([colour], {"float": "f4"}.get(dtype, dtype)), dtype)
    assert read_mask(path).tolist() == [expected]


def test_grey_image(tmp_path):
    write_image(tmp_path / "a.png", np.full((4, 4, 1), 90, np.uint8))
    view = read_image(tmp_path / "a.png")
    assert (view.rgb == 90).all()
    assert view.alpha is None


def test_area_filter_ignores_colour_under_alpha_zero():
    rgb = np.zeros((2, 2, 3), np.uint8)
    rgb[0, 0], rgb[1, 1] = (200, 100, 40), (255, 255, 255)
    small = resize_area(View(rgb, np.array([[255, 0], [0, 0]], np.uint8)), 1, 1)
    np.testing.assert_array_equal(small.rgb[0, 0], (200, 100, 40))
    assert small.alpha[0, 0] == 64


def test_composite_blends_over_the_background():
    view = View(np.full((1, 1, 3), 200, np.uint8), np.array([[51]], np.uint8))
    assert composite(view, (0.5, 0.0, 1.0))[0, 0].tolist() == [142, 40, 244]
    assert composite(View(view.rgb), (1, 1, 1)) is view.rgb

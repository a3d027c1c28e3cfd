"""Depth: rendered and differentiated by the rasterizer, read by captures, used in training."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from rig_layouts import FRAMES, NAMES, H, W, easyvolcap
from test_raster import BACKGROUND, camera, scene

from gscodec.capture import open_capture
from gscodec.capture.depth import DepthImages, along_axis
from gscodec.capture.report import describe_capture
from gscodec.capture.sheet import contact_sheet
from gscodec.errors import CaptureError
from gscodec.model.gaussians import PARAMETERS
from gscodec.render.backend import LossWeights, TargetView
from gscodec.render.cpu import CpuBackend
from gscodec.render.reference import project, rasterize_reference
from gscodec.train.depth_points import depth_points

SH_C0 = 0.28209479177387814


def reference_depth(params: list[torch.Tensor], cam) -> tuple[torch.Tensor, torch.Tensor]:
    """Sum of weight times depth, and alpha, [H, W] each: the reference rasterizer with depths as colours."""
    z = project(*params[:3], cam)[2]
    colour = ((z - 0.5) / SH_C0)[:, None].expand(-1, 3)
    image, alpha, _ = rasterize_reference(*params[:4], colour, params[5][:, :0], cam)
    return image[..., 0], alpha


def test_depth_is_rendered_as_colours_are():
    cam, params = camera(), scene(k=3)
    total, alpha = reference_depth(params, cam)
    named = {k: p.detach().float() for k, p in zip(PARAMETERS, params, strict=True)}
    found = CpuBackend().render_depth(named, cam)
    drawn = alpha.detach().numpy() > 0.01
    np.testing.assert_allclose(found[drawn], (total / alpha).detach().numpy()[drawn], rtol=2e-3)
    assert not found[alpha.detach().numpy() == 0].any()


def test_loss_of_depth_and_its_gradient():
    cam, params, rng = camera(), scene(k=3), np.random.default_rng(5)
    target = rng.uniform(2, 6, (cam.height, cam.width)).astype(np.float32)
    target[rng.random(target.shape) < 0.3] = 0
    target[3, 4] = np.inf
    total, alpha = reference_depth(params, cam)
    known = torch.from_numpy((target > 0) & np.isfinite(target))
    d = torch.where(known, torch.from_numpy(target).double(), 1.0)
    loss = (torch.where(known, (total / d - alpha).abs(), 0)).mean()
    want = torch.autograd.grad(loss, params[:4])
    named = {k: p.detach().float() for k, p in zip(PARAMETERS, params, strict=True)}
    rgb = np.zeros((cam.height, cam.width, 3), np.uint8)
    views = [TargetView(cam, rgb, None, BACKGROUND, target_depth=t) for t in (target, None)]
    backend, gradients = CpuBackend(), []
    for view in views:
        r = backend.photometric_loss(named, [view], LossWeights(depth=1.0))
        gradients.append([r.grads[name].clone() for name in PARAMETERS])
        if view.target_depth is not None:
            assert r.depth == pytest.approx(loss.item(), rel=1e-4)
            assert r.loss == pytest.approx(r.image_loss + r.depth)
        else:
            assert r.depth == 0
    for name, w, both, image in zip(PARAMETERS, want, *gradients, strict=False):
        assert (both - image - w).norm() <= 2e-3 * w.norm() + 1e-4 * both.norm(), name
    assert torch.equal(gradients[0][4], gradients[1][4]), "depth says nothing of colours"


def write(folder, *, unit=None, size=(8, 6), names=None):
    """A capture of two cameras and frames with depth images: 1.5 m on the left, 3 m on the right, unknown on top."""
    import cv2

    depth = np.full((size[1], size[0]), 1500, np.uint16)
    depth[:, size[0] // 2 :] = 3000
    depth[0] = 0
    frames = []
    for c in range(2):
        for t in range(2):
            name = f"{c}_{t}.png"
            cv2.imwrite(str(folder / name), np.full((6, 8, 3), 90, np.uint8))
            cv2.imwrite(str(folder / f"d{name}"), depth)
            pose = np.eye(4)
            pose[0, 3] = 0.1 * c
            entry = {"file_path": name, "camera": f"cam{c}", "frame": t, "transform_matrix": pose.tolist()}
            frames.append({**entry, **({"depth_file_path": f"d{name}"} if names is None else names(c, t))})
    head = {"fl_x": 10, "w": 8, "h": 6, "frames": frames}
    (folder / "transforms.json").write_text(
        json.dumps(head | ({} if unit is None else {"depth_unit_scale_factor": unit}))
    )
    return folder


@pytest.mark.parametrize(("unit", "metres"), [(None, 1.5), (0.002, 3.0)])
def test_depth_images_of_nerfstudio(tmp_path, unit, metres):
    capture = open_capture(write(tmp_path, unit=unit))
    depth = capture.view(1, 1).depth
    assert capture.has_depth
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth[1:, :4], metres)
    np.testing.assert_allclose(depth[1:, 4:], 2 * metres)
    assert not depth[0].any()
    small = capture.scaled(0.5).view(0, 0).depth
    assert small.shape == (3, 4)
    assert set(np.unique(small)) <= set(np.unique(depth)), "depths are never mixed"


def test_depth_images_may_be_smaller_than_pictures(tmp_path):
    depth = open_capture(write(tmp_path, size=(4, 3))).view(0, 0).depth
    assert depth.shape == (6, 8)
    assert set(np.unique(depth)) == {0, np.float32(1.5), np.float32(3)}


def test_info_and_sheet_show_depth(tmp_path):
    capture, facts = describe_capture(write(tmp_path))
    assert facts["depth"] == 2
    assert facts["cameras"][0]["depth"] == {"near": 1.5, "far": 3.0, "known": 0.8333}
    assert "no sparse points: training starts from depth images" in facts["missing"]
    without = replace(capture, read=lambda i, t: replace(capture.read(i, t), depth=None))
    assert contact_sheet(capture).shape[0] > contact_sheet(without).shape[0]


@pytest.mark.parametrize(
    ("names", "unit", "said"),
    [
        (lambda c, t: {"depth_file_path": "none.png"}, None, "depth image .*none.png is missing"),
        (lambda c, t: {"depth_file_path": 3}, None, "depth_file_path is 3"),
        (lambda c, t: {} if t else {"depth_file_path": f"d{c}_{t}.png"}, None, "1 depth images for 2 frames"),
        (None, -1, "depth_unit_scale_factor is -1"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*is left out")
def test_wrong_depth_is_named(tmp_path, names, unit, said):
    with pytest.raises(CaptureError, match=said):
        open_capture(write(tmp_path, unit=unit, names=names))


def test_damaged_depth_images(tmp_path):
    path = tmp_path / "d.npy"
    for values, said in (
        (np.ones((2, 6), np.float32), "depth image is 6x2, expected 8x6"),
        (np.ones((4, 4, 2), np.float32), "expected depth .height, width. as numbers"),
    ):
        np.save(path, values)
        with pytest.raises(CaptureError, match=said):
            DepthImages([path]).read(0, 8, 6)
    path.write_bytes(b"\x93NUMPY")
    with pytest.raises(CaptureError, match="not a numpy file"):
        DepthImages([path]).read(0, 8, 6)
    path.with_suffix(".png").write_bytes(b"PNG?")
    with pytest.raises(CaptureError, match="not a readable depth image"):
        DepthImages([path.with_suffix(".png")]).read(0, 8, 6)


def test_distances_along_rays_become_depth():
    cam = camera()
    rng = np.random.default_rng(0)
    z = rng.uniform(1, 2, (cam.height, cam.width))
    y, x = np.mgrid[: cam.height, : cam.width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(cam.K).T
    np.testing.assert_allclose(along_axis(z * np.linalg.norm(rays, axis=-1), cam.K), z, rtol=1e-6)


def test_depth_images_of_easyvolcap(tmp_path):
    """Values are distances from the camera, the default of EasyVolcap's loader."""
    easyvolcap(tmp_path)
    for name in NAMES:
        (tmp_path / "depths" / name).mkdir(parents=True)
        for t in range(FRAMES):
            np.save(tmp_path / "depths" / name / f"{t:06}.npy", np.full((H, W, 1), 2 + t, np.float32))
    capture = open_capture(tmp_path)
    depth = capture.view(1, 1).depth
    np.testing.assert_allclose(depth, along_axis(np.full((H, W), 3.0), capture.cameras[1].K), rtol=1e-6)
    assert depth[0, 0] < 0.95 * depth.max()


def test_points_of_depth_images_lie_on_their_surface():
    cam = camera()
    other = replace(cam, viewmat=cam.viewmat + np.array([[0, 0, 0, 0.2]] + 3 * [[0] * 4]))
    rgb = np.full((cam.height, cam.width, 3), 51, np.uint8)
    depth = np.full((cam.height, cam.width), 3, np.float32)
    flying = depth.copy()
    flying[10:20, 10:20] = 1.5  # between the camera and a wall that the other cameras see
    views = [(cam, rgb, None), (other, rgb, None), (other, rgb, None)]
    points, colors = depth_points(views, [flying, depth, depth], 2000, 0, 0.03)
    z = points @ cam.viewmat[2, :3] + cam.viewmat[2, 3]
    assert len(points) > 500
    np.testing.assert_allclose(z, 3, atol=1e-3)
    np.testing.assert_allclose(colors, 0.2)
    assert len(depth_points(views, [None, depth, None], 100, 0, 0.03)[0]) == 100

"""The rasterizer against its references: plain torch, its own scalar instance, finite differences, poison."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from gscodec.errors import LimitError, UsageError  # noqa: E402
from gscodec.model.camera import Camera, look_at  # noqa: E402
from gscodec.model.gaussians import Gaussians  # noqa: E402
from gscodec.render.image import render_image, render_rgba  # noqa: E402
from gscodec.render.rasterize import rasterize  # noqa: E402
from gscodec.render.reference import rasterize_reference  # noqa: E402
from gscodec.render.step import Crop, render_batch, render_loss  # noqa: E402
from gscodec.render.workspace import PARAMETERS, STATISTICS, Workspace, simd_levels  # noqa: E402
from gscodec.train.ssim import image_loss_reference  # noqa: E402

BACKGROUND = (0.2, 0.5, 0.9)


def camera(width=61, height=45) -> Camera:
    K = np.array([[width, 0, 0.49 * width], [0, 1.05 * width, 0.52 * height], [0, 0, 1.0]])
    return Camera("test", K, look_at([0.3, 0.2, -2.5], [0, 0, 0], [0, -1, 0]), width, height)


def scene(n=40, k=15, dtype=torch.float64, seed=3, log_scale=-2.2) -> list[torch.Tensor]:
    """Parameters in the order of PARAMETERS; no Gaussian near the eye, some behind others."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    p = [
        0.5 * normal(n, 3),
        normal(n, 4),
        0.4 * normal(n, 3) + log_scale,
        normal(n),
        normal(n, 3),
        0.3 * normal(n, k, 3),
    ]
    return [v.to(dtype).requires_grad_() for v in p]


def weights(cam: Camera):
    """Fixed random gradients of image and alpha."""
    g = torch.Generator().manual_seed(7)
    return torch.randn(cam.height, cam.width, 3, generator=g), torch.randn(cam.height, cam.width, generator=g)


def gradients(draw, params, cam):
    """Gradients of a random linear function of the picture; zeros for shN of degree 0."""
    gi, ga = weights(cam)
    image, alpha, _ = draw(*params, cam, BACKGROUND)
    value = (image * gi.to(image.dtype)).sum() + (alpha * ga.to(image.dtype)).sum()
    grads = torch.autograd.grad(value, params, allow_unused=True)
    return image, alpha, [torch.zeros_like(p) if g is None else g for p, g in zip(params, grads, strict=True)]


@pytest.mark.parametrize("simd", simd_levels())
@pytest.mark.parametrize("k", [0, 3, 8, 15])
def test_picture_and_gradients_match_the_torch_reference(simd, k):
    cam, exact = camera(), scene(k=k)
    params = [p.detach().float().requires_grad_() for p in exact]
    workspace = Workspace(simd=simd)
    want_image, want_alpha, want = gradients(rasterize_reference, exact, cam)
    image, alpha, got = gradients(lambda *a: rasterize(*a, workspace=workspace), params, cam)
    assert (image - want_image).abs().max() < 1e-5
    assert (alpha - want_alpha).abs().max() < 1e-5
    for name, g, w in zip(PARAMETERS, got, want, strict=True):
        assert (g - w).norm() <= 1e-4 * w.norm(), name


def test_gaussians_beyond_the_field_of_view_match_the_reference():
    # Wide ones whose centres are past the clamp of the Jacobian, and some nearer than the near plane.
    cam, exact = camera(), scene(n=60, k=3, log_scale=-0.8)
    with torch.no_grad():
        exact[0][:, :2].mul_(6)
        exact[0][::9, 2] = -2.6
        exact[3].sub_(1.0)
    params = [p.detach().float().requires_grad_() for p in exact]
    want_image, _, want = gradients(rasterize_reference, exact, cam)
    image, _, got = gradients(rasterize, params, cam)
    assert (image - want_image).abs().max() < 1e-4
    for name, g, w in zip(PARAMETERS, got, want, strict=True):
        assert (g - w).norm() <= 1e-3 * w.norm(), name


def test_reference_gradients_match_finite_differences():
    # Few large, faint Gaussians: no pixel crosses a threshold within the step.
    cam, params = camera(17, 13), scene(n=4, k=3, log_scale=-0.3)
    with torch.no_grad():
        params[3].sub_(1.0)
    gi, ga = weights(cam)

    def value(values):
        image, alpha, _ = rasterize_reference(*values, cam, BACKGROUND)
        return ((image * gi).sum() + (alpha * ga).sum()).item()

    _, _, grads = gradients(rasterize_reference, params, cam)
    rng = np.random.default_rng(0)
    for which, name in enumerate(PARAMETERS):
        for index in rng.choice(params[which].numel(), min(6, params[which].numel()), replace=False):
            moved = []
            for step in (-1e-5, 1e-5):
                values = [p.detach().clone() for p in params]
                values[which].view(-1)[index] += step
                moved.append(value(values))
            slope, want = (moved[1] - moved[0]) / 2e-5, grads[which].reshape(-1)[index].item()
            assert abs(slope - want) < 1e-5 * (1 + abs(want)), f"{name}[{index}]: {slope}, expected {want}"


def dense(n=3000, seed=5, k=3) -> Gaussians:
    arrays = [p.detach().numpy() for p in scene(n, k, torch.float32, seed, -3.0)]
    return Gaussians(*arrays).validate("dense")


@pytest.mark.parametrize("simd", simd_levels())
def test_every_level_draws_what_scalar_draws(simd):
    cam = camera(203, 150)  # no multiple of the tile
    for seed in range(3):
        g = dense(seed=seed)
        want = render_rgba(g, cam, workspace=Workspace(simd="scalar"))
        got = render_rgba(g, cam, workspace=Workspace(simd=simd))
        assert np.abs(got - want).max() <= 1 / 255
        assert np.abs(got - want).mean() < 1e-5


def test_threads_change_no_bit():
    cam, g = camera(203, 150), dense()
    params = {k: getattr(g, k) for k in PARAMETERS}
    target = np.random.default_rng(0).integers(0, 256, (150, 203, 3), np.uint8)
    results = []
    for threads in (1, 2, 5):
        r = render_loss(
            params, cam, target, target[..., 0], BACKGROUND, 0.2, 0.1, Workspace(threads=threads), gain=(1, 0.9, 1.1)
        )
        results.append([r.loss, r.grad_gain, *r.grads.values(), *(getattr(r, s) for s in STATISTICS)])
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def poisoned(values, count=400):
    g = dense(count)
    rng = np.random.default_rng(1)
    for name in PARAMETERS:
        a = getattr(g, name).reshape(-1)
        a[rng.choice(a.size, 60, replace=False)] = rng.choice(values, 60)
    return g


@pytest.mark.parametrize("simd", simd_levels())
@pytest.mark.parametrize(
    "values",
    [[np.nan], [np.inf, -np.inf], [1e-42, -1e-42], [1e38, -1e38], [0.0], [88.0, -104.0], [30.0, -30.0], [1e4, -1e4]],
    ids=str,
)
def test_poison_is_skipped_or_harmless(simd, values):
    cam = camera()
    g = poisoned(np.array(values, np.float32))
    params = {k: getattr(g, k) for k in PARAMETERS}
    target = np.zeros((cam.height, cam.width, 3), np.uint8)
    workspace = Workspace(simd=simd)
    image, alpha = workspace.forward(tuple(params.values()), cam, BACKGROUND)
    assert np.isfinite(alpha).all()
    assert alpha.min() >= 0
    assert alpha.max() <= 1
    render_loss(params, cam, target, None, BACKGROUND, workspace=workspace)
    if not np.isfinite(values).all():  # such Gaussians are dropped whole
        bad = ~np.all([np.isfinite(p.reshape(len(p), -1)).all(1) for p in params.values()], axis=0)
        clean = tuple(p[~bad] for p in params.values())
        want, _ = workspace.forward(clean, cam, BACKGROUND)
        np.testing.assert_array_equal(image, want)


def test_extreme_scenes():
    workspace, cam = Workspace(), camera()
    on_one_tile = dense(10_000)
    on_one_tile.means[:] *= 0.01
    filling = dense(50)
    filling.log_scales[:] = 3.0
    behind = dense(50)
    behind.means[:, 2] -= 10
    nothing = dense(50).take(np.zeros(0, int))
    flat = dense(50)
    flat.log_scales[:, 1:] = -40
    for g in (on_one_tile, filling, behind, nothing, flat):
        params = {k: getattr(g, k) for k in PARAMETERS}
        target = np.full((cam.height, cam.width, 3), 128, np.uint8)
        r = render_loss(params, cam, target, None, BACKGROUND, workspace=workspace)
        assert np.isfinite(r.loss)
        assert all(np.isfinite(v).all() for v in r.grads.values())
    assert (render_image(behind, cam, (0.5, 0.5, 0.5)) == 128).all()


def test_step_is_the_sum_of_its_parts():
    cam, ssim_lambda, mask_lambda = camera(), 0.2, 0.3
    rng = np.random.default_rng(2)
    rgb = rng.integers(0, 256, (cam.height, cam.width, 3), np.uint8)
    mask = rng.integers(0, 256, (cam.height, cam.width), np.uint8)
    weight = rng.random((cam.height, cam.width), np.float32)
    params = scene(k=3)
    gain = torch.tensor([1.1, 0.9, 1.0], dtype=torch.float64, requires_grad=True)
    black, alpha, _ = rasterize_reference(*params, cam)
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    image = gain * black + (1 - alpha)[..., None] * background
    a = torch.from_numpy(mask) / 255.0
    target = torch.from_numpy(rgb) / 255.0 * a[..., None] + (1 - a)[..., None] * background
    loss = image_loss_reference(image, target, ssim_lambda, torch.from_numpy(weight).double())
    loss = loss + mask_lambda * (alpha - a).abs().mean()
    want = torch.autograd.grad(loss, [*params, gain])
    named = {k: p.detach().float() for k, p in zip(PARAMETERS, params, strict=True)}
    r = render_loss(named, cam, rgb, mask, BACKGROUND, ssim_lambda, mask_lambda, gain=gain.tolist(), weight=weight)
    assert r.loss == pytest.approx(loss.item(), rel=1e-5)
    for w, (name, g) in zip(want, r.grads.items(), strict=False):
        assert (g - w).norm() <= 1e-3 * w.norm(), name
    np.testing.assert_allclose(r.grad_gain, want[-1].numpy(), rtol=1e-4)


def test_region_is_a_crop():
    cam, g = camera(203, 150), dense()
    params = tuple(getattr(g, k) for k in PARAMETERS)
    whole, _ = Workspace().forward(params, cam, BACKGROUND)
    part, _ = Workspace().forward(params, cam, BACKGROUND, (37, 21, 90, 70))
    np.testing.assert_allclose(part, whole[21:91, 37:127], atol=2e-5)


def test_batch_of_crops_is_the_sum_of_its_crops():
    cam, g = camera(), dense(300)
    params = {k: getattr(g, k) for k in PARAMETERS}
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (cam.height, cam.width, 3), np.uint8)
    other = replace(cam, viewmat=cam.viewmat @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    crops = [Crop(cam, rgb, region=(5, 3, 20, 17)), Crop(cam, rgb, None, BACKGROUND, (1.1, 0.9, 1.0)), Crop(other, rgb)]
    batch = render_batch(params, crops)
    single = [render_batch(params, [crop], workspace=Workspace()) for crop in crops]
    assert batch.loss == pytest.approx(sum(s.loss for s in single))
    for name in PARAMETERS:
        total = sum(np.asarray(s.grads[name], np.float64) for s in single)
        assert np.abs(total).max() > 0
        np.testing.assert_allclose(batch.grads[name], total, rtol=1e-5, atol=1e-6 * np.abs(total).max())
    np.testing.assert_allclose(batch.sum_weight, sum(s.sum_weight for s in single), rtol=1e-5)
    for name in ("max_weight", "radii"):
        np.testing.assert_array_equal(getattr(batch, name), np.max([getattr(s, name) for s in single], 0))
    np.testing.assert_array_equal(batch.grad_gain, [s.grad_gain[0] for s in single])
    with pytest.raises(UsageError, match="at least one crop"):
        render_batch(params, [])


def test_8_bit_image_is_the_float_image_rounded():
    cam, g = camera(203, 150), dense()
    params = tuple(getattr(g, k) for k in PARAMETERS)
    image, _ = Workspace().forward(params, cam, BACKGROUND)
    want = np.floor(np.clip(image, 0, 1) * 255 + 0.5)
    np.testing.assert_array_equal(render_image(g, cam, BACKGROUND), want)


def test_statistics():
    cam, params = camera(), [p.detach().float().requires_grad_() for p in scene()]
    image, alpha, info = rasterize(*params, cam)
    _, _, want = rasterize_reference(*scene(), cam)
    (image.sum() + alpha.sum()).backward()
    torch.testing.assert_close(info.sum_weight, want.float(), rtol=1e-4, atol=1e-4)
    assert ((info.max_weight > 0) == (want > 0)).all()
    assert (info.max_weight <= 0.999).all()
    assert (info.grad2d[want > 0] > 0).all()


def test_two_pictures_of_one_workspace_keep_their_gradients():
    cam, other, params = camera(), camera(80, 30), [p.detach().float().requires_grad_() for p in scene()]
    workspace = Workspace()
    alone = torch.autograd.grad(rasterize(*params, cam)[0].square().sum(), params)
    first = rasterize(*params, cam, workspace=workspace)[0]
    rasterize(*params, other, workspace=workspace)
    for a, b in zip(alone, torch.autograd.grad(first.square().sum(), params), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_wrong_arguments_are_named():
    cam, g = camera(), dense(10)
    params = [getattr(g, k) for k in PARAMETERS]
    with pytest.raises(UsageError, match="quats has 39 values, expected 40"):
        Workspace().forward((params[0], params[1].reshape(-1)[:-1], *params[2:]), cam, BACKGROUND)
    with pytest.raises(UsageError, match="region 0x3"):
        Workspace().forward(tuple(params), cam, BACKGROUND, (0, 0, 0, 3))
    with pytest.raises(UsageError, match='simd "neon9" is not available'):
        Workspace(simd="neon9")
    with pytest.raises(LimitError, match="more than 16384 pixels on a side"):
        render_image(g, Camera("c", cam.K, cam.viewmat, 20000, 10))
    with pytest.raises(UsageError, match="distortion"):
        render_image(g, Camera("c", cam.K, cam.viewmat, 61, 45, np.array([0.1])))


def test_gsplat_draws_the_same():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    pytest.importorskip("gsplat")
    cam, params = camera(), [p.detach().float() for p in scene()]
    image, alpha, _ = rasterize(*params, cam, BACKGROUND)
    other, other_alpha, _ = rasterize(*(p.cuda() for p in params), cam, BACKGROUND)
    assert (other.cpu() - image).abs().mean() < 1e-3
    assert (other_alpha.cpu() - alpha).abs().mean() < 1e-3

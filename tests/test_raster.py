"""The CPU backend against its references (plain torch, its scalar instance, finite differences), and with poison."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from gscodec.errors import LimitError, UsageError  # noqa: E402
from gscodec.model.camera import Camera, look_at  # noqa: E402
from gscodec.model.gaussians import PARAMETERS, Gaussians  # noqa: E402
from gscodec.model.rotations import turned_harmonics  # noqa: E402
from gscodec.render.backend import STATISTICS, TURNS, LossWeights, TargetView  # noqa: E402
from gscodec.render.cpu import CpuBackend  # noqa: E402
from gscodec.render.image import render_image, render_rgba  # noqa: E402
from gscodec.render.reference import image_loss_reference, rasterize_reference  # noqa: E402
from gscodec.render.workspace import Workspace, simd_levels  # noqa: E402

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


def reference_gradients(params, cam):
    """Image, alpha, and the gradients of a random linear function of both; zeros for shN of degree 0."""
    gi, ga = weights(cam)
    image, alpha, _ = rasterize_reference(*params, cam, BACKGROUND)
    value = (image * gi.to(image.dtype)).sum() + (alpha * ga.to(image.dtype)).sum()
    grads = torch.autograd.grad(value, params, allow_unused=True)
    return image, alpha, [torch.zeros_like(p) if g is None else g for p, g in zip(params, grads, strict=True)]


def backend_gradients(backend, params, cam):
    """`reference_gradients` by a backend, with its own image and alpha."""
    gi, ga = weights(cam)
    named = {n: p.detach().float() for n, p in zip(PARAMETERS, params, strict=True)}
    image, alpha = backend.render(named, cam, BACKGROUND)
    grads = backend.backpropagate(named, cam, BACKGROUND, lambda *_: (gi.numpy(), ga.numpy()))
    return torch.from_numpy(image), torch.from_numpy(alpha), [torch.from_numpy(g) for g in grads.values()]


@pytest.mark.parametrize("simd", simd_levels())
@pytest.mark.parametrize("k", [0, 3, 8, 15])
def test_picture_and_gradients_match_the_torch_reference(simd, k):
    cam, exact = camera(), scene(k=k)
    want_image, want_alpha, want = reference_gradients(exact, cam)
    image, alpha, got = backend_gradients(CpuBackend(simd=simd), exact, cam)
    assert (image - want_image).abs().max() < 1e-5
    assert (alpha - want_alpha).abs().max() < 1e-5
    for name, g, w in zip(PARAMETERS, got, want, strict=True):
        assert (g - w).norm() <= 1e-4 * w.norm(), name


def test_gaussians_beyond_the_field_of_view_match_the_reference():
    # Wide Gaussians with centres beyond the clamp of the Jacobian, some nearer than the near plane.
    cam, exact = camera(), scene(n=60, k=3, log_scale=-0.8)
    with torch.no_grad():
        exact[0][:, :2].mul_(6)
        exact[0][::9, 2] = -2.6
        exact[3].sub_(1.0)
    want_image, _, want = reference_gradients(exact, cam)
    image, _, got = backend_gradients(CpuBackend(), exact, cam)
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

    _, _, grads = reference_gradients(params, cam)
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
    cam = camera(203, 150)  # not a multiple of the tile size
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
        view = TargetView(cam, target, target[..., 0], BACKGROUND, ((1, 0.9, 1.1), (0, 0.1, 0)))
        r = CpuBackend(threads).photometric_loss(params, [view], LossWeights(mask=0.1))
        results.append([r.loss, r.grad_exposure, *r.grads.values(), *(getattr(r, s) for s in STATISTICS)])
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
    backend = CpuBackend(simd=simd)
    image, alpha = backend.render(params, cam, BACKGROUND)
    assert np.isfinite(alpha).all()
    assert alpha.min() >= 0
    assert alpha.max() <= 1
    backend.photometric_loss(params, [TargetView(cam, target, None, BACKGROUND)])
    if not np.isfinite(values).all():  # non-finite Gaussians are dropped whole
        bad = ~np.all([np.isfinite(p.reshape(len(p), -1)).all(1) for p in params.values()], axis=0)
        want, _ = backend.render({n: p[~bad] for n, p in params.items()}, cam, BACKGROUND)
        np.testing.assert_array_equal(image, want)


def test_extreme_scenes():
    backend, cam = CpuBackend(), camera()
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
        r = backend.photometric_loss(params, [TargetView(cam, target, None, BACKGROUND)])
        assert np.isfinite(r.loss)
        assert all(np.isfinite(v).all() for v in r.grads.values())
    assert (render_image(behind, cam, (0.5, 0.5, 0.5)) == 128).all()


def test_step_is_the_sum_of_its_parts():
    cam, ssim_lambda, mask_lambda = camera(), 0.2, 0.3
    rng = np.random.default_rng(2)
    rgb = rng.integers(0, 256, (cam.height, cam.width, 3), np.uint8)
    mask = rng.integers(0, 256, (cam.height, cam.width), np.uint8)
    params = scene(k=3)
    gain = torch.tensor([1.1, 0.9, 1.0], dtype=torch.float64, requires_grad=True)
    offset = torch.tensor([0.05, -0.02, 0.0], dtype=torch.float64)
    black, alpha, _ = rasterize_reference(*params, cam)
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    image = gain * black + (1 - alpha)[..., None] * (background - offset)  # less the offset, as the target
    a = torch.from_numpy(mask) / 255.0
    target = torch.from_numpy(rgb) / 255.0 * a[..., None] + (1 - a)[..., None] * background - offset
    loss = image_loss_reference(image, target, ssim_lambda)
    loss = loss + mask_lambda * (alpha - a).abs().mean()
    want = torch.autograd.grad(loss, [*params, gain])
    named = {k: p.detach().float() for k, p in zip(PARAMETERS, params, strict=True)}
    view = TargetView(cam, rgb, mask, BACKGROUND, (gain.tolist(), offset.tolist()))
    r = CpuBackend().photometric_loss(named, [view], LossWeights(ssim_lambda, mask_lambda))
    assert r.loss == pytest.approx(loss.item(), rel=1e-5)
    for w, (name, g) in zip(want, r.grads.items(), strict=False):
        assert (g - w).norm() <= 1e-3 * w.norm(), name
    np.testing.assert_allclose(r.grad_exposure[0, 0], want[-1].numpy(), rtol=1e-4)


def test_batch_is_the_sum_of_its_views():
    cam, g = camera(), dense(300)
    params = {k: getattr(g, k) for k in PARAMETERS}
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (cam.height, cam.width, 3), np.uint8)
    other = replace(cam, viewmat=cam.viewmat @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    views = [
        TargetView(cam, rgb, 255 - rgb[..., 0], BACKGROUND),
        TargetView(cam, rgb, None, BACKGROUND, ((1.1, 0.9, 1.0), (0, 0, 0))),
        TargetView(other, rgb),
    ]
    batch = CpuBackend().photometric_loss(params, views)
    single = [CpuBackend().photometric_loss(params, [view]) for view in views]
    assert batch.loss == pytest.approx(sum(s.loss for s in single))
    assert CpuBackend().photometric_loss_value(params, views) == batch.loss
    for name in PARAMETERS:
        total = sum(np.asarray(s.grads[name], np.float64) for s in single)
        assert np.abs(total).max() > 0
        np.testing.assert_allclose(batch.grads[name], total, rtol=1e-5, atol=1e-6 * np.abs(total).max())
    for name in ("max_weight", "radii"):
        np.testing.assert_array_equal(getattr(batch, name), np.max([getattr(s, name) for s in single], 0))
    np.testing.assert_array_equal(batch.grad_exposure, [s.grad_exposure[0] for s in single])
    with pytest.raises(UsageError, match="at least one view"):
        CpuBackend().photometric_loss(params, [])


def test_8_bit_image_is_the_float_image_rounded():
    cam, g = camera(203, 150), dense()
    params = tuple(getattr(g, k) for k in PARAMETERS)
    image, _ = Workspace().forward(params, cam, BACKGROUND)
    want = np.floor(np.clip(image, 0, 1) * 255 + 0.5)
    np.testing.assert_array_equal(render_image(g, cam, BACKGROUND), want)


def test_turned_harmonics_are_seen_as_if_their_coefficients_were_turned():
    """Picture and gradients; gradients are by the coefficients before the rotation."""
    cam, params = camera(), {n: p.detach().float().numpy() for n, p in zip(PARAMETERS, scene(), strict=True)}
    turns = np.random.default_rng(0).normal(size=(len(params["means"]), 4)).astype(np.float32)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    turned = {**params, "shN": turned_harmonics(params["shN"], turns)}
    pixels = lambda image, alpha: (np.sin(9 * image), np.cos(7 * alpha))  # noqa: E731
    found, expected = (
        CpuBackend().backpropagate(p, cam, BACKGROUND, pixels) for p in ({**params, TURNS: turns}, turned)
    )
    images = [CpuBackend().render(p, cam, BACKGROUND)[0] for p in ({**params, TURNS: turns}, turned, params)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-5)
    assert np.abs(images[0] - images[2]).max() > 0.01
    expected["shN"] = turned_harmonics(expected["shN"], turns, back=True)
    for name in PARAMETERS:
        size = np.abs(expected[name]).max()
        np.testing.assert_allclose(found[name], expected[name], atol=1e-4 * size, err_msg=name)


def test_statistics():
    cam, params = camera(), {n: p.detach().float() for n, p in zip(PARAMETERS, scene(), strict=True)}
    black = np.zeros((cam.height, cam.width, 3), np.uint8)
    by_colour = LossWeights(ssim=0.0)  # its gradient: 1 / pixels
    found = CpuBackend().photometric_loss(params, [TargetView(cam, black)], by_colour)
    _, _, want = rasterize_reference(*scene(), cam)
    assert ((found.max_weight > 0) == (want > 0).numpy()).all()
    assert (found.max_weight <= 0.999).all()
    assert (found.grad2d[want > 0] > 0).all()


def test_an_image_leaves_nothing_behind_for_the_next():
    cam, other, params = camera(), camera(80, 30), scene()
    backend = CpuBackend()
    alone = [g.clone() for g in backend_gradients(CpuBackend(), params, cam)[2]]
    backend_gradients(backend, scene(n=70, k=3), other)
    for a, b in zip(alone, backend_gradients(backend, params, cam)[2], strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_wrong_arguments_are_named():
    cam, g = camera(), dense(10)
    params = [getattr(g, k) for k in PARAMETERS]
    with pytest.raises(UsageError, match="quats has 39 values, expected 40"):
        Workspace().forward((params[0], params[1].reshape(-1)[:-1], *params[2:]), cam, BACKGROUND)
    with pytest.raises(UsageError, match="length 6"):
        Workspace().forward((*params, params[1], params[1]), cam, BACKGROUND)
    with pytest.raises(UsageError, match="turns has 30 values, expected 40"):
        Workspace().forward((*params, params[0]), cam, BACKGROUND)
    with pytest.raises(UsageError, match="an image of 0 x 3 pixels is empty"):
        render_image(g, Camera("c", cam.K, cam.viewmat, 0, 3))
    with pytest.raises(UsageError, match='simd "neon9" is not available'):
        Workspace(simd="neon9")
    with pytest.raises(LimitError, match="more than 16384 pixels on a side"):
        render_image(g, Camera("c", cam.K, cam.viewmat, 20000, 10))
    with pytest.raises(UsageError, match="distortion"):
        render_image(g, Camera("c", cam.K, cam.viewmat, 61, 45, np.array([0.1])))

"""Training kernels against their plain references: image loss, Adam and its surgery, trajectories, hash grid."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from gscodec import _native  # noqa: E402
from gscodec.errors import UsageError  # noqa: E402
from gscodec.model.camera import Camera  # noqa: E402
from gscodec.render.backend import LossWeights, TargetView  # noqa: E402
from gscodec.render.cpu import CpuBackend  # noqa: E402
from gscodec.render.optimizer import Adam, AdamSettings, TrajectoryAdam  # noqa: E402
from gscodec.render.reference import image_loss_reference  # noqa: E402
from gscodec.train.entropy_model import laplace_bits  # noqa: E402
from gscodec.train.hash_grid import HashGrid  # noqa: E402
from gscodec.train.model import Model  # noqa: E402


def image_loss(image, target, ssim_lambda=0.2):
    """Loss of the native kernel and its gradient by `image`."""
    arrays = [t.detach().float().numpy() for t in (image, target)]
    loss, *_, grad = _native.image_loss(*arrays, ssim_lambda)
    return loss, torch.from_numpy(grad).reshape(image.shape)


# 7 x 5 is smaller than the window, 150 wide no multiple of any vector, 300 wide needs several strips.
@pytest.mark.parametrize("size", [(7, 5), (45, 61), (130, 150), (40, 300)])
def test_image_loss_and_gradient_match_the_reference(size):
    g = torch.Generator().manual_seed(1)
    exact = torch.rand(*size, 3, generator=g, dtype=torch.float64).requires_grad_()
    target = exact.detach() + 0.2 * torch.randn(*size, 3, generator=g, dtype=torch.float64)
    want = image_loss_reference(exact, target, 0.3)
    (want_grad,) = torch.autograd.grad(want, exact)
    got, grad = image_loss(exact, target, 0.3)
    assert abs(got - want.item()) < 1e-5
    assert (grad - want_grad).norm() < 1e-4 * want_grad.norm()


def test_image_loss_of_equal_images_is_zero():
    image = torch.rand(20, 30, 3)
    loss, grad = image_loss(image, image)
    assert abs(loss) < 1e-6
    assert grad.abs().max() < 1e-6


def test_image_loss_of_local_differences_matches_the_reference():
    # Mostly equal images: the kernels must skip equal pixels only.
    g = torch.Generator().manual_seed(3)
    target = torch.rand(90, 400, 3, generator=g, dtype=torch.float64)
    exact = target.clone()
    for y, x in ((0, 0), (37, 131), (38, 290), (60, 5), (89, 399)):
        exact[y, x] += 0.3
    exact.requires_grad_()
    want = image_loss_reference(exact, target, 0.5)
    (want_grad,) = torch.autograd.grad(want, exact)
    got, grad = image_loss(exact, target, 0.5)
    assert abs(got - want.item()) < 1e-6
    # the sign of L1 where the images are equal is 0 here; torch agrees
    assert (grad - want_grad).norm() < 1e-4 * want_grad.norm()


def test_image_loss_shows_nan():
    image = torch.zeros(20, 30, 3)
    image[3, 4, 1] = float("nan")
    assert np.isnan(image_loss(image, torch.zeros(20, 30, 3))[0])


def test_image_loss_names_wrong_shapes():
    with pytest.raises(ValueError, match="target has 36 values, expected 48"):
        image_loss(torch.zeros(4, 4, 3), torch.zeros(3, 4, 3))


def test_adam_is_that_of_torch():
    g = torch.Generator().manual_seed(4)
    shapes = {"means": (1001, 3), "quats": (1001, 4), "log_scales": (1001, 3), "logit_opacities": (1001,)}
    shapes |= {"sh0": (1001, 3), "shN": (1001, 0, 3)}
    model = Model({n: torch.randn(s, generator=g) for n, s in shapes.items()})
    want = {n: p.clone().requires_grad_() for n, p in model.params.items() if p.numel()}
    rates = {n: 0.01 * (i + 1) for i, n in enumerate(model.params)}
    a = AdamSettings()
    groups = [{"params": [p], "lr": rates[n]} for n, p in want.items()]
    optimizer = torch.optim.Adam(groups, betas=(a.beta1, a.beta2), eps=a.eps)
    model.start_optimizer(CpuBackend(), a)
    for step in range(5):
        grads = {n: torch.randn(p.shape, generator=g) * 10.0 ** -(3 * step) for n, p in model.params.items()}
        for n, p in want.items():
            p.grad = grads[n].clone()
        optimizer.step()
        model.step(grads, rates)
    for n, p in want.items():
        torch.testing.assert_close(model.params[n], p.detach(), rtol=1e-5, atol=1e-6)


def test_adam_counts_the_steps_of_each_array():
    """An array that joins late is corrected for its own first steps, as torch does it."""
    arrays = {"early": np.ones(3, np.float32), "late": np.ones(3, np.float32)}
    want = {n: torch.ones(3, requires_grad=True) for n in arrays}
    adam, a = Adam(CpuBackend(), AdamSettings()), AdamSettings()
    optimizer = torch.optim.Adam(list(want.values()), lr=0.1, betas=(a.beta1, a.beta2), eps=a.eps)
    for step in range(4):
        names = ["early", "late"] if step > 1 else ["early"]
        for n, p in want.items():
            p.grad = torch.full((3,), step - 0.7) if n in names else None
        optimizer.step()
        grads = {n: np.full(3, step - 0.7, np.float32) for n in names}
        adam.step(arrays, grads, dict.fromkeys(names, 0.1))
    for n, p in want.items():
        np.testing.assert_allclose(arrays[n], p.detach(), rtol=1e-5)


def test_adam_follows_rows_that_come_and_go():
    """Kept rows move as if no others were added or removed; new rows start with zero moments."""
    rng = np.random.default_rng(0)
    settings, start, grads = AdamSettings(), rng.normal(size=(6, 3, 2)), rng.normal(size=(3, 6, 3, 2))
    start, grads = start.astype(np.float32), grads.astype(np.float32)
    alone, whole = Adam(CpuBackend(), settings), start.copy()
    for g in grads:
        alone.step({"x": whole}, {"x": g}, {"x": 0.1})
    adam, x = Adam(CpuBackend(), settings), start.copy()
    adam.step({"x": x}, {"x": grads[0]}, {"x": 0.1})
    kept = np.array([4, 1])
    x = x[kept]
    adam.select(kept)
    adam.step({"x": x}, {"x": grads[1][kept]}, {"x": 0.1})
    x = np.concatenate([x, np.zeros((1, 3, 2), np.float32)])
    adam.append(1)
    adam.step({"x": x}, {"x": np.concatenate([grads[2][kept], np.zeros((1, 3, 2), np.float32)])}, {"x": 0.1})
    np.testing.assert_array_equal(x[:2], whole[kept])
    np.testing.assert_array_equal(x[2], 0)
    adam.resize("x", 1)
    x = np.ascontiguousarray(x[:, :1])
    adam.step({"x": x}, {"x": np.ones_like(x)}, {"x": 0.1})
    adam.restart()
    before = x.copy()
    adam.step({"x": x}, {"x": np.ones_like(x)}, {"x": 0.1})
    np.testing.assert_allclose(before - x, 0.1, rtol=1e-4)


# 4 levels: two dense, two hashed.
@pytest.mark.parametrize("features", [1, 2, 4, 8])
def test_hash_grid_and_gradients_match_the_reference(features):
    g = torch.Generator().manual_seed(2)
    grid = HashGrid(4, features, 11, 5, 60)
    assert [(c + 1) ** 3 <= 2048 for c in grid.cells] == [True, True, False, False]
    torch.nn.init.normal_(grid.table, generator=g)
    exact = torch.rand(500, 3, generator=g, dtype=torch.float64)
    exact[0], exact[1], exact[2] = 0.0, 1.0, torch.tensor([-0.5, 0.3, 1.7])
    grad_out = torch.randn(500, 4 * features, generator=g, dtype=torch.float64)
    exact.requires_grad_()
    want = grid.reference(exact)
    want_points, want_table = torch.autograd.grad((want * grad_out).sum(), [exact, grid.table])
    points = exact.detach().float().requires_grad_()
    got = grid(points)
    grad_points, grad_table = torch.autograd.grad((got * grad_out.float()).sum(), [points, grid.table])
    assert (got - want).abs().max() < 1e-4
    assert (grad_table - want_table).norm() < 1e-5 * want_table.norm()
    # a point on a cell's border may be given to either side; the ends of [0, 1] are such borders
    assert (grad_points - want_points)[2:].norm() < 1e-4 * want_points.norm()


def test_hash_grid_is_deterministic_and_survives_poison():
    grid = HashGrid()
    points = torch.rand(3000, 3)
    points[::7] = float("nan")
    points[::11] = 1e30
    grads = [torch.autograd.grad(grid(points).square().sum(), grid.table)[0] for _ in range(2)]
    assert torch.equal(*grads)
    assert torch.isfinite(grads[0]).all()
    assert grid(torch.zeros(0, 3)).shape == (0, 64)


def test_hash_grid_names_wrong_sizes():
    with pytest.raises(UsageError, match="features of the hash grid"):
        HashGrid(features=3)
    with pytest.raises(UsageError, match=r"expected \[N, 3\]"):
        HashGrid()(torch.zeros(3, 4))


def test_trajectory_step_is_that_of_torch():
    """Value, step and bits of the coefficients against plain torch; the rounding lets gradients through."""
    rng = np.random.default_rng(0)
    coefficients = rng.normal(0, 2, (3, 50, 3)).astype(np.float32)
    at, scales = np.array([0.5, -0.3, 0.1], np.float32), np.array([0.4, 1.0, 3.0], np.float32)
    grad = rng.normal(size=(50, 3)).astype(np.float32)
    noise = rng.random(50 * 3 + 3, np.float32) - np.float32(0.5)
    shown = CpuBackend().trajectory_sum(coefficients, at, 0.1)
    rounded_ = np.sign(coefficients) * np.rint(np.maximum(np.abs(coefficients) - 0.1, 0))
    np.testing.assert_allclose(shown, np.tensordot(at, rounded_, 1), atol=1e-5)

    leaf, log_scales = torch.from_numpy(coefficients.copy()).requires_grad_(), torch.from_numpy(np.log(scales))
    log_scales = log_scales[:, None, None].requires_grad_()
    shifted = torch.from_numpy(np.stack([noise[k : k + 150].reshape(50, 3) for k in range(3)]))
    bits = laplace_bits(leaf + shifted, log_scales)
    loss = (torch.from_numpy(at)[:, None, None] * leaf * torch.from_numpy(grad)).sum() + 0.2 * bits.sum()
    loss.backward()
    first, second = leaf.grad.numpy(), at[:, None, None] * grad  # gradients of two steps, the second without rate term
    variance = np.array([(g * g).mean(0) for g in (first, second)])  # mean over the three coefficients
    wanted = coefficients - 0.1 * first / np.sqrt(variance[0])
    adam = TrajectoryAdam(CpuBackend(), AdamSettings(eps=1e-8))
    of_each = adam.step("means", coefficients, grad, at, (0.2, scales, noise), 0.1)
    np.testing.assert_allclose(coefficients, wanted, atol=1e-4)
    np.testing.assert_allclose(of_each[:, 0], bits.sum((1, 2)).detach().numpy(), rtol=1e-4)
    np.testing.assert_allclose(0.2 * of_each[:, 1], log_scales.grad.flatten().numpy(), rtol=1e-3, atol=1e-3)
    adam.step("means", coefficients, grad, at, None, 0.1)
    moment = (0.09 * first + 0.1 * second) / (1 - 0.9**2)
    variance = (0.0099 * variance[0] + 0.01 * variance[1]) / (1 - 0.99**2)
    np.testing.assert_allclose(coefficients, wanted - 0.1 * moment / np.sqrt(variance), atol=1e-4)


def test_offset_of_a_camera_is_added_to_the_light_of_the_gaussians():
    """The loss for a picture brightened by gain and offset, and its gradients by both."""
    g = torch.Generator().manual_seed(5)
    params = {
        "means": 0.3 * torch.randn(30, 3, generator=g),
        "quats": torch.randn(30, 4, generator=g),
        "log_scales": torch.full((30, 3), -2.0),
        "logit_opacities": torch.randn(30, generator=g),
        "sh0": torch.randn(30, 3, generator=g),
        "shN": torch.zeros(30, 0, 3),
    }
    camera = Camera("a", np.array([[60, 0, 32], [0, 60, 32], [0, 0, 1.0]]), np.eye(4), 64, 64)
    camera.viewmat[2, 3] = 2.5
    backend, background, exposure = CpuBackend(), (0.2, 0.3, 0.9), ([1.2, 0.9, 1.0], [0.05, -0.02, 0.1])
    image, alpha = backend.render(params, camera, (0, 0, 0))
    seen = np.float32(exposure[0]) * image + alpha[..., None] * np.float32(exposure[1])
    rgb = np.rint(255 * (seen / np.maximum(alpha, 1e-3)[..., None]).clip(0, 1)).astype(np.uint8)
    target = (rgb, np.rint(255 * alpha).astype(np.uint8), background)

    def loss(gain, offset):
        return backend.photometric_loss(params, [TargetView(camera, *target, (gain, offset))], LossWeights(ssim=0.0))

    right, plain = loss(*exposure), loss([1] * 3, [0] * 3)
    assert right.loss < 0.1 * plain.loss
    for which in (0, 1):
        up, down = (np.array([np.ones(3), np.zeros(3)]) for _ in range(2))
        up[which, 0] += 0.01
        down[which, 0] -= 0.01
        slope = (loss(*up).loss - loss(*down).loss) / 0.02
        assert plain.grad_exposure[0, which, 0] == pytest.approx(slope, abs=2e-3)

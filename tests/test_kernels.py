"""Training kernels against their plain torch references: image loss, Adam, hash grid."""

import pytest

torch = pytest.importorskip("torch")

from bench.baselines.hashgrid import HashGrid  # noqa: E402
from gscodec.errors import UsageError  # noqa: E402
from gscodec.train.model import Model  # noqa: E402
from gscodec.train.settings import AdamSettings  # noqa: E402
from gscodec.train.ssim import image_loss, image_loss_reference  # noqa: E402


# 7 x 5 is smaller than the window, 150 wide no multiple of any vector, 300 wide needs several strips.
@pytest.mark.parametrize("size", [(7, 5), (45, 61), (130, 150), (40, 300)])
@pytest.mark.parametrize("weighted", [False, True])
def test_image_loss_and_gradient_match_the_reference(size, weighted):
    g = torch.Generator().manual_seed(1)
    exact = torch.rand(*size, 3, generator=g, dtype=torch.float64).requires_grad_()
    target = exact.detach() + 0.2 * torch.randn(*size, 3, generator=g, dtype=torch.float64)
    weight = torch.rand(*size, generator=g, dtype=torch.float64) if weighted else None
    want = image_loss_reference(exact, target, 0.3, weight)
    (want_grad,) = torch.autograd.grad(want, exact)
    image = exact.detach().float().requires_grad_()
    got = image_loss(image, target.float(), 0.3, None if weight is None else weight.float())
    (grad,) = torch.autograd.grad(2 * got, image)
    assert abs(got.item() - want.item()) < 1e-5
    assert (grad - 2 * want_grad).norm() < 1e-4 * want_grad.norm()


def test_image_loss_of_equal_images_is_zero():
    image = torch.rand(20, 30, 3).requires_grad_()
    loss = image_loss(image, image.detach(), 0.2)
    loss.backward()
    assert abs(loss.item()) < 1e-6
    assert image.grad.abs().max() < 1e-6


def test_image_loss_of_local_differences_matches_the_reference():
    # Mostly equal images: the kernels skip what is equal, and must not skip more.
    g = torch.Generator().manual_seed(3)
    target = torch.rand(90, 400, 3, generator=g, dtype=torch.float64)
    exact = target.clone()
    for y, x in ((0, 0), (37, 131), (38, 290), (60, 5), (89, 399)):
        exact[y, x] += 0.3
    weight = torch.rand(90, 400, generator=g, dtype=torch.float64)
    exact.requires_grad_()
    for w in (None, weight):
        want = image_loss_reference(exact, target, 0.5, w)
        (want_grad,) = torch.autograd.grad(want, exact)
        image = exact.detach().float().requires_grad_()
        got = image_loss(image, target.float(), 0.5, None if w is None else w.float())
        (grad,) = torch.autograd.grad(got, image)
        assert abs(got.item() - want.item()) < 1e-6
        # the sign of L1 where the images are equal is 0 here; torch agrees
        assert (grad - want_grad).norm() < 1e-4 * want_grad.norm()


def test_image_loss_shows_nan():
    image = torch.zeros(20, 30, 3)
    image[3, 4, 1] = float("nan")
    assert torch.isnan(image_loss(image, torch.zeros(20, 30, 3)))


def test_image_loss_names_wrong_shapes():
    with pytest.raises(UsageError, match=r"expected \[H, W, 3\]"):
        image_loss(torch.zeros(4, 4), torch.zeros(4, 4))
    with pytest.raises(UsageError, match="target has 36 values, expected 48"):
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
    for step in range(5):
        grads = {n: torch.randn(p.shape, generator=g) * 10.0 ** -(3 * step) for n, p in model.params.items()}
        for n, p in want.items():
            p.grad = grads[n].clone()
        optimizer.step()
        model.adam(grads, rates, a)
    for n, p in want.items():
        torch.testing.assert_close(model.params[n], p.detach(), rtol=1e-5, atol=1e-6)


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

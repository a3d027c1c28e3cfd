"""Training kernels against their plain torch references: image loss."""

import pytest

torch = pytest.importorskip("torch")

from gscodec.errors import UsageError  # noqa: E402
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


def test_image_loss_names_wrong_shapes():
    with pytest.raises(UsageError, match=r"expected \[H, W, 3\]"):
        image_loss(torch.zeros(4, 4), torch.zeros(4, 4))
    with pytest.raises(UsageError, match="target has 36 values, expected 48"):
        image_loss(torch.zeros(4, 4, 3), torch.zeros(3, 4, 3))

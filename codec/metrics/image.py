"""Image pairs -> PSNR, foreground PSNR, haze, SSIM. 8-bit sRGB in, decibels or 8-bit levels out.

The foreground is where the reference has alpha > 0, dilated by 8 px, so that a blurred outline counts and an empty
background does not raise the PSNR. The error outside of the foreground is haze, a measure of its own.
"""

from __future__ import annotations

import numpy as np

from ..errors import UsageError, require

PSNR_MAX = 100.0  # dB of equal images, so that means and JSON are finite
GROW = 8  # px by which the foreground is dilated


def _check(reference: np.ndarray, image: np.ndarray) -> None:
    if reference.shape != image.shape or reference.dtype != np.uint8 or image.dtype != np.uint8:
        raise UsageError(
            f"cannot compare {image.dtype} {image.shape} with the reference {reference.dtype} {reference.shape}, "
            "expected two uint8 images of one size"
        )


def psnr_of_mse(mse: float, peak: float = 255.0) -> float:
    """Decibels of a mean squared error, at most PSNR_MAX."""
    return PSNR_MAX if mse <= 0 else min(PSNR_MAX, float(10 * np.log10(peak**2 / mse)))


def psnr(reference: np.ndarray, image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR in dB of [H, W, 3] u8 images, or of the pixels in `mask` [H, W] bool; 100 where it is empty."""
    _check(reference, image)
    d = reference.astype(np.float32) - image
    d = d if mask is None else d[mask]
    return psnr_of_mse(float(np.mean(d**2, dtype=np.float64))) if d.size else PSNR_MAX


def psnr_corrected(reference: np.ndarray, image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """As `psnr`, after the gain and the offset of each channel that bring the image nearest to the reference: without
    the colour difference of one camera from all others."""
    _check(reference, image)
    y, x = (a.reshape(-1, 3) if mask is None else a[mask] for a in (reference, image))
    if not len(x):
        return PSNR_MAX
    x, y = x.astype(np.float64), y.astype(np.float64)
    from_mean, wanted = x - x.mean(0), y - y.mean(0)
    gain = (from_mean * wanted).sum(0) / np.maximum((from_mean**2).sum(0), 1e-9)
    return psnr_of_mse(float(np.mean((gain * from_mean - wanted) ** 2)))


def foreground(alpha: np.ndarray, grow: int = GROW) -> np.ndarray:
    """[H, W] bool: where alpha ([H, W], any scale) is above 0, dilated by a disc of radius `grow`."""
    cv2 = require("cv2", "measuring the foreground")
    disc = np.hypot(*np.mgrid[-grow : grow + 1, -grow : grow + 1]) <= grow
    return cv2.dilate((alpha > 0).astype(np.uint8), disc.astype(np.uint8)).astype(bool)


def psnr_fg(reference: np.ndarray, image: np.ndarray, alpha: np.ndarray | None) -> float:
    """PSNR of the foreground; of the whole image where the reference has no alpha."""
    return psnr(reference, image, None if alpha is None else foreground(alpha))


def haze(reference: np.ndarray, image: np.ndarray, alpha: np.ndarray | None) -> float:
    """Mean absolute error outside the foreground in 8-bit levels; 0 where there is no outside."""
    _check(reference, image)
    outside = np.zeros(reference.shape[:2], bool) if alpha is None else ~foreground(alpha)
    d = np.abs(reference.astype(np.int16) - image)[outside]
    return float(d.mean()) if d.size else 0.0


def ssim(reference: np.ndarray, image: np.ndarray) -> float:
    """SSIM of Wang et al. 2004 (Gaussian window, sigma 1.5), mean over the channels, by scikit-image."""
    _check(reference, image)
    if min(reference.shape[:2]) < 11:
        raise UsageError(f"SSIM needs images of at least 11x11 pixels, got {reference.shape[1]}x{reference.shape[0]}")
    metrics = require("skimage.metrics", "SSIM")
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255}
    return float(metrics.structural_similarity(reference, image, channel_axis=2, **options))

"""Quality and rate: measures of images and of rate-distortion curves, and the evaluations of `gscodec eval`."""

from .bd_rate import bd_rate, rising
from .codec_cameras import codec_cameras
from .evaluate import evaluate_capture, evaluate_splats
from .image import foreground, haze, psnr, psnr_corrected, psnr_fg, ssim
from .stability import TemporalMeter
from .vmaf import VmafMeter

__all__ = [
    "TemporalMeter",
    "VmafMeter",
    "bd_rate",
    "codec_cameras",
    "evaluate_capture",
    "evaluate_splats",
    "foreground",
    "haze",
    "psnr",
    "psnr_corrected",
    "psnr_fg",
    "rising",
    "ssim",
]

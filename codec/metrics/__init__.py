"""Quality and rate: images in, figures out, and the evaluations that `gscodec eval` prints."""

from gscodec.metrics.bd_rate import bd_rate, rising
from gscodec.metrics.codec_cameras import codec_cameras
from gscodec.metrics.evaluate import evaluate_capture, evaluate_splats
from gscodec.metrics.image import foreground, haze, psnr, psnr_fg, ssim
from gscodec.metrics.stability import TemporalMeter
from gscodec.metrics.vmaf import VmafMeter

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
    "psnr_fg",
    "rising",
    "ssim",
]

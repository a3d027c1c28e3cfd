"""gscodec: a streaming volumetric-video codec on dynamic Gaussian splats."""

__version__ = "0.1.0"

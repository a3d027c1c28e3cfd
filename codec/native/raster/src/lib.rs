//! Rasterizer, SSIM and hash-grid kernels.

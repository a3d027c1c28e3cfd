//! CPU rasterizer and training kernels: Gaussians and a view -> image, and gradients back; image loss; Adam; hash grid.
//!
//! Forward: scene -> soa -> project (ewa) -> sort -> tile_binning -> tile_passes (forward) -> framebuffer. Backward:
//! adjoint -> tile_passes (backward) -> project_backward.
//!
//! `simd` is the only place with `unsafe`. This crate never sees bytes of a stream; its inputs may be floats of any
//! value.

// Kernels index several arrays in step; iterators over some of them would hide that.
#![allow(clippy::needless_range_loop)]

mod adam;
mod adjoint;
mod backward;
mod bands;
mod clock;
pub mod constants;
mod ellipse;
mod error;
mod ewa;
mod forward;
mod framebuffer;
mod hashgrid;
mod image_pair;
mod loss;
mod parallel;
mod project;
mod project_backward;
mod projected;
mod rasterizer;
mod scene;
mod sh;
mod simd;
mod size;
mod soa;
mod sort;
mod ssim;
mod ssim_window;
mod step;
mod tile;
mod tile_binning;
mod tile_passes;
mod tile_rect;
pub mod trajectory;

pub use adam::Adam;
pub use bands::{Band, Bands, ends as band_ends};
pub use error::RasterError;
pub use framebuffer::Surface;
pub use hashgrid::HashGrid;
pub use image_pair::Pair;
pub use loss::{ImageLoss, LossValue};
pub use projected::Projected;
pub use rasterizer::{Rasterizer, Timings};
pub use scene::{Background, Gradients, Splats, View};
pub use simd::SimdLevel;
pub use size::Size;
pub use step::{Lambdas, Step, StepValue, TargetImage};

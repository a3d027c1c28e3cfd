//! CPU rasterizer and training kernels: Gaussians + view -> image, and gradients back; image loss; hash grid.
//!
//! scene -> soa -> project -> sort -> tile_binning -> forward (tiles) -> framebuffer; backward (tiles) -> project_backward (Gaussians).
//! `simd` is the only place with `unsafe`. This crate never sees bytes of a stream: everything here may be fed floats of any value.

// Kernels index several arrays in step; iterators over some of them would hide that.
#![allow(clippy::needless_range_loop)]

mod adam;
mod backward;
mod bands;
mod clock;
pub mod constants;
mod forward;
mod framebuffer;
mod hashgrid;
mod loss;
mod parallel;
mod project;
mod project_backward;
mod rasterizer;
mod scene;
mod sh;
mod simd;
mod soa;
mod sort;
mod ssim;
mod step;
mod tile;
mod tile_binning;

pub use adam::Adam;
pub use bands::{Band, Bands};
pub use framebuffer::Surface;
pub use hashgrid::HashGrid;
pub use loss::{ImageLoss, LossValue, Pair};
pub use project::Projected;
pub use rasterizer::{Rasterizer, Timings};
pub use scene::{Background, Gradients, RasterError, Region, Splats, View};
pub use simd::SimdLevel;
pub use step::{Lambdas, Step, StepValue, TargetImage};

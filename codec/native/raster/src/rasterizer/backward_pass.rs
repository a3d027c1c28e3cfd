//! The backward pass of the rasterizer: gradient of the image -> sums over the pixels of each pair -> gradients of the
//! Gaussians.

use super::{Rasterizer, SHARE};
use crate::adjoint::Pixels;
use crate::backward::Sums;
use crate::clock::Clock;
use crate::error::{RasterError, check_length};
use crate::ewa::Lens;
use crate::parallel::parallel_for;
use crate::project_backward::project_backward;
use crate::scene::{Gradients, Splats};
use crate::tile_passes::backward_tiles;

impl Rasterizer {
    /// Gradients of the last image rendered with `training`. `grad_image` [H, W, 3] and `grad_alpha` [H, W];
    /// `grad_depth` likewise where depth was rendered, or empty.
    ///
    /// # Errors
    /// Wrong lengths; no forward pass with `training` before.
    pub fn backward(
        &mut self,
        splats: &Splats,
        grad_image: &[f32],
        grad_alpha: &[f32],
        grad_depth: &[f32],
        out: &mut Gradients,
    ) -> Result<(), RasterError> {
        splats.check()?;
        self.run(|s| s.backward_here(splats, grad_image, grad_alpha, grad_depth, out))
    }

    pub(crate) fn backward_here(
        &mut self,
        splats: &Splats,
        grad_image: &[f32],
        grad_alpha: &[f32],
        grad_depth: &[f32],
        out: &mut Gradients,
    ) -> Result<(), RasterError> {
        out.check(splats)?;
        let Some((lens, size, background)) = self.drawn.take() else {
            return Err(RasterError::NothingRendered);
        };
        check_length(
            "gradient of the Gaussians rendered last",
            splats.len(),
            self.projected.len(),
        )?;
        check_length("gradient of the image", grad_image.len(), 3 * size.pixels())?;
        check_length("gradient of alpha", grad_alpha.len(), size.pixels())?;
        if !grad_depth.is_empty() {
            check_length("gradient of depth", grad_depth.len(), self.depth.len())?;
        }
        let start = Clock::start();
        self.sums.resize(self.bins.pairs.len(), Sums::ZERO);
        let pixels = Pixels {
            image: &self.image,
            alpha: &self.alpha,
            depth: &self.depth,
            grad_depth,
            grad_image,
            grad_alpha,
            width: size.width,
        };
        let (level, projected, seen) = (self.level, &self.projected, &self.seen);
        backward_tiles(level, projected, &self.bins, &pixels, background, seen, &mut self.sums);
        self.timings.backward_tiles = start.ms();
        let start = Clock::start();
        self.backward_gaussians(splats, &lens, out);
        self.timings.backward_project = start.ms();
        self.drawn = Some((lens, size, background));
        Ok(())
    }

    fn backward_gaussians(&self, splats: &Splats, lens: &Lens, out: &mut Gradients) {
        let n = splats.len();
        let out = out.reborrow();
        parallel_for(
            0..n,
            SHARE,
            out,
            &|g, range, middle| g.split_at(middle - range.start, splats.sh_k),
            &|range, mut out| project_backward(self.level, splats, lens, &self.bins, &self.sums, range, &mut out),
        );
    }
}

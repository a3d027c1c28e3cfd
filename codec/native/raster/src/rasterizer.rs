//! The rasterizer's workspace and the order of its passes: project, sort, bin, blend; backward: tiles, then Gaussians.
//!
//! All buffers are kept from picture to picture. Work is divided in ways that depend on the input only (16 pixel rows, 256
//! Gaussians), every piece owns what it writes, and sums over pairs have a fixed order: results do not depend on the threads.

use std::ops::Range;

use rayon::prelude::*;

use crate::backward::{Sums, backward};
use crate::bin::Bins;
use crate::clock::Clock;
use crate::divide::divide;
use crate::forward::{Canvas, forward};
use crate::picture::{Pixels, finish, finish_empty};
use crate::project::{Lens, Projected, TILE, project};
use crate::project_backward::{GradientRows, gather, project_backward};
use crate::scene::{Gradients, RasterError, Region, Splats, View, check_length, check_size};
use crate::simd::Level;
use crate::soa::CHUNK;
use crate::sort::DepthSort;

/// Gaussians of one task.
const SHARE: usize = 256;

/// Milliseconds of the last passes.
#[derive(Clone, Copy, Default, Debug)]
pub struct Timings {
    pub project: f64,
    pub bin: f64,
    pub blend: f64,
    pub backward_tiles: f64,
    pub backward_project: f64,
    pub loss: f64,
}

/// Colours around and on the Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shade {
    pub background: [f32; 3],
    /// Per-camera exposure: what the Gaussians send is multiplied by it, the background is not.
    pub gain: Option<[f32; 3]>,
}

impl Shade {
    pub fn over(background: [f32; 3]) -> Shade {
        Shade { background, gain: None }
    }
}

pub struct Rasterizer {
    level: Level,
    pool: Option<rayon::ThreadPool>,
    projected: Vec<Projected>,
    sort: DepthSort,
    bins: Bins,
    masks: Vec<u16>,
    sums: Vec<Sums>,
    pub(crate) image: Vec<f32>, // [H, W, 3] of the region
    pub(crate) alpha: Vec<f32>, // [H, W]
    drawn: Option<(Lens, Region, Shade)>,
    pub timings: Timings,
}

impl Rasterizer {
    /// `threads` 0: the threads of the process-wide pool.
    pub fn new(level: Level, threads: usize) -> Rasterizer {
        let pool = if threads == 0 {
            None
        } else {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok()
        };
        Rasterizer {
            level,
            pool,
            projected: Vec::new(),
            sort: DepthSort::default(),
            bins: Bins::default(),
            masks: Vec::new(),
            sums: Vec::new(),
            image: Vec::new(),
            alpha: Vec::new(),
            drawn: None,
            timings: Timings::default(),
        }
    }

    pub fn level(&self) -> Level {
        self.level
    }

    /// Of the last forward pass: [H, W, 3] and [H, W] of the region, and the ellipses.
    pub fn image(&self) -> &[f32] {
        &self.image
    }

    pub fn alpha(&self) -> &[f32] {
        &self.alpha
    }

    /// The last image as 8 bits, rounded and clamped.
    ///
    /// # Errors
    /// A length other than that of the image.
    pub fn bytes(&self, out: &mut [u8]) -> Result<(), RasterError> {
        check_length("8-bit image", out.len(), self.image.len())?;
        out.par_chunks_mut(1 << 14)
            .zip(self.image.par_chunks(1 << 14))
            .for_each(|(out, image)| {
                for (o, v) in out.iter_mut().zip(image) {
                    *o = (v.clamp(0.0, 1.0) * 255.0 + 0.5) as i32 as u8;
                }
            });
        Ok(())
    }

    pub fn projected(&self) -> &[Projected] {
        &self.projected
    }

    /// The first half of `forward` alone: the ellipses of `view`, to be drawn elsewhere (see `Bands`).
    ///
    /// # Errors
    /// As `forward`.
    pub fn project(&mut self, splats: &Splats, view: &View) -> Result<&[Projected], RasterError> {
        splats.check()?;
        view.check()?;
        let lens = Lens::new(view);
        self.drawn = None;
        self.run(|s| s.project_here(splats, &lens));
        Ok(&self.projected)
    }

    /// The second half of `forward` alone: `fill` gets those of the last call and sets the ellipses to draw on a picture of
    /// width x height, which must be what `project` made for one of that size.
    ///
    /// # Errors
    /// As `forward`.
    pub fn draw(
        &mut self,
        [width, height]: [usize; 2],
        shade: Shade,
        fill: impl FnOnce(&mut Vec<Projected>),
    ) -> Result<(), RasterError> {
        fill(&mut self.projected);
        let region = Region {
            x: 0,
            y: 0,
            width,
            height,
        };
        check_size(region, width, height)?;
        self.drawn = None;
        self.run(|s| s.draw_here(region, shade, false))
    }

    /// Runs `f` with this workspace in its own threads.
    pub(crate) fn run<R: Send>(&mut self, f: impl FnOnce(&mut Self) -> R + Send) -> R {
        match self.pool.take() {
            None => f(self),
            Some(pool) => {
                let result = pool.install(|| f(self));
                self.pool = Some(pool);
                result
            }
        }
    }

    /// Draws the view. `training` keeps what `backward` needs.
    ///
    /// # Errors
    /// Wrong lengths, an empty or too large view, too many Gaussian-tile pairs.
    pub fn forward(&mut self, splats: &Splats, view: &View, shade: Shade, training: bool) -> Result<(), RasterError> {
        splats.check()?;
        view.check()?;
        self.run(|s| s.forward_here(splats, view, shade, training))
    }

    pub(crate) fn forward_here(
        &mut self,
        splats: &Splats,
        view: &View,
        shade: Shade,
        training: bool,
    ) -> Result<(), RasterError> {
        let lens = Lens::new(view);
        self.drawn = None;
        self.project_here(splats, &lens);
        self.draw_here(view.region, shade, training)?;
        if training {
            self.drawn = Some((lens, view.region, shade));
        }
        Ok(())
    }

    fn project_here(&mut self, splats: &Splats, lens: &Lens) {
        let (level, start) = (self.level, Clock::start());
        self.projected.resize(splats.len(), Projected::default());
        self.projected.par_chunks_mut(SHARE).enumerate().for_each(|(i, out)| {
            project(level, splats, lens, i * SHARE, out);
        });
        self.timings.project = start.ms();
    }

    fn draw_here(&mut self, region: Region, shade: Shade, training: bool) -> Result<(), RasterError> {
        let start = Clock::start();
        let sorted = self.sort.sort(&self.projected);
        self.bins.build(&self.projected, sorted, region)?;
        self.timings.bin = start.ms();
        let start = Clock::start();
        self.masks.resize(if training { self.bins.pairs.len() } else { 0 }, 0);
        self.image.resize(3 * region.pixels(), 0.0);
        self.alpha.resize(region.pixels(), 0.0);
        self.blend(region, shade);
        self.timings.blend = start.ms();
        Ok(())
    }

    fn blend(&mut self, region: Region, shade: Shade) {
        let (level, bins, projected, width) = (self.level, &self.bins, &self.projected[..], region.width);
        let work = (&mut self.image[..], &mut self.alpha[..], &mut self.masks[..]);
        let cut = |(image, alpha, masks): (_, _, _), rows: &Range<usize>, middle: usize| {
            let pixels = (middle - rows.start) * TILE * width;
            let (image, image_rest) = <[f32]>::split_at_mut(image, 3 * pixels);
            let (alpha, alpha_rest) = <[f32]>::split_at_mut(alpha, pixels);
            let (masks, masks_rest) = cut_pairs(masks, bins, rows.start, middle);
            ((image, alpha, masks), (image_rest, alpha_rest, masks_rest))
        };
        divide(0..bins.rows, 1, work, &cut, &|row, (image, alpha, mut masks)| {
            for column in 0..bins.columns {
                let t = row.start * bins.columns + column;
                let range = bins.tile(t);
                let (own, rest) = masks.split_at_mut(range.len().min(masks.len()));
                masks = rest;
                let x = column * TILE;
                if range.is_empty() {
                    finish_empty(shade, x, width, image, alpha);
                    continue;
                }
                let mut canvas = Canvas::new(width - x, alpha.len() / width);
                let origin = [x as f32, (row.start * TILE) as f32];
                forward(
                    level,
                    projected,
                    &bins.pairs[range.start..],
                    range.len(),
                    origin,
                    &mut canvas,
                    own,
                );
                finish(&canvas, shade, x, width, image, alpha);
            }
        });
    }

    /// Gradients of the last training picture. `grad_image` [H, W, 3], `grad_alpha` [H, W] of the region.
    ///
    /// # Errors
    /// Wrong lengths, or no forward pass with `training` before.
    pub fn backward(
        &mut self,
        splats: &Splats,
        grad_image: &[f32],
        grad_alpha: &[f32],
        out: &mut Gradients,
    ) -> Result<(), RasterError> {
        splats.check()?;
        self.run(|s| s.backward_here(splats, grad_image, grad_alpha, out))
    }

    pub(crate) fn backward_here(
        &mut self,
        splats: &Splats,
        grad_image: &[f32],
        grad_alpha: &[f32],
        out: &mut Gradients,
    ) -> Result<(), RasterError> {
        out.check(splats)?;
        let Some((lens, region, shade)) = self.drawn.take() else {
            return Err(RasterError::NothingRendered);
        };
        check_length(
            "gradient of the Gaussians rendered last",
            splats.len(),
            self.projected.len(),
        )?;
        check_length("gradient of the image", grad_image.len(), 3 * region.pixels())?;
        check_length("gradient of alpha", grad_alpha.len(), region.pixels())?;
        let start = Clock::start();
        self.sums.resize(self.bins.pairs.len(), Sums::ZERO);
        self.backward_tiles(region.width, shade, grad_image, grad_alpha);
        self.timings.backward_tiles = start.ms();
        let start = Clock::start();
        self.backward_gaussians(splats, &lens, out);
        self.timings.backward_project = start.ms();
        self.drawn = Some((lens, region, shade));
        Ok(())
    }

    fn backward_tiles(&mut self, width: usize, shade: Shade, grad_image: &[f32], grad_alpha: &[f32]) {
        let (level, bins, projected, masks) = (self.level, &self.bins, &self.projected[..], &self.masks[..]);
        let pixels = Pixels {
            image: &self.image,
            alpha: &self.alpha,
            grad_image,
            grad_alpha,
            width,
        };
        let cut = |sums, rows: &Range<usize>, middle| cut_pairs(sums, bins, rows.start, middle);
        divide(
            0..bins.rows,
            1,
            &mut self.sums[..],
            &cut,
            &|row, mut sums: &mut [Sums]| {
                for column in 0..bins.columns {
                    let range = bins.tile(row.start * bins.columns + column);
                    let (own, rest) = sums.split_at_mut(range.len());
                    sums = rest;
                    if own.is_empty() {
                        continue;
                    }
                    let (x, y) = (column * TILE, row.start * TILE);
                    let mut adjoint = pixels.adjoint(x, y, shade);
                    let (pairs, masks) = (&bins.pairs[range.start..], &masks[range]);
                    backward(level, projected, pairs, [x as f32, y as f32], masks, &mut adjoint, own);
                }
            },
        );
    }

    fn backward_gaussians(&self, splats: &Splats, lens: &Lens, out: &mut Gradients) {
        let n = splats.len();
        let out = out.reborrow();
        divide(
            0..n,
            SHARE,
            out,
            &|g, range, middle| g.split_at(middle - range.start, splats.sh_k),
            &|range, mut out| {
                let mut rows = GradientRows::new();
                for first in range.clone().step_by(CHUNK) {
                    let n = CHUNK.min(range.end - first);
                    let (sums, seen) = gather(&self.bins, &self.sums, first, n);
                    project_backward(self.level, splats, lens, first, &sums, &mut rows);
                    rows.write(n, seen, &sums, first - range.start, splats.sh_k, &mut out);
                }
            },
        );
    }
}

/// The pairs of tile rows `first .. middle`, and the rest; nothing of nothing.
fn cut_pairs<'a, T>(pairs: &'a mut [T], bins: &Bins, first: usize, middle: usize) -> (&'a mut [T], &'a mut [T]) {
    let start = |row: usize| bins.starts[row * bins.columns] as usize;
    pairs.split_at_mut((start(middle) - start(first)).min(pairs.len()))
}

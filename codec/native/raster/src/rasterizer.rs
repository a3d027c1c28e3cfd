//! The rasterizer: its buffers and the order of the passes. Forward: project, sort, bin, blend; backward: tiles, then
//! Gaussians.
//!
//! All buffers are kept from image to image. Work is divided by the input only (16 pixel rows, 256 Gaussians), every
//! task owns the memory it writes, and sums over pairs have a fixed order: results do not depend on the threads.

mod backward_pass;

use std::mem::take;

use rayon::prelude::*;

use crate::backward::Sums;
use crate::clock::Clock;
use crate::error::RasterError;
use crate::ewa::Lens;
use crate::framebuffer::Surface;
use crate::project::project;
use crate::projected::Projected;
use crate::scene::{Background, MAX_PAIRS, Splats, View, check_size};
use crate::simd::SimdLevel;
use crate::size::Size;
use crate::sort::DepthSort;
use crate::tile::{BLOCKS, Hits};
use crate::tile_binning::TileBins;
use crate::tile_passes::blend_tiles;
use crate::tile_rect::TileRect;

/// Gaussians of one task.
const SHARE: usize = 256;

/// Gaussian-tile pairs that rendering may hold at a time, per Gaussian or in all; 8 bytes each. One tile needs at most
/// two entries per Gaussian, so halving the tiles always ends.
const PAIRS_EACH: usize = 8;
const PAIRS_FREE: usize = 1 << 20;

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

/// Renders and differentiates; one image at a time.
pub struct Rasterizer {
    level: SimdLevel,
    pool: Option<rayon::ThreadPool>,
    projected: Vec<Projected>,
    sort: DepthSort,
    bins: TileBins,
    seen: Vec<Hits>,
    sums: Vec<Sums>,
    pub(crate) image: Vec<f32>, // [H, W, 3]
    pub(crate) alpha: Vec<f32>, // [H, W]
    pub(crate) depth: Vec<f32>, // [H, W] sums of weight times depth, or empty
    drawn: Option<(Lens, Size, Background)>,
    pub timings: Timings,
}

impl Rasterizer {
    /// `threads` = 0: uses the threads of the process-wide pool.
    pub fn new(level: SimdLevel, threads: usize) -> Rasterizer {
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
            bins: TileBins::default(),
            seen: Vec::new(),
            sums: Vec::new(),
            image: Vec::new(),
            alpha: Vec::new(),
            depth: Vec::new(),
            drawn: None,
            timings: Timings::default(),
        }
    }

    pub fn level(&self) -> SimdLevel {
        self.level
    }

    /// [H, W, 3] by the last forward pass.
    pub fn image(&self) -> &[f32] {
        &self.image
    }

    /// [H, W] by the last forward pass.
    pub fn alpha(&self) -> &[f32] {
        &self.alpha
    }

    /// [H, W] by the last forward pass: weight times depth, summed over the Gaussians; empty if not asked for.
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// Bytes of all buffers.
    pub fn memory(&self) -> usize {
        let gaussians = size_of::<Projected>() * self.projected.capacity() + self.sort.memory();
        let pairs = size_of::<Hits>() * self.seen.capacity() + size_of::<Sums>() * self.sums.capacity();
        let planes = self.image.capacity() + self.alpha.capacity() + self.depth.capacity();
        gaussians + self.bins.memory() + pairs + 4 * planes
    }

    /// [N] the Gaussians after projection.
    pub fn projected(&self) -> &[Projected] {
        &self.projected
    }

    /// The first half of `forward` alone: projects the Gaussians of `view`, to be drawn elsewhere (see `Bands`).
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

    /// The second half of `forward` alone: draws projected Gaussians on an image of that size. `fill` gets the
    /// Gaussians of the last call and replaces them; they must come from `project` for an image of that size.
    ///
    /// # Errors
    /// As `paint`.
    pub fn draw(
        &mut self,
        surface: Surface,
        size: Size,
        background: Background,
        fill: impl FnOnce(&mut Vec<Projected>),
    ) -> Result<(), RasterError> {
        fill(&mut self.projected);
        check_size(size)?;
        surface.check(size)?;
        self.drawn = None;
        self.run(|s| s.draw_on(surface, size, background, false))
    }

    /// Renders the view onto a surface of the caller; `image` and `alpha` keep their values.
    ///
    /// # Errors
    /// As `forward`; a surface of another size.
    pub fn paint(
        &mut self,
        surface: Surface,
        splats: &Splats,
        view: &View,
        background: Background,
    ) -> Result<(), RasterError> {
        self.project(splats, view)?;
        surface.check(view.size)?;
        self.run(|s| s.draw_on(surface, view.size, background, false))
    }

    /// Runs `f` in the thread pool of this rasterizer.
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

    /// Renders the view. `training` keeps the inputs of `backward`; `depth`: renders depth, too.
    ///
    /// # Errors
    /// Wrong lengths, an empty or too large view, too many Gaussian-tile pairs.
    pub fn forward(
        &mut self,
        splats: &Splats,
        view: &View,
        background: Background,
        training: bool,
        depth: bool,
    ) -> Result<(), RasterError> {
        splats.check()?;
        view.check()?;
        self.run(|s| s.forward_here(splats, view, background, training, depth))
    }

    pub(crate) fn forward_here(
        &mut self,
        splats: &Splats,
        view: &View,
        background: Background,
        training: bool,
        depth: bool,
    ) -> Result<(), RasterError> {
        let lens = Lens::new(view);
        self.drawn = None;
        self.project_here(splats, &lens);
        let (mut image, mut alpha, mut depths) = (take(&mut self.image), take(&mut self.alpha), take(&mut self.depth));
        image.resize(3 * view.size.pixels(), 0.0);
        alpha.resize(view.size.pixels(), 0.0);
        depths.resize(if depth { view.size.pixels() } else { 0 }, 0.0);
        let surface = Surface::Floats {
            image: &mut image,
            alpha: &mut alpha,
            depth: &mut depths,
        };
        let drawn = self.draw_on(surface, view.size, background, training);
        (self.image, self.alpha, self.depth) = (image, alpha, depths);
        drawn?;
        if training {
            self.drawn = Some((lens, view.size, background));
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

    fn draw_on(
        &mut self,
        mut surface: Surface,
        size: Size,
        background: Background,
        training: bool,
    ) -> Result<(), RasterError> {
        let start = Clock::start();
        self.sort.sort(&self.projected);
        (self.timings.bin, self.timings.blend) = (start.ms(), 0.0);
        self.draw_tiles(&mut surface, TileRect::of(size), size, background, training)
    }

    /// Bins and blends a rectangle of tiles. If its pairs exceed the memory limit, both halves one after the other; not
    /// in training, where the backward pass needs all pairs.
    fn draw_tiles(
        &mut self,
        surface: &mut Surface,
        tiles: TileRect,
        size: Size,
        background: Background,
        training: bool,
    ) -> Result<(), RasterError> {
        let (start, halves) = (Clock::start(), tiles.halves());
        let limit = if training {
            MAX_PAIRS
        } else {
            (PAIRS_EACH * self.projected.len()).max(PAIRS_FREE)
        };
        let built = self
            .bins
            .build(&self.projected, self.sort.keys(), tiles, limit.min(MAX_PAIRS));
        self.timings.bin += start.ms();
        match (built, halves) {
            (Err(_), Some([first, second])) if !training => {
                self.draw_tiles(surface, first, size, background, training)?;
                return self.draw_tiles(surface, second, size, background, training);
            }
            (built, _) => built?,
        }
        let start = Clock::start();
        let batches = self.bins.batches(self.bins.tiles.len());
        self.seen.resize(if training { batches } else { 0 }, [0; BLOCKS]);
        let (level, projected, seen) = (self.level, &self.projected, &mut self.seen);
        blend_tiles(level, projected, &self.bins, size, background, surface, seen);
        self.timings.blend += start.ms();
        Ok(())
    }
}

#[cfg(test)]
mod tests;

//! The rasterizer's workspace and the order of its passes: project, sort, bin, blend; backward: tiles, then Gaussians.
//!
//! All buffers are kept from picture to picture. Work is divided in ways that depend on the input only (16 pixel rows, 256
//! Gaussians), every piece owns what it writes, and sums over pairs have a fixed order: results do not depend on the threads.

use std::mem::take;
use std::ops::Range;

use rayon::prelude::*;

use crate::backward::{Sums, backward};
use crate::clock::Clock;
use crate::forward::{Canvas, forward};
use crate::framebuffer::{Pixels, Surface, finish, finish_empty};
use crate::parallel::parallel_for;
use crate::project::{Lens, Projected, TILE, project};
use crate::project_backward::project_backward;
use crate::scene::{Background, Gradients, MAX_PAIRS, RasterError, Region, Splats, View, check_length, check_size};
use crate::simd::SimdLevel;
use crate::sort::DepthSort;
use crate::tile::{BLOCKS, Hits};
use crate::tile_binning::{TileBins, Tiles};

/// Gaussians of one task.
const SHARE: usize = 256;

/// Gaussian-tile pairs that a picture may take at a time, a Gaussian or in all; 8 bytes each. A tile alone needs at most two
/// entries a Gaussian, so that dividing the tiles always ends.
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

pub struct Rasterizer {
    level: SimdLevel,
    pool: Option<rayon::ThreadPool>,
    projected: Vec<Projected>,
    sort: DepthSort,
    bins: TileBins,
    seen: Vec<Hits>,
    sums: Vec<Sums>,
    pub(crate) image: Vec<f32>, // [H, W, 3] of the region
    pub(crate) alpha: Vec<f32>, // [H, W]
    drawn: Option<(Lens, Region, Background)>,
    pub timings: Timings,
}

impl Rasterizer {
    /// `threads` 0: the threads of the process-wide pool.
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
            drawn: None,
            timings: Timings::default(),
        }
    }

    pub fn level(&self) -> SimdLevel {
        self.level
    }

    /// Of the last forward pass: [H, W, 3] and [H, W] of the region, and the ellipses.
    pub fn image(&self) -> &[f32] {
        &self.image
    }

    pub fn alpha(&self) -> &[f32] {
        &self.alpha
    }

    /// Bytes of all buffers.
    pub fn memory(&self) -> usize {
        let gaussians = size_of::<Projected>() * self.projected.capacity() + self.sort.memory();
        let pairs = size_of::<Hits>() * self.seen.capacity() + size_of::<Sums>() * self.sums.capacity();
        gaussians + self.bins.memory() + pairs + 4 * (self.image.capacity() + self.alpha.capacity())
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
    /// As `paint`.
    pub fn draw(
        &mut self,
        surface: Surface,
        [width, height]: [usize; 2],
        background: Background,
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
        surface.check(region)?;
        self.drawn = None;
        self.run(|s| s.draw_on(surface, region, background, false))
    }

    /// Draws the view on a surface of the caller's; `image` and `alpha` stay what they are.
    ///
    /// # Errors
    /// As `forward`, or a surface of another size.
    pub fn paint(
        &mut self,
        surface: Surface,
        splats: &Splats,
        view: &View,
        background: Background,
    ) -> Result<(), RasterError> {
        self.project(splats, view)?;
        surface.check(view.region)?;
        self.run(|s| s.draw_on(surface, view.region, background, false))
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
    pub fn forward(
        &mut self,
        splats: &Splats,
        view: &View,
        background: Background,
        training: bool,
    ) -> Result<(), RasterError> {
        splats.check()?;
        view.check()?;
        self.run(|s| s.forward_here(splats, view, background, training))
    }

    pub(crate) fn forward_here(
        &mut self,
        splats: &Splats,
        view: &View,
        background: Background,
        training: bool,
    ) -> Result<(), RasterError> {
        let lens = Lens::new(view);
        self.drawn = None;
        self.project_here(splats, &lens);
        let (mut image, mut alpha) = (take(&mut self.image), take(&mut self.alpha));
        image.resize(3 * view.region.pixels(), 0.0);
        alpha.resize(view.region.pixels(), 0.0);
        let surface = Surface::Floats {
            image: &mut image,
            alpha: &mut alpha,
        };
        let drawn = self.draw_on(surface, view.region, background, training);
        (self.image, self.alpha) = (image, alpha);
        drawn?;
        if training {
            self.drawn = Some((lens, view.region, background));
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
        region: Region,
        background: Background,
        training: bool,
    ) -> Result<(), RasterError> {
        let start = Clock::start();
        self.sort.sort(&self.projected);
        (self.timings.bin, self.timings.blend) = (start.ms(), 0.0);
        self.draw_tiles(&mut surface, Tiles::of(region), region, background, training)
    }

    /// TileBins and blends a rectangle of tiles; in halves if that would take too much memory, but for training, which needs all
    /// pairs afterwards.
    fn draw_tiles(
        &mut self,
        surface: &mut Surface,
        tiles: Tiles,
        region: Region,
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
                self.draw_tiles(surface, first, region, background, training)?;
                return self.draw_tiles(surface, second, region, background, training);
            }
            (built, _) => built?,
        }
        let start = Clock::start();
        let batches = self.bins.batches(self.bins.tiles.len());
        self.seen.resize(if training { batches } else { 0 }, [0; BLOCKS]);
        self.blend(surface, region, background);
        self.timings.blend += start.ms();
        Ok(())
    }

    fn blend(&mut self, surface: &mut Surface, region: Region, background: Background) {
        let (level, bins, projected, width) = (self.level, &self.bins, &self.projected[..], region.width);
        let (top, left) = (bins.tiles.rows.start, bins.tiles.columns.start);
        let pixels = top * TILE * width..(bins.tiles.rows.end * TILE).min(region.height) * width;
        let work = (surface.part(pixels), &mut self.seen[..]);
        let (rows, columns) = (bins.tiles.rows.len(), bins.tiles.columns.len());
        parallel_for(
            0..rows,
            1,
            work,
            &|(band, seen), rows, middle| {
                let (band, band_rest) = band.split_at((middle - rows.start) * TILE * width);
                let (seen, seen_rest) = bins.cut(seen, rows.start, middle, TileBins::batches);
                ((band, seen), (band_rest, seen_rest))
            },
            &|row, (mut band, mut seen)| {
                let mut empty = left * TILE; // where the tiles without Gaussians begin that end here
                for column in 0..columns {
                    let t = row.start * columns + column;
                    let range = bins.tile(t);
                    let (own, rest) = bins.cut_tile(seen, t, TileBins::batches);
                    seen = rest;
                    let x = (left + column) * TILE;
                    if range.is_empty() {
                        continue;
                    }
                    finish_empty(background, empty..x, width, &mut band);
                    empty = x + TILE;
                    let mut canvas = Canvas::new(width - x, band.pixels() / width);
                    let origin = [x as f32, ((top + row.start) * TILE) as f32];
                    forward(
                        level,
                        projected,
                        &bins.pairs[range.start..],
                        range.len(),
                        origin,
                        &mut canvas,
                        own,
                    );
                    finish(&canvas, background, x, width, &mut band);
                }
                finish_empty(
                    background,
                    empty..((left + columns) * TILE).min(width),
                    width,
                    &mut band,
                );
            },
        );
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
        let Some((lens, region, background)) = self.drawn.take() else {
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
        self.backward_tiles(region.width, background, grad_image, grad_alpha);
        self.timings.backward_tiles = start.ms();
        let start = Clock::start();
        self.backward_gaussians(splats, &lens, out);
        self.timings.backward_project = start.ms();
        self.drawn = Some((lens, region, background));
        Ok(())
    }

    fn backward_tiles(&mut self, width: usize, background: Background, grad_image: &[f32], grad_alpha: &[f32]) {
        let (level, bins, projected, seen) = (self.level, &self.bins, &self.projected[..], &self.seen[..]);
        let pixels = Pixels {
            image: &self.image,
            alpha: &self.alpha,
            grad_image,
            grad_alpha,
            width,
        };
        let cut = |sums, rows: &Range<usize>, middle| bins.cut(sums, rows.start, middle, TileBins::first);
        let (rows, columns) = (bins.tiles.rows.len(), bins.tiles.columns.len());
        parallel_for(0..rows, 1, &mut self.sums[..], &cut, &|row, mut sums: &mut [Sums]| {
            for column in 0..columns {
                let t = row.start * columns + column;
                let (own, rest) = bins.cut_tile(sums, t, TileBins::first);
                sums = rest;
                if own.is_empty() {
                    continue;
                }
                let (x, y) = (column * TILE, row.start * TILE);
                let (pairs, hits) = (&bins.pairs[bins.first(t)..], &seen[bins.batches(t)..]);
                backward(level, projected, pairs, &pixels, [x, y], background, hits, own);
            }
        });
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

#[cfg(test)]
mod tests;

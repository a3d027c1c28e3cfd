//! Multi-resolution hash grid (Instant-NGP, Mueller et al. 2022): [N, 3] in [0, 1] -> [N, L * F], trilinear at each
//! level.
//!
//! A level whose vertices fit the table is dense, the others are hashed. A level is one task that walks all points in
//! order: its part of the table stays in the cache, gradients need no atomics, and results do not depend on the
//! threads. Few points are less work than waking a thread.

mod cell;

use std::ops::Range;

use rayon::prelude::*;

use crate::error::{RasterError, check_length};
use crate::parallel::parallel_for;
use cell::GridLevel;

/// Points of one task when the outputs of the levels are interleaved; up to this number, one task looks up all levels.
const POINTS: usize = 256;

/// Shape of a grid; the table is [entries, F], level after level.
pub struct HashGrid {
    features: usize,
    levels: Vec<GridLevel>,
    entries: usize,
    scratch: Vec<f32>, // [L, N, F] or [L, N, 3], kept from call to call
}

impl HashGrid {
    /// `cells`: number of cells along a side of each level; `table`: most entries of a level, a power of two.
    ///
    /// # Errors
    /// `features` is not 1, 2, 4 or 8; a level has no cells; `table` is not a power of two.
    pub fn new(features: usize, cells: &[u32], table: usize) -> Result<HashGrid, RasterError> {
        if !matches!(features, 1 | 2 | 4 | 8) {
            return Err(RasterError::Shape {
                name: "features of the hash grid",
                expected: 4,
                got: features,
            });
        }
        if !table.is_power_of_two() || table > 1 << 24 {
            return Err(RasterError::Shape {
                name: "table of the hash grid",
                expected: 1 << 15,
                got: table,
            });
        }
        let mut levels = Vec::with_capacity(cells.len());
        let mut first = 0;
        for &cells in cells {
            if cells == 0 || cells > 1 << 20 {
                return Err(RasterError::Shape {
                    name: "level of the hash grid",
                    expected: 16,
                    got: cells as usize,
                });
            }
            let vertices = (cells as usize + 1).pow(3);
            let (dense, entries) = (vertices <= table, vertices.min(table));
            levels.push(GridLevel {
                cells,
                first,
                entries,
                dense,
            });
            first += entries;
        }
        Ok(HashGrid {
            features,
            levels,
            entries: first,
            scratch: Vec::new(),
        })
    }

    /// Rows of the table.
    pub fn entries(&self) -> usize {
        self.entries
    }

    /// Values per point: L * F.
    pub fn outputs(&self) -> usize {
        self.levels.len() * self.features
    }

    /// `points` [N, 3], `table` [entries, F] -> `out` [N, L * F].
    ///
    /// # Errors
    /// Wrong lengths.
    pub fn forward(&mut self, points: &[f32], table: &[f32], out: &mut [f32]) -> Result<(), RasterError> {
        self.check(points, table, out.len())?;
        match self.features {
            1 => self.forward_of::<1>(points, table, out),
            2 => self.forward_of::<2>(points, table, out),
            4 => self.forward_of::<4>(points, table, out),
            _ => self.forward_of::<8>(points, table, out),
        }
        Ok(())
    }

    fn check(&self, points: &[f32], table: &[f32], outputs: usize) -> Result<(), RasterError> {
        check_length("points", points.len(), points.len() / 3 * 3)?;
        check_length("table", table.len(), self.entries * self.features)?;
        check_length("features", outputs, points.len() / 3 * self.outputs())
    }

    fn forward_of<const F: usize>(&mut self, points: &[f32], table: &[f32], out: &mut [f32]) {
        let (n, stride) = (points.len() / 3, self.outputs().max(1));
        self.scratch.resize(n * stride, 0.0);
        let (table, _) = table.as_chunks::<F>();
        let (grain, scratch) = (self.grain(n), self.scratch.as_chunks_mut::<F>().0);
        let cut =
            |work, levels: &Range<usize>, middle: usize| <[[f32; F]]>::split_at_mut(work, n * (middle - levels.start));
        parallel_for(
            0..self.levels.len(),
            grain,
            scratch,
            &cut,
            &|levels, out: &mut [[f32; F]]| {
                for (level, out) in self.levels[levels].iter().zip(out.chunks_exact_mut(n.max(1))) {
                    let rows = &table[level.first..level.first + level.entries];
                    for (out, point) in out.iter_mut().zip(points.as_chunks::<3>().0) {
                        let cell = level.cell(point);
                        let weights = cell.weights();
                        *out = [0.0; F];
                        for corner in 0..8 {
                            let (w, row) = (weights[corner], &rows[cell.rows[corner] as usize]);
                            for f in 0..F {
                                out[f] += w * row[f];
                            }
                        }
                    }
                }
            },
        );
        let scratch = self.scratch.as_chunks::<F>().0;
        let cut =
            |work, points: &Range<usize>, middle: usize| <[f32]>::split_at_mut(work, stride * (middle - points.start));
        parallel_for(0..n, POINTS, out, &cut, &|points, out: &mut [f32]| {
            for (point, out) in points.zip(out.chunks_exact_mut(stride)) {
                for (l, features) in out.as_chunks_mut::<F>().0.iter_mut().enumerate() {
                    *features = scratch[l * n + point];
                }
            }
        });
    }

    /// Levels of one task for `n` points.
    fn grain(&self, n: usize) -> usize {
        if n <= POINTS { self.levels.len().max(1) } else { 1 }
    }

    /// Gradients from `grad_out` [N, L * F]: `grad_table` is added to, `grad_points` (if wanted) overwritten.
    ///
    /// # Errors
    /// Wrong lengths.
    pub fn backward(
        &mut self,
        points: &[f32],
        table: &[f32],
        grad_out: &[f32],
        grad_table: &mut [f32],
        grad_points: Option<&mut [f32]>,
    ) -> Result<(), RasterError> {
        self.check(points, table, grad_out.len())?;
        check_length("gradient of the table", grad_table.len(), table.len())?;
        match self.features {
            1 => self.table_backward::<1>(points, grad_out, grad_table),
            2 => self.table_backward::<2>(points, grad_out, grad_table),
            4 => self.table_backward::<4>(points, grad_out, grad_table),
            _ => self.table_backward::<8>(points, grad_out, grad_table),
        }
        let Some(grad_points) = grad_points else { return Ok(()) };
        check_length("gradient of the points", grad_points.len(), points.len())?;
        match self.features {
            1 => self.points_backward::<1>(points, table, grad_out, grad_points),
            2 => self.points_backward::<2>(points, table, grad_out, grad_points),
            4 => self.points_backward::<4>(points, table, grad_out, grad_points),
            _ => self.points_backward::<8>(points, table, grad_out, grad_points),
        }
        Ok(())
    }

    fn table_backward<const F: usize>(&self, points: &[f32], grad_out: &[f32], grad_table: &mut [f32]) {
        let (n, stride) = (points.len() / 3, self.outputs().max(1));
        let (rows, _) = grad_table.as_chunks_mut::<F>();
        let cut = |rows, levels: &Range<usize>, middle: usize| {
            let n = self.levels[middle].first - self.levels[levels.start].first;
            <[[f32; F]]>::split_at_mut(rows, n)
        };
        parallel_for(
            0..self.levels.len(),
            self.grain(n),
            rows,
            &cut,
            &|levels, mut rows: &mut [[f32; F]]| {
                for l in levels {
                    let level = self.levels[l];
                    let (of_level, rest) = rows.split_at_mut(level.entries);
                    rows = rest;
                    for (g, point) in grad_out.chunks_exact(stride).zip(points.as_chunks::<3>().0) {
                        let g = &g[l * F..(l + 1) * F];
                        let cell = level.cell(point);
                        let weights = cell.weights();
                        for corner in 0..8 {
                            let (w, row) = (weights[corner], &mut of_level[cell.rows[corner] as usize]);
                            for f in 0..F {
                                row[f] += w * g[f];
                            }
                        }
                    }
                }
            },
        );
    }

    fn points_backward<const F: usize>(
        &mut self,
        points: &[f32],
        table: &[f32],
        grad_out: &[f32],
        grad_points: &mut [f32],
    ) {
        let (n, stride) = (points.len() / 3, self.outputs().max(1));
        self.scratch.resize(3 * n * self.levels.len(), 0.0);
        let (table, _) = table.as_chunks::<F>();
        let levels = self
            .levels
            .par_iter()
            .zip(self.scratch.par_chunks_mut((3 * n).max(1)))
            .enumerate();
        levels.for_each(|(l, (level, out))| {
            let rows = &table[level.first..level.first + level.entries];
            let items = out.as_chunks_mut::<3>().0.iter_mut().zip(points.as_chunks::<3>().0);
            for ((out, point), g) in items.zip(grad_out.chunks_exact(stride)) {
                let (cell, g) = (level.cell(point), &g[l * F..(l + 1) * F]);
                let mut value = [0.0; 8];
                for corner in 0..8 {
                    let row = &rows[cell.rows[corner] as usize];
                    for f in 0..F {
                        value[corner] += row[f] * g[f];
                    }
                }
                *out = cell.slopes(&value).map(|s| s * level.cells as f32);
            }
        });
        let scratch = &self.scratch;
        grad_points.par_chunks_mut(3 * POINTS).enumerate().for_each(|(i, out)| {
            for (k, v) in out.iter_mut().enumerate() {
                let at = |l: usize| scratch[l * 3 * n + 3 * POINTS * i + k];
                *v = (0..self.levels.len()).map(at).sum();
            }
        });
    }
}

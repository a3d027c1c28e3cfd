//! Splits the projected Gaussians of an image into k bands of rows, for workers that share no memory: each worker draws
//! its band with `Rasterizer::draw`. Bands start at multiples of TILE rows, so the pixels are the same as without
//! bands.

use crate::projected::{MANY, Projected, TILE};
use crate::size::Size;

/// Rows of the image and the Gaussians that meet them; y and tiles count from the first row of the band.
#[derive(Default)]
pub struct Band {
    pub first: usize,
    pub rows: usize,
    pub splats: Vec<Projected>,
}

/// Splits images into bands; keeps its buffers from image to image.
#[derive(Default)]
pub struct Bands {
    pub bands: Vec<Band>,
    load: Vec<f32>, // of each row of tiles
}

/// Cost of an empty tile, in Gaussians.
const TILE_COST: f32 = 8.0;

impl Bands {
    /// At most `count` bands of about the same number of Gaussian-tile pairs.
    pub fn split(&mut self, projected: &[Projected], size: Size, count: usize) -> &[Band] {
        self.measure(projected, size);
        let ends = ends(&self.load, count);
        self.cut(projected, size, &ends);
        &self.bands
    }

    /// Bands that end at the rows of tiles `ends`, as `ends()` gives them: for images whose other Gaussians other
    /// workers project.
    pub fn split_at(&mut self, projected: &[Projected], size: Size, ends: &[usize]) -> &[Band] {
        self.measure(projected, size);
        let rows = self.load.len();
        let mut fit: Vec<usize> = ends.iter().map(|end| (*end).clamp(1, rows.max(1))).collect();
        fit.push(rows);
        fit.sort_unstable();
        fit.dedup();
        self.cut(projected, size, &fit);
        &self.bands
    }

    /// Gaussian-tile pairs of each row of tiles of the last image.
    pub fn load(&self) -> &[f32] {
        &self.load
    }

    fn cut(&mut self, projected: &[Projected], size: Size, ends: &[usize]) {
        self.bands.resize_with(ends.len(), Band::default);
        let mut first = 0;
        for (band, end) in self.bands.iter_mut().zip(ends) {
            band.first = first * TILE;
            band.rows = (end * TILE).min(size.height) - band.first;
            band.take(projected);
            first = *end;
        }
    }

    /// Gaussian-tile pairs of each row of tiles, by the boxes of the ellipses.
    fn measure(&mut self, projected: &[Projected], size: Size) {
        let (columns, rows) = (size.width.div_ceil(TILE), size.height.div_ceil(TILE));
        self.load.clear();
        self.load.resize(rows, TILE_COST * columns as f32);
        for p in projected.iter().filter(|p| p.visible()) {
            let [x0, x1, y0, y1] = p.tiles.map(usize::from);
            for load in self.load.iter_mut().take(y1 + 1).skip(y0) {
                *load += (x1 + 1 - x0) as f32;
            }
        }
    }
}

/// The rows of tiles at which at most `count` bands of about the same load end; `load` of each row of tiles.
pub fn ends(load: &[f32], count: usize) -> Vec<usize> {
    let (tiles, count) = (load.len(), count.clamp(1, load.len().max(1)));
    let total: f32 = load.iter().sum();
    let (mut row, mut sum) = (0, 0.0);
    (1..=count)
        .map(|i| {
            let (first, left) = (row, count - i);
            let goal = total * i as f32 / count as f32;
            // one row of tiles at least; a row more where that is nearer to the equal share
            while row < tiles - left && (row == first || left == 0 || sum + 0.5 * load[row] < goal) {
                sum += load[row];
                row += 1;
            }
            row
        })
        .collect()
}

impl Band {
    fn take(&mut self, projected: &[Projected]) {
        let top = (self.first / TILE) as u16;
        let bottom = top + (self.rows.div_ceil(TILE) - 1) as u16;
        self.splats.clear();
        for p in projected {
            let [x0, x1, y0, y1] = p.tiles;
            if p.visible() && y0 <= bottom && y1 >= top {
                let tiles = [x0, x1, y0.max(top) - top, y1.min(bottom) - top];
                let y = p.y - self.first as f32;
                // without the rows of tiles above and below the band
                let met = if p.met == MANY {
                    MANY
                } else {
                    p.met >> (2 * (tiles[2] + top - y0))
                };
                let met = if y1 > bottom && met != MANY { met & 0b11 } else { met };
                self.splats.push(Projected { y, tiles, met, ..*p });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Background, Rasterizer, SimdLevel, Splats, Surface, View};

    const SIZE: Size = Size {
        width: 150,
        height: 141,
    };

    /// A spiral of Gaussians, denser at the top.
    fn scene(n: usize) -> [Vec<f32>; 5] {
        let t = |i: usize| i as f32 / n as f32;
        let flat = |f: &dyn Fn(usize) -> Vec<f32>| (0..n).flat_map(f).collect::<Vec<f32>>();
        [
            flat(&|i| {
                let a = 60.0 * t(i);
                vec![t(i) * a.cos(), 1.6 * t(i) * t(i) - 0.9, 4.0 + 0.3 * a.sin()]
            }),
            flat(&|i| vec![1.0, t(i), 0.5, -t(i)]),
            flat(&|i| vec![-3.0 - t(i), -2.5, -4.0]),
            flat(&|i| vec![2.0 * t(i)]),
            flat(&|i| vec![t(i), 0.2, 1.0 - t(i)]),
        ]
    }

    fn view(size: Size) -> View {
        View {
            size,
            focal: [150.0, 150.0],
            center: [size.width as f32 / 2.0, size.height as f32 / 2.0],
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            near: crate::constants::NEAR,
            low_pass: crate::constants::LOW_PASS,
        }
    }

    #[test]
    fn bands_together_are_the_picture() {
        let [means, quats, log_scales, logit_opacities, sh0] = scene(3000);
        let splats = Splats {
            means: &means,
            quats: &quats,
            log_scales: &log_scales,
            logit_opacities: &logit_opacities,
            sh0: &sh0,
            sh_n: &[],
            sh_k: 0,
            turns: &[],
        };
        let (view, background) = (view(SIZE), Background::new([0.2, 0.4, 0.6]));
        let mut whole = Rasterizer::new(SimdLevel::best(), 0);
        whole.forward(&splats, &view, background, false, false).unwrap();
        for count in [1, 2, 3, 9, 40] {
            let (mut project, mut draw) = (
                Rasterizer::new(SimdLevel::best(), 0),
                Rasterizer::new(SimdLevel::best(), 0),
            );
            let (mut bands, mut row) = (Bands::default(), 0);
            for band in bands.split(project.project(&splats, &view).unwrap(), view.size, count) {
                assert_eq!(band.first, row);
                assert!(band.rows > 0);
                let (from, to) = (3 * 150 * row, 3 * 150 * (row + band.rows));
                let (mut image, mut alpha) = (vec![0.0; to - from], vec![0.0; (to - from) / 3]);
                let surface = Surface::Floats {
                    image: &mut image,
                    alpha: &mut alpha,
                    depth: &mut [],
                };
                draw.draw(
                    surface,
                    Size {
                        width: 150,
                        height: band.rows,
                    },
                    background,
                    |p| p.clone_from(&band.splats),
                )
                .unwrap();
                for (a, b) in image.iter().zip(&whole.image()[from..to]) {
                    assert!((a - b).abs() < 1e-4, "{count} bands: {a} {b}");
                }
                row += band.rows;
            }
            assert_eq!(row, 141);
        }
    }

    /// Bands of parts of the Gaussians, cut by the sum of their loads, hold the same Gaussians as the bands of all.
    #[test]
    fn bands_of_parts() {
        let all = scene(3000);
        let view = view(SIZE);
        let projected = |range: std::ops::Range<usize>| {
            let part = |i: usize, c: usize| &all[i][range.start * c..range.end * c];
            let splats = Splats {
                means: part(0, 3),
                quats: part(1, 4),
                log_scales: part(2, 3),
                logit_opacities: part(3, 1),
                sh0: part(4, 3),
                sh_n: &[],
                sh_k: 0,
                turns: &[],
            };
            let mut project = Rasterizer::new(SimdLevel::best(), 0);
            project.project(&splats, &view).unwrap().to_vec()
        };
        let parts = [projected(0..1000), projected(1000..3000)];
        let mut bands = [Bands::default(), Bands::default(), Bands::default()];
        let whole = bands[2].split(&projected(0..3000), SIZE, 3);
        let whole: Vec<[usize; 3]> = whole.iter().map(|b| [b.first, b.rows, b.splats.len()]).collect();
        let mut load = vec![0.0; 141usize.div_ceil(TILE)];
        for (bands, part) in bands.iter_mut().zip(&parts) {
            bands.split(part, SIZE, 1);
            load.iter_mut().zip(bands.load()).for_each(|(sum, v)| *sum += v);
        }
        let at = ends(&load, 3);
        let mut sum: Vec<[usize; 3]> = vec![[0; 3]; 3];
        for (bands, part) in bands.iter_mut().zip(&parts) {
            for (sum, b) in sum.iter_mut().zip(bands.split_at(part, SIZE, &at)) {
                *sum = [b.first, b.rows, sum[2] + b.splats.len()];
            }
        }
        assert_eq!(sum, whole);
        assert_eq!(bands[0].split_at(&[], Size { height: 20, ..SIZE }, &[9, 1, 7]).len(), 2); // ends beyond it
    }

    #[test]
    fn no_gaussians_is_background() {
        let (mut bands, size) = (Bands::default(), Size { width: 20, height: 40 });
        let split = bands.split(&[], size, 2);
        assert_eq!(split.iter().map(|b| b.rows).sum::<usize>(), 40);
        let mut draw = Rasterizer::new(SimdLevel::best(), 0);
        let mut pixels = vec![[0; 4]; 800];
        let surface = Surface::Rgba(&mut pixels);
        draw.draw(surface, size, Background::new([1.0, 0.5, 0.0]), Vec::clear)
            .unwrap();
        assert!(pixels.iter().all(|p| *p == [255, 128, 0, 255]));
    }
}

//! Training kernels that work on arrays alone: image loss, Adam, trajectories and hash grid.

use numpy::{PyArray1, prelude::*};
use pyo3::prelude::*;
use raster::trajectory::{self, BitPrice, Trajectories};
use raster::{Adam, ImageLoss, Pair, SimdLevel};

use super::arrays::{In, InOut, contiguous, level, usage};

/// (loss, l1, mse, ssim, gradient [H * W * 3]) of an image [H, W, 3].
#[pyfunction]
#[pyo3(signature = (image, target, ssim_lambda, simd="auto"))]
#[allow(clippy::type_complexity)]
pub fn image_loss<'py>(
    py: Python<'py>,
    image: In,
    target: In,
    ssim_lambda: f32,
    simd: &str,
) -> PyResult<(f64, f64, f64, f64, Bound<'py, PyArray1<f32>>)> {
    let (level, width) = (level(simd)?, image.shape().get(1).copied().unwrap_or(0));
    let (x, y) = (contiguous(image.as_slice())?, contiguous(target.as_slice())?);
    let pair = Pair {
        image: x,
        target: y,
        width,
    };
    let (value, grad) = py
        .detach(|| {
            let mut grad = vec![0.0; x.len()];
            ImageLoss::default()
                .run(level, pair, ssim_lambda, &mut grad)
                .map(|v| (v, grad))
        })
        .map_err(usage)?;
    Ok((
        value.loss,
        value.l1,
        value.mse,
        value.ssim,
        PyArray1::from_vec(py, grad),
    ))
}

/// One step of Adam in place, `step` counted from 1; all arrays have the same length.
#[pyfunction]
pub fn adam(
    py: Python,
    arrays: (InOut, In, InOut, InOut),
    rate: f64,
    betas: [f64; 2],
    epsilon: f32,
    step: i32,
) -> PyResult<()> {
    let (mut param, grad, mut first, mut second) = arrays;
    let adam = corrected(rate, betas, epsilon, step);
    let (param, grad) = (contiguous(param.as_slice_mut())?, contiguous(grad.as_slice())?);
    let (first, second) = (contiguous(first.as_slice_mut())?, contiguous(second.as_slice_mut())?);
    py.detach(|| adam.step(SimdLevel::best(), param, grad, first, second))
        .map_err(usage)
}

/// The step of Adam number `step`, from 1, with its bias corrections.
fn corrected(rate: f64, betas: [f64; 2], epsilon: f32, step: i32) -> Adam {
    Adam {
        betas: betas.map(|b| b as f32),
        epsilon,
        rate: (rate / (1.0 - betas[0].powi(step))) as f32,
        correction: (1.0 / (1.0 - betas[1].powi(step))) as f32,
    }
}

/// sum over k of at[k] * rounded(coefficients [K, ...]) -> out, in place.
#[pyfunction]
pub fn trajectory_sum(py: Python, coefficients: In, at: Vec<f32>, dead_zone: f32, mut out: InOut) -> PyResult<()> {
    let (values, out) = (contiguous(coefficients.as_slice())?, contiguous(out.as_slice_mut())?);
    py.detach(|| trajectory::sum_at(SimdLevel::best(), values, &at, dead_zone, out))
        .map_err(usage)
}

/// One step of Adam on coefficients [K, ...] in place, `step` counted from 1: along at[k] * grad and, with a price
/// (weight, scales [K], noise), along the bits. Returns K times (bits, derivative by the log of the scale).
#[pyfunction]
#[allow(clippy::too_many_arguments)]
pub fn trajectory_step(
    py: Python,
    arrays: (InOut, In, InOut, InOut),
    at: Vec<f32>,
    price: Option<(f32, Vec<f32>, In)>,
    rate: f64,
    betas: [f64; 2],
    epsilon: f32,
    step: i32,
) -> PyResult<Vec<[f64; 2]>> {
    let (mut values, grad, mut first, mut second) = arrays;
    let adam = corrected(rate, betas, epsilon, step);
    let trajectories = Trajectories {
        values: contiguous(values.as_slice_mut())?,
        first: contiguous(first.as_slice_mut())?,
        second: contiguous(second.as_slice_mut())?,
    };
    let grad = contiguous(grad.as_slice())?;
    let price = match &price {
        Some((weight, scales, noise)) => Some(BitPrice {
            weight: *weight,
            scales,
            noise: contiguous(noise.as_slice())?,
        }),
        None => None,
    };
    py.detach(|| trajectory::step(SimdLevel::best(), adam, trajectories, &at, grad, price))
        .map_err(usage)
}

/// Instant-NGP grid: `cells` on a side of each level, `table` entries at most a level.
#[pyclass]
pub struct HashGrid {
    inner: raster::HashGrid,
}

#[pymethods]
impl HashGrid {
    #[new]
    fn new(features: usize, cells: Vec<u32>, table: usize) -> PyResult<Self> {
        Ok(HashGrid {
            inner: raster::HashGrid::new(features, &cells, table).map_err(usage)?,
        })
    }

    #[getter]
    fn entries(&self) -> usize {
        self.inner.entries()
    }

    /// points [N, 3], table [entries, F] -> out [N, L * F], written in place.
    fn forward(&mut self, py: Python, points: In, table: In, mut out: InOut) -> PyResult<()> {
        let (points, table) = (contiguous(points.as_slice())?, contiguous(table.as_slice())?);
        let out = contiguous(out.as_slice_mut())?;
        py.detach(|| self.inner.forward(points, table, out)).map_err(usage)
    }

    /// Adds to grad_table and overwrites grad_points.
    fn backward(
        &mut self,
        py: Python,
        points: In,
        table: In,
        grad_out: In,
        mut grad_table: InOut,
        mut grad_points: Option<InOut>,
    ) -> PyResult<()> {
        let (points, table) = (contiguous(points.as_slice())?, contiguous(table.as_slice())?);
        let (grad_out, grad_table) = (contiguous(grad_out.as_slice())?, contiguous(grad_table.as_slice_mut())?);
        let grad_points = grad_points.as_mut().map(|g| contiguous(g.as_slice_mut())).transpose()?;
        py.detach(|| self.inner.backward(points, table, grad_out, grad_table, grad_points))
            .map_err(usage)
    }
}

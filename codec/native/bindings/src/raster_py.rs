//! `_native.Rasterizer`: numpy arrays in, numpy arrays out.
//!
//! Parameters are the tuple (means, quats, log_scales, logit_opacities, sh0, shN), f32 and contiguous, optionally
//! followed by the rotations of the harmonics. Gradients are a tuple of the shapes of the six and (grad2d, max_weight),
//! written in place.

mod arrays;
mod kernels;

use arrays::{In, InOut, contiguous, level, usage};
use numpy::{PyArray1, PyReadonlyArrayDyn, prelude::*};
use pyo3::prelude::*;
use pyo3::types::PyTuple;
use raster::{
    Background, Gradients, Lambdas, Projected, SimdLevel, Size, Splats, Step, StepValue, Surface, TargetImage, View,
};

type Bytes<'py> = PyReadonlyArrayDyn<'py, u8>;
/// The six arrays of the parameters, and optionally rotations [N, 4] of the harmonics.
struct Params<'py> {
    own: (In<'py>, In<'py>, In<'py>, In<'py>, In<'py>, In<'py>),
    turns: Option<In<'py>>,
}

impl<'a, 'py> FromPyObject<'a, 'py> for Params<'py> {
    type Error = PyErr;

    fn extract(arrays: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let all = arrays.cast::<PyTuple>()?;
        if all.len() != 7 {
            let own = all.extract()?; // refuses any but six
            return Ok(Params { own, turns: None });
        }
        Ok(Params {
            own: all.get_slice(0, 6).extract()?,
            turns: Some(all.get_item(6)?.extract()?),
        })
    }
}

type Grads<'py> = (
    (InOut<'py>, InOut<'py>, InOut<'py>, InOut<'py>, InOut<'py>, InOut<'py>),
    (InOut<'py>, InOut<'py>),
);
type TargetView<'py> = (
    ViewArgs,
    ([f32; 3], Option<([f32; 3], [f32; 3])>),
    (Bytes<'py>, Option<Bytes<'py>>, Option<In<'py>>),
);
type Value = (f64, f64, f64, f64, f64, f64, [f64; 3], [f64; 3]);
/// (image, alpha), flat
type Picture<'py> = (Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<f32>>);

fn splats<'a>(p: &'a Params) -> PyResult<Splats<'a>> {
    let own = &p.own;
    Ok(Splats {
        means: contiguous(own.0.as_slice())?,
        quats: contiguous(own.1.as_slice())?,
        log_scales: contiguous(own.2.as_slice())?,
        logit_opacities: contiguous(own.3.as_slice())?,
        sh0: contiguous(own.4.as_slice())?,
        sh_n: contiguous(own.5.as_slice())?,
        sh_k: own.5.shape().get(1).copied().unwrap_or(0),
        turns: p.turns.as_ref().map_or(Ok(&[][..]), |t| contiguous(t.as_slice()))?,
    })
}

fn gradients<'a>(g: &'a mut Grads) -> PyResult<Gradients<'a>> {
    let (params, stats) = g;
    Ok(Gradients {
        add: false,
        means: contiguous(params.0.as_slice_mut())?,
        quats: contiguous(params.1.as_slice_mut())?,
        log_scales: contiguous(params.2.as_slice_mut())?,
        logit_opacities: contiguous(params.3.as_slice_mut())?,
        sh0: contiguous(params.4.as_slice_mut())?,
        sh_n: contiguous(params.5.as_slice_mut())?,
        grad2d: contiguous(stats.0.as_slice_mut())?,
        max_weight: contiguous(stats.1.as_slice_mut())?,
    })
}

/// size, (fx, fy, cx, cy), rows of the world-to-camera matrix, near plane and low-pass.
#[derive(FromPyObject)]
struct ViewArgs {
    #[pyo3(item)]
    size: [usize; 2],
    #[pyo3(item)]
    intrinsics: [f32; 4],
    #[pyo3(item)]
    viewmat: [[f32; 4]; 3],
    #[pyo3(item)]
    near: f32,
    #[pyo3(item)]
    low_pass: f32,
}

impl ViewArgs {
    fn view(&self) -> View {
        let [fx, fy, cx, cy] = self.intrinsics;
        let m = &self.viewmat;
        let [width, height] = self.size;
        View {
            size: Size { width, height },
            focal: [fx, fy],
            center: [cx, cy],
            rotation: std::array::from_fn(|i| [m[i][0], m[i][1], m[i][2]]),
            translation: [m[0][3], m[1][3], m[2][3]],
            near: self.near,
            low_pass: self.low_pass,
        }
    }
}

#[pyclass]
struct Rasterizer {
    inner: raster::Rasterizer,
    step: Step,
}

#[pymethods]
impl Rasterizer {
    #[new]
    #[pyo3(signature = (threads=0, simd="auto"))]
    fn new(threads: usize, simd: &str) -> PyResult<Self> {
        Ok(Rasterizer {
            inner: raster::Rasterizer::new(level(simd)?, threads),
            step: Step::default(),
        })
    }

    #[getter]
    fn simd(&self) -> &'static str {
        self.inner.level().name()
    }

    /// Bytes of the buffers.
    #[getter]
    fn memory(&self) -> usize {
        self.inner.memory()
    }

    /// Milliseconds of the last passes.
    fn timings(&self) -> Vec<(&'static str, f64)> {
        let t = self.inner.timings;
        vec![
            ("project", t.project),
            ("bin", t.bin),
            ("blend", t.blend),
            ("loss", t.loss),
            ("backward_tiles", t.backward_tiles),
            ("backward_project", t.backward_project),
        ]
    }

    fn forward<'py>(
        &mut self,
        py: Python<'py>,
        params: Params<'py>,
        view: ViewArgs,
        background: [f32; 3],
        training: bool,
    ) -> PyResult<Picture<'py>> {
        let (splats, view) = (splats(&params)?, view.view());
        py.detach(|| {
            self.inner
                .forward(&splats, &view, Background::new(background), training, false)
        })
        .map_err(usage)?;
        Ok((
            PyArray1::from_slice(py, self.inner.image()),
            PyArray1::from_slice(py, self.inner.alpha()),
        ))
    }

    /// Renders depth: weight times depth along the optical axis, summed over the Gaussians, and alpha, flat.
    fn depth<'py>(&mut self, py: Python<'py>, params: Params<'py>, view: ViewArgs) -> PyResult<Picture<'py>> {
        let (splats, view, black) = (splats(&params)?, view.view(), Background::new([0.0; 3]));
        py.detach(|| self.inner.forward(&splats, &view, black, false, true))
            .map_err(usage)?;
        Ok((
            PyArray1::from_slice(py, self.inner.depth()),
            PyArray1::from_slice(py, self.inner.alpha()),
        ))
    }

    fn backward(&mut self, py: Python, params: Params, grad_image: In, grad_alpha: In, grads: Grads) -> PyResult<()> {
        let mut grads = grads;
        let (splats, mut out) = (splats(&params)?, gradients(&mut grads)?);
        let (image, alpha) = (contiguous(grad_image.as_slice())?, contiguous(grad_alpha.as_slice())?);
        py.detach(|| self.inner.backward(&splats, image, alpha, &[], &mut out))
            .map_err(usage)
    }

    /// One training step on a batch of views. Returns for each (loss, l1, mse, ssim, mask, depth, gradient of the gain,
    /// of the offset), and [N] the largest radii. The gradients are those of the sum of the losses; None: they are not computed. A view is (camera,
    /// (background, (gain, offset) or None), (rgb, alpha or None, depth or None)); the lambdas are those of
    /// SSIM, mask and depth.
    fn step<'py>(
        &mut self,
        py: Python<'py>,
        params: Params,
        views: Vec<TargetView>,
        lambdas: (f32, f32, f32),
        grads: Option<Grads>,
    ) -> PyResult<(Vec<Value>, Bound<'py, PyArray1<f32>>)> {
        let mut grads = grads;
        let (splats, mut out) = (splats(&params)?, grads.as_mut().map(gradients).transpose()?);
        let lambdas = Lambdas {
            ssim: lambdas.0,
            mask: lambdas.1,
            depth: lambdas.2,
        };
        let (step, inner) = (&mut self.step, &mut self.inner);
        let (mut values, mut radii) = (Vec::new(), vec![0.0f32; splats.len()]);
        for (view, (background, exposure), (rgb, alpha, depth)) in &views {
            let target = TargetImage {
                rgb: contiguous(rgb.as_slice())?,
                alpha: alpha.as_ref().map(|a| contiguous(a.as_slice())).transpose()?,
                depth: depth.as_ref().map(|d| contiguous(d.as_slice())).transpose()?,
                offset: exposure.map_or([0.0; 3], |e| e.1),
            };
            let (view, background) = (
                view.view(),
                Background {
                    rgb: *background,
                    gain: exposure.map(|e| e.0),
                },
            );
            let v = py
                .detach(|| step.run(inner, &splats, &view, background, target, lambdas, out.as_mut()))
                .map_err(usage)?;
            let StepValue { image, mask, depth, .. } = v;
            values.push((v.loss, image.l1, image.mse, image.ssim, mask, depth, v.gain, v.offset));
            radii
                .iter_mut()
                .zip(inner.projected())
                .for_each(|(r, p)| *r = r.max(p.radius()));
            if let Some(out) = &mut out {
                out.add = true;
            }
        }
        Ok((values, PyArray1::from_vec(py, radii)))
    }

    /// Renders to 8-bit colour, flat.
    fn draw<'py>(
        &mut self,
        py: Python<'py>,
        params: Params<'py>,
        view: ViewArgs,
        background: [f32; 3],
    ) -> PyResult<Bound<'py, PyArray1<u8>>> {
        let (splats, view) = (splats(&params)?, view.view());
        view.check().map_err(usage)?; // before its size is allocated
        let mut out = vec![[0; 3]; view.size.pixels()];
        let surface = Surface::Rgb(&mut out);
        py.detach(|| self.inner.paint(surface, &splats, &view, Background::new(background)))
            .map_err(usage)?;
        Ok(PyArray1::from_vec(py, out.into_flattened()))
    }

    /// (image, alpha) of the last pass, flat.
    fn picture<'py>(&self, py: Python<'py>) -> Picture<'py> {
        (
            PyArray1::from_slice(py, self.inner.image()),
            PyArray1::from_slice(py, self.inner.alpha()),
        )
    }

    /// [N] larger half side of the box of each Gaussian in pixels, 0 if invisible, and [N] depths.
    fn radii<'py>(&self, py: Python<'py>) -> Picture<'py> {
        let projected = self.inner.projected();
        (
            PyArray1::from_iter(py, projected.iter().map(Projected::radius)),
            PyArray1::from_iter(py, projected.iter().map(|p| p.depth)),
        )
    }
}

/// Names of the instruction sets that this machine can use, fastest first.
#[pyfunction]
fn simd_levels() -> Vec<&'static str> {
    SimdLevel::available().iter().map(|l| l.name()).collect()
}

pub fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_class::<Rasterizer>()?;
    m.add_class::<kernels::HashGrid>()?;
    m.add_function(wrap_pyfunction!(kernels::image_loss, m)?)?;
    m.add_function(wrap_pyfunction!(kernels::adam, m)?)?;
    m.add_function(wrap_pyfunction!(kernels::trajectory_sum, m)?)?;
    m.add_function(wrap_pyfunction!(kernels::trajectory_step, m)?)?;
    m.add_function(wrap_pyfunction!(simd_levels, m)?)
}

//! Evaluation for Python: frames of a decoded, trained or fitted group.

use super::rigid_blend::blend_of;
use super::values::invalid;
use gsv::attributes::{Attribute, sh_coefficients};
use gsv::blend::Blend;
use gsv::parametric::{AttributeMotion, Coefficient, Frame, FrameMut, Parametric};
use gsv::pose::Pose;
use gsv::trajectories::Trajectories;
use numpy::{IntoPyArray, PyArray1, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PySlice};
use rayon::prelude::*;

type Arrays<'py> = (
    PyReadonlyArray2<'py, f32>,
    PyReadonlyArray2<'py, f32>,
    PyReadonlyArray2<'py, f32>,
    numpy::PyReadonlyArray1<'py, f32>,
    PyReadonlyArray2<'py, f32>,
    PyReadonlyArray3<'py, f32>,
);
/// positions [M, 3], coefficients [K, 6, M], neighbors [N, k], weights [N, k].
type Nodes<'py> = (
    PyReadonlyArray2<'py, f32>,
    PyReadonlyArray3<'py, f32>,
    PyReadonlyArray2<'py, u32>,
    PyReadonlyArray2<'py, f32>,
);

/// A group in floats, ready to be evaluated at any frame (`gscodec.model.parametric_group`).
#[pyclass(frozen, module = "gscodec._native")]
pub struct ParametricEvaluator {
    frames: u16,
    rest: Frame,
    sh_coefficients: usize,
    blend: Blend,
    nodes: Vec<[f32; 3]>,
    node_motion: Trajectories<f32>,
    motions: Vec<AttributeMotion<f32>>,
    turned: bool,
}

#[pymethods]
impl ParametricEvaluator {
    /// `canonical`: means, quats, log_scales, logit_opacities, sh0, shN. `trajectories`: (attribute, [K, C, N]) pairs.
    /// `turned`: spherical harmonics rotate with the nodes.
    #[new]
    fn new(
        py: Python,
        frames: u16,
        canonical: Arrays,
        nodes: Option<Nodes>,
        trajectories: Vec<(String, PyReadonlyArray3<f32>)>,
        turned: bool,
    ) -> PyResult<Self> {
        let n = canonical.0.shape()[0];
        let k = canonical.5.shape()[1];
        let widths = [
            ("means", canonical.0.shape(), vec![n, 3]),
            ("quats", canonical.1.shape(), vec![n, 4]),
            ("log_scales", canonical.2.shape(), vec![n, 3]),
            ("logit_opacities", canonical.3.shape(), vec![n]),
            ("sh0", canonical.4.shape(), vec![n, 3]),
            ("shN", canonical.5.shape(), vec![n, k, 3]),
        ];
        if let Some((name, found, expected)) = widths.iter().find(|(_, found, expected)| *found != &expected[..]) {
            return invalid(format!("{name}: expected shape {expected:?}, got {found:?}"));
        }
        if !(0..=3).map(sh_coefficients).any(|c| c == k) {
            return invalid(format!("shN: expected 0, 3, 8 or 15 coefficients, got {k}"));
        }
        let rest = Frame {
            means: canonical.0.as_slice()?.as_chunks().0.to_vec(),
            quats: canonical.1.as_slice()?.as_chunks().0.to_vec(),
            log_scales: canonical.2.as_slice()?.to_vec(),
            logit_opacities: canonical.3.as_slice()?.to_vec(),
            sh0: canonical.4.as_slice()?.to_vec(),
            sh_n: canonical.5.as_slice()?.to_vec(),
        };
        let (mut blend, mut places, mut node_motion) = (Blend::default(), Vec::new(), Trajectories::new(6));
        if let Some((positions, coefficients, index, weight)) = nodes {
            places = positions.as_slice()?.as_chunks().0.to_vec();
            node_motion = sparse(py, &coefficients, 6, places.len(), "nodes")?;
            blend = blend_of(&index, &weight, n, places.len())?;
        }
        let mut motions = Vec::new();
        for (name, values) in trajectories {
            let Some(attribute) = Attribute::ALL.into_iter().find(|a| a.name() == name) else {
                return invalid(format!("trajectories: unknown attribute '{name}'"));
            };
            let channels = match attribute {
                Attribute::ShN => 3 * canonical.5.shape()[1],
                a => a.channels(0),
            };
            let t = sparse(py, &values, channels, n, &name)?;
            motions.push(AttributeMotion::new(attribute, 1.0, false, t));
        }
        Ok(ParametricEvaluator {
            frames,
            rest,
            sh_coefficients: k,
            blend,
            nodes: places,
            node_motion,
            motions,
            turned,
        })
    }

    /// Attributes of frame `t` of all Gaussians, f32.
    fn frame<'py>(&self, py: Python<'py>, t: u16) -> PyResult<Bound<'py, PyDict>> {
        if t >= self.frames {
            return Err(PyIndexError::new_err(format!(
                "frame {t} of a group of {}",
                self.frames
            )));
        }
        frame(py, &self.parametric(), t, self.sh_coefficients, &Pose::default())
    }

    /// Means [T, N, 3] and quaternions [T, N, 4] wxyz of all frames.
    fn moved<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let p = self.parametric();
        over_time(py, &p, |t, m, q| p.moved_into(t, m, q))
    }

    /// See `DecodedGroup.carried`.
    fn carried<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        carried(py, &self.parametric())
    }
}

impl ParametricEvaluator {
    fn parametric(&self) -> Parametric<'_, f32> {
        Parametric {
            frames: self.frames,
            origin: [0.0; 3],
            rest: &self.rest,
            rotations: &self.rest.quats,
            blend: &self.blend,
            nodes: &self.nodes,
            node_motion: &self.node_motion,
            node_steps: [1.0; 2],
            rig: None,
            motions: &self.motions,
            turned: self.turned,
        }
    }
}

/// [K, C, N] -> sparse trajectories, one per Gaussian.
fn sparse(
    py: Python,
    a: &PyReadonlyArray3<f32>,
    channels: usize,
    count: usize,
    name: &str,
) -> PyResult<Trajectories<f32>> {
    let &[k, c, n] = a.shape() else {
        return invalid(format!("trajectories of {name}: expected shape [K, C, N]"));
    };
    if (c, n) != (channels, count) {
        return invalid(format!(
            "trajectories of {name}: expected shape [K, {channels}, {count}], got {:?}",
            a.shape()
        ));
    }
    let values = a.as_slice()?;
    Ok(py.detach(|| {
        let rows = k * c;
        let blocks: Vec<Trajectories<f32>> = (0..n.div_ceil(BLOCK))
            .into_par_iter()
            .map(|block| {
                let (first, last) = (block * BLOCK, n.min((block + 1) * BLOCK));
                let mut own = vec![0.0; (last - first) * rows];
                for r in 0..rows {
                    let row = &values[r * n + first..r * n + last];
                    row.iter()
                        .zip(own[r..].iter_mut().step_by(rows))
                        .for_each(|(v, o)| *o = *v);
                }
                let mut out = Trajectories::new(c);
                own.chunks(rows.max(1)).for_each(|one| out.push(one));
                out
            })
            .collect();
        let mut out = Trajectories::new(c);
        blocks.into_iter().for_each(|b| out.append(b));
        out
    }))
}

/// Gaussians whose coefficients are transposed together, so that they fit a cache.
const BLOCK: usize = 256;

/// Attributes of a frame, with `k` coefficients of the higher bands: views of one array, since few large pages are
/// allocated faster than many small ones.
pub fn frame<'py, V: Coefficient>(
    py: Python<'py>,
    p: &Parametric<V>,
    t: u16,
    k: usize,
    pose: &Pose,
) -> PyResult<Bound<'py, PyDict>> {
    let n = p.rest.means.len();
    let shapes = [
        ("means", vec![n, 3]),
        ("quats", vec![n, 4]),
        ("log_scales", vec![n, 3]),
        ("logit_opacities", vec![n]),
        ("sh0", vec![n, 3]),
        ("shN", vec![n, k, 3]),
    ];
    let numpy = py.import("numpy")?;
    let all = numpy.call_method1("empty", (n * (14 + 3 * k), "f4"))?; // not zeroed: all of it is written
    let all = all.cast_into::<PyArray1<f32>>()?;
    {
        let mut own = all.readwrite();
        let (means, rest) = own.as_slice_mut()?.split_at_mut(3 * n);
        let (quats, rest) = rest.split_at_mut(4 * n);
        let (log_scales, rest) = rest.split_at_mut(3 * n);
        let (logit_opacities, rest) = rest.split_at_mut(n);
        let (sh0, sh_n) = rest.split_at_mut(3 * n);
        let mut out = FrameMut {
            means: means.as_chunks_mut().0,
            quats: quats.as_chunks_mut().0,
            log_scales,
            logit_opacities,
            sh0,
            sh_n,
        };
        py.detach(|| {
            p.frame_into(t, &mut out);
            pose.apply(out);
        });
    }
    let (d, mut start) = (PyDict::new(py), 0);
    for (name, shape) in shapes {
        let end = start + shape.iter().product::<usize>();
        let part = all.get_item(PySlice::new(py, start as isize, end as isize, 1))?;
        d.set_item(name, part.call_method1("reshape", (shape,))?)?;
        start = end;
    }
    Ok(d)
}

/// Canonical attributes, as `frame` gives those of a frame.
pub fn canonical<'py, V: Coefficient>(py: Python<'py>, p: &Parametric<V>, k: usize) -> PyResult<Bound<'py, PyDict>> {
    let (d, n) = (PyDict::new(py), p.rest.means.len());
    let placed = |x: &[f32; 3]| [0, 1, 2].map(|a| p.origin[a] + x[a]);
    let means: Vec<f32> = p.rest.means.iter().flat_map(placed).collect();
    let set =
        |name: &str, values: Vec<f32>, shape: Vec<usize>| d.set_item(name, values.into_pyarray(py).reshape(shape)?);
    set("means", means, vec![n, 3])?;
    set("quats", p.rotations.as_flattened().to_vec(), vec![n, 4])?;
    set("log_scales", p.rest.log_scales.clone(), vec![n, 3])?;
    set("logit_opacities", p.rest.logit_opacities.clone(), vec![n])?;
    set("sh0", p.rest.sh0.clone(), vec![n, 3])?;
    set("shN", p.rest.sh_n.clone(), vec![n, k, 3])?;
    Ok(d)
}

/// Means [T, N, 3] and rotations [T, N, 4] of the Gaussians, moved by the nodes alone, in all frames.
pub fn carried<'py, V: Coefficient>(py: Python<'py>, p: &Parametric<V>) -> PyResult<Pair<'py>> {
    over_time(py, p, |t, m, r| p.carried_into(t, m, r))
}

type Pair<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>);

/// [T, N, 3] and [T, N, 4]: the results of `fill` for each frame.
fn over_time<'py, V: Coefficient>(
    py: Python<'py>,
    p: &Parametric<V>,
    fill: impl Fn(u16, &mut [[f32; 3]], &mut [[f32; 4]]) + Sync,
) -> PyResult<Pair<'py>> {
    let (frames, n) = (usize::from(p.frames), p.rest.means.len());
    let (means, rotations) = py.detach(|| {
        let mut means = vec![[0.0f32; 3]; frames * n];
        let mut rotations = vec![[0.0f32; 4]; frames * n];
        let chunks = means.chunks_mut(n.max(1)).zip(rotations.chunks_mut(n.max(1)));
        chunks.zip(0..p.frames).for_each(|((m, r), t)| fill(t, m, r));
        (means.into_flattened(), rotations.into_flattened())
    });
    let means = means.into_pyarray(py).reshape([frames, n, 3])?.into_any();
    Ok((means, rotations.into_pyarray(py).reshape([frames, n, 4])?.into_any()))
}

//! DecodedGroup: a payload -> integers in the form that encode_group takes, and attributes of frames.

use super::values::{bytes_of, raise};
use gsv::attributes::{Attribute, sh_coefficients};
use gsv::companding::Companding;
use gsv::conformance::Damage;
use gsv::decode::{Decoding, decode_damaged, decode_group};
use gsv::evaluate::{Evaluator, FrameMut};
use gsv::group::{BIRTH, Group};
use gsv::hilbert_layout::HilbertLayout;
use gsv::levels::Level;
use gsv::trajectories::Trajectories;
use gsv::unit::{self, ALL_LAYERS};
use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArray1, PyArrayMethods};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PySlice};

/// A decoded group: integers, and f32 attributes of any frame.
#[pyclass(frozen, module = "gscodec._native")]
pub struct DecodedGroup {
    evaluator: Evaluator,
    units: Vec<(String, Option<&'static str>, u8, usize, usize)>,
    damage: Vec<Damage>,
}

#[pymethods]
impl DecodedGroup {
    /// `strict`: damage is an error; otherwise `damage` lists what was not decoded. `reference`: the group that a predicted
    /// one refers to. `layers`: only so many, the payload may end behind them.
    #[new]
    #[pyo3(signature = (payload, level, strict = true, *, reference = None, layers = ALL_LAYERS))]
    fn new(
        py: Python,
        payload: &Bound<PyAny>,
        level: u8,
        strict: bool,
        reference: Option<Py<DecodedGroup>>,
        layers: usize,
    ) -> PyResult<Self> {
        let bytes = bytes_of(payload)?.as_slice()?.to_vec(); // ours while the GIL is released
        let reference = reference.as_ref().map(|r| r.get().group());
        let decoded = py.detach(|| {
            let how = Decoding {
                level: &Level::get(level)?,
                reference,
                layers: layers.max(1),
            };
            let (group, damage) = if strict {
                (decode_group(&bytes, &how)?, Vec::new())
            } else {
                decode_damaged(&bytes, &how)?
            };
            let units = unit::scan(&bytes, how.layers)?;
            let label = |u: &unit::Unit| u.kind.map_or("unknown", |k| k.name()).to_string();
            let units = units
                .iter()
                .map(|u| (label(u), u.attribute.map(|a| a.name()), u.layer, u.offset, u.size));
            Ok(DecodedGroup {
                units: units.collect(),
                damage,
                evaluator: Evaluator::new(group),
            })
        });
        decoded.map_err(|e| raise(py, e))
    }

    #[getter]
    fn frames(&self) -> u16 {
        self.evaluator.group().header.frames
    }

    #[getter]
    fn count(&self) -> usize {
        self.group().positions.len()
    }

    /// Gaussians of each decoded layer.
    #[getter]
    fn layers(&self) -> Vec<u32> {
        self.group().layers.iter().map(|l| l.count).collect()
    }

    /// [N] i32: index of each Gaussian in the group to which this one refers, -1 for births; None: it is independent.
    fn parents<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<i32>>> {
        Some(parents_into(py, self.group().parents.as_ref()?))
    }

    /// How many groups back the one is that this one refers to; 0: it is independent.
    #[getter]
    fn reference(&self) -> u16 {
        self.group().header.reference
    }

    #[getter]
    fn sh_degree(&self) -> u8 {
        self.evaluator.group().header.sh_degree
    }

    /// The group as encode_group takes it.
    fn integers<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        integers(py, &self.evaluator)
    }

    /// Attributes of frame `t` of all Gaussians, f32: views of one array, since few large pages are had faster than many small ones.
    fn frame<'py>(&self, py: Python<'py>, t: u16) -> PyResult<Bound<'py, PyDict>> {
        self.check(t)?;
        let (n, k) = (self.count(), sh_coefficients(self.sh_degree()));
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
            let out = FrameMut {
                means: means.as_chunks_mut().0,
                quats: quats.as_chunks_mut().0,
                log_scales,
                logit_opacities,
                sh0,
                sh_n,
            };
            py.detach(|| self.evaluator.frame_into(t, out));
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

    /// [N] bool: which Gaussians frame `t` shows; None: all.
    fn visible<'py>(&self, py: Python<'py>, t: u16) -> PyResult<Option<Bound<'py, PyArray1<bool>>>> {
        self.check(t)?;
        Ok(self.evaluator.visible(t).map(|v| v.into_pyarray(py)))
    }

    /// What the payload consists of.
    fn units<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let list = PyList::empty(py);
        for (kind, attribute, layer, offset, bytes) in &self.units {
            let d = PyDict::new(py);
            d.set_item("type", kind)?;
            d.set_item("attribute", attribute)?;
            d.set_item("layer", layer)?;
            d.set_item("offset", offset)?;
            d.set_item("bytes", bytes)?;
            list.append(d)?;
        }
        Ok(list)
    }

    /// Units that are damaged, or missing where others are (unit: None): dicts of unit, type, attribute, message.
    fn damage<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let list = PyList::empty(py);
        for damage in &self.damage {
            let d = PyDict::new(py);
            d.set_item("unit", damage.unit)?;
            d.set_item("type", damage.kind.map_or("unknown", |k| k.name()))?;
            d.set_item("attribute", damage.attribute.map(|a| a.name()))?;
            d.set_item("layer", damage.layer)?;
            d.set_item("message", &damage.message)?;
            list.append(d)?;
        }
        Ok(list)
    }

    /// Attribute maps (spec 7.2): name of the channel, behind that of the layer if there are several -> [H, W] i32; cells
    /// without a Gaussian are 0.
    fn maps<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let group = self.group();
        let d = PyDict::new(py);
        for k in 0..group.layers.len() {
            let range = group.range(k..k + 1);
            let map = HilbertLayout::new(range.len());
            let layer = if group.layers.len() > 1 {
                format!("layer{k}_")
            } else {
                String::new()
            };
            let set = |name: String, value: &dyn Fn(usize) -> i32| {
                let cells = map.arrange(|i| value(range.start + i)).into_pyarray(py);
                d.set_item(layer.clone() + &name, cells.reshape([map.height, map.width])?)
            };
            for a in 0..3 {
                set(format!("means_{a}"), &|i| group.positions[i][a] as i32)?;
            }
            for (a, values) in group.header.attributes().iter().zip(&group.channels) {
                let channels = a.channels(group.header.sh_degree);
                for c in 0..channels {
                    set(format!("{}_{c}", a.name()), &|i| values[i * channels + c])?;
                }
            }
        }
        Ok(d)
    }
}

impl DecodedGroup {
    pub fn group(&self) -> &Group {
        self.evaluator.group()
    }

    fn check(&self, t: u16) -> PyResult<()> {
        if t < self.frames() {
            return Ok(());
        }
        Err(PyIndexError::new_err(format!(
            "frame {t} of a group of {}",
            self.frames()
        )))
    }
}

fn grid<'py>(py: Python<'py>, p: &[[u32; 3]]) -> PyResult<Bound<'py, PyAny>> {
    Ok(p.as_flattened()
        .to_vec()
        .into_pyarray(py)
        .reshape([p.len(), 3])?
        .into_any())
}

fn dense<'py>(py: Python<'py>, t: &Trajectories, k: u16) -> Bound<'py, PyAny> {
    let c = t.channels;
    let mut a = Array3::<i32>::zeros((usize::from(k), c, t.len()));
    for i in 0..t.len() {
        t.get(i).iter().enumerate().for_each(|(j, v)| a[[j / c, j % c, i]] = *v);
    }
    a.into_pyarray(py).into_any()
}

/// [N] i32, -1 for births.
fn parents_into<'py>(py: Python<'py>, parents: &[u32]) -> Bound<'py, PyArray1<i32>> {
    let known = |p: &u32| if *p == BIRTH { -1 } else { *p as i32 };
    parents.iter().map(known).collect::<Vec<_>>().into_pyarray(py)
}

/// low, width, slopes.
fn curve_row(c: &Companding) -> Vec<f32> {
    let slopes = c.slopes.iter().map(|s| f32::from(*s));
    [c.low, c.width].into_iter().chain(slopes).collect()
}

fn integers<'py>(py: Python<'py>, e: &Evaluator) -> PyResult<Bound<'py, PyDict>> {
    let (g, h) = (e.group(), &e.group().header);
    let d = PyDict::new(py);
    d.set_item("frames", h.frames)?;
    d.set_item("origin", h.origin.to_vec())?;
    d.set_item("grid_step", h.grid_step)?;
    d.set_item("grid_bits", h.grid_bits)?;
    d.set_item("positions", grid(py, &g.positions)?)?;
    let channels = PyDict::new(py);
    for ((a, values), scale) in h.attributes().iter().zip(&g.channels).zip(&h.scales) {
        let c = scale.steps.len();
        let planes = Array2::from_shape_fn((c, g.positions.len()), |(k, i)| values[i * c + k]);
        let one = PyDict::new(py);
        one.set_item("values", planes.into_pyarray(py))?;
        one.set_item("steps", scale.steps.clone())?;
        one.set_item("offsets", scale.offsets.clone())?;
        let curves = h.companding_of(*a).iter().map(curve_row).collect::<Vec<_>>();
        one.set_item("curves", curves)?;
        if *a == Attribute::Quats {
            one.set_item("levers", h.scale_exponents.map(|l| l.to_vec()).to_vec())?;
        }
        channels.set_item(a.name(), one)?;
    }
    d.set_item("channels", channels)?;
    d.set_item("layers", g.layers.iter().map(|l| l.count).collect::<Vec<_>>())?;
    d.set_item(
        "corrections",
        g.corrections.iter().map(|c| c.to_vec()).collect::<Vec<_>>(),
    )?;
    if let Some(parents) = &g.parents {
        d.set_item("reference", h.reference)?;
        d.set_item("parents", parents_into(py, parents))?;
    }
    let trajectories = PyDict::new(py);
    for (head, t) in h.trajectories.iter().zip(e.trajectories()) {
        let one = PyDict::new(py);
        one.set_item("coefficients", dense(py, t, head.coefficients))?;
        one.set_item("step", head.step)?;
        trajectories.set_item(head.attribute.name(), one)?;
    }
    d.set_item("trajectories", trajectories)?;
    if let Some(l) = &g.lifetimes {
        d.set_item(
            "lifetimes",
            l.as_flattened().to_vec().into_pyarray(py).reshape([l.len(), 2])?,
        )?;
    }
    if h.nodes.count > 0 {
        let one = PyDict::new(py);
        one.set_item("positions", grid(py, &g.node_positions)?)?;
        one.set_item("coefficients", dense(py, &g.node_trajectories, h.nodes.coefficients))?;
        one.set_item("rotation_step", h.nodes.rotation_step)?;
        one.set_item("translation_step", h.nodes.translation_step)?;
        one.set_item("neighbors", h.nodes.neighbors)?;
        d.set_item("nodes", one)?;
    }
    Ok(d)
}

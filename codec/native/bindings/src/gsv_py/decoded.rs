//! DecodedGroup: a payload -> integers in the form that encode_group takes, and attributes of frames.

use super::group_from::group_from;
use super::parametric::{canonical, carried, frame};
use super::placement::{PoseTuple, pose_from};
use super::quantized_from::{parents_into, quantized};
use super::report;
use super::values::{bytes_of, raise};
use gsv::attributes::sh_coefficients;
use gsv::conformance::Damage;
use gsv::decode::{Decoding, decode_damaged, decode_group, read_header};
use gsv::evaluate::Evaluator;
use gsv::group::Group;
use gsv::levels::Level;
use gsv::pose::Pose;
use gsv::unit::{ALL_LAYERS, UnitType};
use numpy::{IntoPyArray, PyArray1, PyArrayMethods};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

/// A decoded group: integers, and f32 attributes of any frame.
#[pyclass(frozen, module = "gscodec._native")]
pub struct DecodedGroup {
    evaluator: Evaluator,
    units: Vec<report::UnitReport>,
    damage: Vec<Damage>,
}

#[pymethods]
impl DecodedGroup {
    /// `strict`: damage is an error; otherwise `damage` lists the units that were not decoded. `reference`: the group
    /// that a predicted one refers to. `layers`: number of layers to decode, the payload may end behind them. `tiles`:
    /// [layer][tile], whether to decode the tile; None: all.
    #[new]
    #[pyo3(signature = (payload, level, strict = true, *, reference = None, layers = ALL_LAYERS, tiles = None))]
    fn new(
        py: Python,
        payload: &Bound<PyAny>,
        level: u8,
        strict: bool,
        reference: Option<Py<DecodedGroup>>,
        layers: usize,
        tiles: Option<Vec<Vec<bool>>>,
    ) -> PyResult<Self> {
        let bytes = bytes_of(payload)?.as_slice()?.to_vec(); // ours while the GIL is released
        let reference = reference.as_ref().map(|r| r.get().group());
        let decoded = py.detach(|| {
            let how = Decoding {
                level: &Level::get(level)?,
                reference,
                layers: layers.max(1),
                tiles: tiles.as_deref(),
                keep_leading: true,
                packed: false,
            };
            let (group, damage) = if strict {
                (decode_group(&bytes, &how)?, Vec::new())
            } else {
                decode_damaged(&bytes, &how)?
            };
            let header = read_header(&bytes, &how)?;
            Ok(DecodedGroup {
                units: report::units(&bytes, &header, reference.map(|r| &r.header), how.layers)?,
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

    /// How many groups back the reference is; 0: the group is independent.
    #[getter]
    fn reference(&self) -> u16 {
        self.group().header.reference
    }

    #[getter]
    fn sh_degree(&self) -> u8 {
        self.evaluator.group().header.sh_degree
    }

    /// The integers, a `QuantizedGroup` as encode_group takes it.
    fn quantized<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        quantized(py, &self.evaluator)
    }

    /// The result of decoding `group` (a `QuantizedGroup`), computed without bytes.
    #[staticmethod]
    #[pyo3(signature = (group, reference = None))]
    fn reconstruct(py: Python, group: &Bound<PyAny>, reference: Option<Py<DecodedGroup>>) -> PyResult<Self> {
        let reference = reference.as_ref().map(|r| r.get().group());
        let group = group_from(group, reference)?;
        let evaluator = py
            .detach(|| Evaluator::reconstruct(group, reference))
            .map_err(|e| raise(py, e))?;
        Ok(DecodedGroup {
            evaluator,
            units: Vec::new(),
            damage: Vec::new(),
        })
    }

    /// Canonical attributes of all Gaussians, f32, as `frame` gives those of a frame.
    fn canonical<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        canonical(py, &self.evaluator.parametric(), sh_coefficients(self.sh_degree()))
    }

    /// Motion by the nodes alone in all frames: means [T, N, 3] f32 and rotations [T, N, 4] f32 wxyz of the Gaussians.
    fn carried<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        carried(py, &self.evaluator.parametric())
    }

    /// Nodes [N, k] u32 that carry each Gaussian, and weights [N, k] f32; k is 0 without nodes.
    fn blend<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let blend = self.evaluator.blend();
        let shape = [self.count(), blend.per];
        let index = blend.index.clone().into_pyarray(py).reshape(shape)?.into_any();
        Ok((index, blend.weight.clone().into_pyarray(py).reshape(shape)?.into_any()))
    }

    /// Attributes of frame `t` of all Gaussians, f32: views of one array, since few large pages are allocated faster
    /// than many small ones. `pose`: places the Gaussians, as `pose_at` returns it.
    #[pyo3(signature = (t, pose = None))]
    fn frame<'py>(&self, py: Python<'py>, t: u16, pose: Option<PoseTuple>) -> PyResult<Bound<'py, PyDict>> {
        self.check(t)?;
        let pose = pose.map_or(Pose::default(), pose_from);
        frame(
            py,
            &self.evaluator.parametric(),
            t,
            sh_coefficients(self.sh_degree()),
            &pose,
        )
    }

    /// [N] bool: which Gaussians frame `t` shows; None: all.
    fn visible<'py>(&self, py: Python<'py>, t: u16) -> PyResult<Option<Bound<'py, PyArray1<bool>>>> {
        self.check(t)?;
        Ok(self.evaluator.visible(t).map(|v| v.into_pyarray(py)))
    }

    /// Report of the units and streams of the payload.
    fn units<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        report::units_into(py, &self.units)
    }

    /// The tiles of each layer, as dicts of gaussians (decoded), low, high: corners of the box of their visible extent,
    /// world units.
    fn tiles<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        report::tiles(py, self.group())
    }

    /// Damaged units, and units that need a damaged one: dicts of unit, type, layer, tile, message.
    fn damage<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let list = PyList::empty(py);
        for damage in &self.damage {
            let d = PyDict::new(py);
            d.set_item("unit", damage.unit)?;
            d.set_item("type", damage.kind.map_or("unknown", |k| k.name()))?;
            d.set_item("layer", damage.layer)?;
            d.set_item("tile", (damage.kind == Some(UnitType::Tile)).then_some(damage.index))?;
            d.set_item("message", &damage.message)?;
            list.append(d)?;
        }
        Ok(list)
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

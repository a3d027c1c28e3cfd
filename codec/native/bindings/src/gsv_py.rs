//! Python face of the bitstream core: dicts of arrays <-> groups, config dicts <-> container. Planar [C, N] arrays on the
//! Python side, interleaved ones in Rust. Long work releases the GIL.

use gsv::attributes::{Attribute, sh_coefficients};
use gsv::container::config::{COLOR_SPACES, Camera, Config, SH_FRAMES, UP_AXES, rate};
use gsv::container::demux::Demuxer;
use gsv::container::write::{self, Reference};
use gsv::error::Error;
use gsv::evaluate::{Evaluator, Frame};
use gsv::group::Group;
use gsv::header::{Header, NodeHeader, Scale, TrajectoryHeader};
use gsv::levels::{LEVELS, Level};
use gsv::map::Map;
use gsv::trajectories::Trajectories;
use gsv::unit;
use numpy::ndarray::{Array2, Array3};
use numpy::{
    IntoPyArray, PyArray1, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyList};

pub fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(morton_order, m)?)?;
    m.add_function(wrap_pyfunction!(node_weights, m)?)?;
    m.add_function(wrap_pyfunction!(encode_group, m)?)?;
    m.add_function(wrap_pyfunction!(units, m)?)?;
    m.add_function(wrap_pyfunction!(levels, m)?)?;
    m.add_function(wrap_pyfunction!(init_segment, m)?)?;
    m.add_function(wrap_pyfunction!(fragment, m)?)?;
    m.add_function(wrap_pyfunction!(finish, m)?)?;
    m.add_function(wrap_pyfunction!(demux, m)?)?;
    m.add_class::<DecodedGroup>()
}

/// The exception of gscodec.errors that blames the right one.
fn raise(py: Python, e: Error) -> PyErr {
    let class = match &e {
        Error::Bitstream { .. } => "BitstreamError",
        Error::Limit { .. } => "LimitError",
        Error::Input(message) => return PyValueError::new_err(message.clone()),
    };
    let found = py
        .import("gscodec.errors")
        .and_then(|m| m.getattr(class))
        .and_then(|c| c.call1((e.to_string(),)));
    match found {
        Ok(exception) => PyErr::from_value(exception),
        Err(failed) => failed,
    }
}

fn invalid<T>(message: String) -> PyResult<T> {
    Err(PyValueError::new_err(message))
}

/// The bytes of any object with the buffer protocol, without a copy (the stable ABI of Python 3.10 has no buffers, numpy has).
fn bytes_of<'py>(data: &Bound<'py, PyAny>) -> PyResult<PyReadonlyArray1<'py, u8>> {
    let a = data.py().import("numpy")?.call_method1("frombuffer", (data, "uint8"))?;
    a.extract()
}

fn item<'py>(d: &Bound<'py, PyDict>, key: &str) -> PyResult<Bound<'py, PyAny>> {
    match d.get_item(key)? {
        Some(v) if !v.is_none() => Ok(v),
        _ => invalid(format!("expected the key '{key}'")),
    }
}

fn optional<'py>(d: &Bound<'py, PyDict>, key: &str) -> PyResult<Option<Bound<'py, PyAny>>> {
    Ok(d.get_item(key)?.filter(|v| !v.is_none()))
}

fn value<'py, T: for<'a> FromPyObject<'a, 'py>>(d: &Bound<'py, PyDict>, key: &str) -> PyResult<T> {
    let v = item(d, key)?;
    v.extract()
        .or_else(|_| invalid(format!("'{key}': unexpected value {v}")))
}

/// `key` converted to a contiguous array of `dtype`, if that changes no value.
fn array<'py>(d: &Bound<'py, PyDict>, key: &str, dtype: &str) -> PyResult<Bound<'py, PyAny>> {
    let np = d.py().import("numpy")?;
    let v = np.call_method1("asarray", (item(d, key)?,))?;
    let out = np.call_method1("ascontiguousarray", (&v, dtype))?;
    if !np.call_method1("array_equal", (&v, &out))?.extract::<bool>()? {
        return invalid(format!("'{key}': expected integers that fit {dtype}"));
    }
    Ok(out)
}

fn points(d: &Bound<PyDict>, key: &str) -> PyResult<Vec<[u32; 3]>> {
    let a = array(d, key, "uint32")?;
    let Ok(a) = a.extract::<PyReadonlyArray2<u32>>() else {
        return invalid(format!("'{key}': expected shape [N, 3]"));
    };
    rows(&a, key)
}

fn rows(a: &PyReadonlyArray2<u32>, key: &str) -> PyResult<Vec<[u32; 3]>> {
    if a.shape()[1] != 3 {
        return invalid(format!("{key}: expected shape [N, 3], got {:?}", a.shape()));
    }
    Ok(a.as_array().outer_iter().map(|r| [r[0], r[1], r[2]]).collect())
}

/// Stable permutation [N] u32 that puts positions [N, 3] u32 into Morton order.
#[pyfunction]
fn morton_order<'py>(py: Python<'py>, positions: PyReadonlyArray2<'py, u32>) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let p = rows(&positions, "positions")?;
    if p.iter().flatten().any(|v| *v >= 1 << 21) {
        return invalid("positions: expected grid coordinates below 2^21".into());
    }
    Ok(py.detach(|| gsv::morton::order(&p)).into_pyarray(py))
}

/// Nodes [N, k] u32 and weights [N, k] f32 by which each Gaussian blends the motion of its nearest nodes (spec 13.2).
#[pyfunction]
fn node_weights<'py>(
    py: Python<'py>,
    positions: PyReadonlyArray2<'py, u32>,
    nodes: PyReadonlyArray2<'py, u32>,
    neighbors: usize,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let (p, n) = (rows(&positions, "positions")?, rows(&nodes, "nodes")?);
    if !(1..=gsv::blend::NEIGHBORS_MAX).contains(&neighbors) {
        return invalid(format!(
            "expected 1 to {} neighbors, got {neighbors}",
            gsv::blend::NEIGHBORS_MAX
        ));
    }
    let blend = py.detach(|| gsv::blend::Blend::new(&p, &n, neighbors));
    let shape = [p.len(), blend.per];
    let index = blend.index.into_pyarray(py).reshape(shape)?.into_any();
    Ok((index, blend.weight.into_pyarray(py).reshape(shape)?.into_any()))
}

/// Encodes a group of integers: payload and a report per unit.
#[pyfunction]
fn encode_group<'py>(
    py: Python<'py>,
    group: &Bound<'py, PyDict>,
) -> PyResult<(Bound<'py, PyBytes>, Bound<'py, PyList>)> {
    let group = group_from(group)?;
    let payload = py
        .detach(|| gsv::encode::encode_group(&group))
        .map_err(|e| raise(py, e))?;
    let report = units_of(py, &payload)?;
    Ok((PyBytes::new(py, &payload), report))
}

/// The units of a payload: dicts of unit, type, attribute, layer, offset, bytes.
#[pyfunction]
fn units<'py>(py: Python<'py>, payload: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyList>> {
    units_of(py, bytes_of(payload)?.as_slice()?)
}

fn units_of<'py>(py: Python<'py>, payload: &[u8]) -> PyResult<Bound<'py, PyList>> {
    let list = PyList::empty(py);
    for (i, u) in unit::split(payload).map_err(|e| raise(py, e))?.iter().enumerate() {
        let d = PyDict::new(py);
        d.set_item("unit", i)?;
        d.set_item("type", u.kind.map_or("unknown", |k| k.name()))?;
        d.set_item("attribute", u.attribute.map(|a| a.name()))?;
        d.set_item("layer", u.layer)?;
        d.set_item("offset", u.offset)?;
        d.set_item("bytes", u.size)?;
        list.append(d)?;
    }
    Ok(list)
}

fn group_from(d: &Bound<PyDict>) -> PyResult<Group> {
    let positions = points(d, "positions")?;
    let channels: Bound<PyDict> = value(d, "channels")?;
    let mut header = Header {
        frames: value(d, "frames")?,
        origin: value(d, "origin")?,
        grid_step: value(d, "grid_step")?,
        grid_bits: value(d, "grid_bits")?,
        count: positions.len() as u32,
        sh_degree: sh_degree(&channels)?,
        ..Header::default()
    };
    let mut group = Group {
        positions,
        ..Group::default()
    };
    for a in header.attributes() {
        let c: Bound<PyDict> = value(&channels, a.name())?;
        let width = a.channels(header.sh_degree);
        group.channels.push(planar(
            &array(&c, "values", "int32")?,
            a.name(),
            width,
            group.positions.len(),
        )?);
        let (steps, offsets): (Vec<f32>, Vec<f32>) = (value(&c, "steps")?, value(&c, "offsets")?);
        if steps.len() != width || offsets.len() != width {
            return invalid(format!("{}: expected {width} steps and offsets", a.name()));
        }
        header.scales.push(Scale { steps, offsets });
    }
    if let Some(t) = optional(d, "trajectories")? {
        let t: Bound<PyDict> = t.extract()?;
        motion_from(&t, &mut header, &mut group)?;
    }
    if let Some(n) = optional(d, "nodes")? {
        let n: Bound<PyDict> = n.extract()?;
        nodes_from(&n, &mut header, &mut group)?;
    }
    if optional(d, "lifetimes")?.is_some() {
        let a = array(d, "lifetimes", "uint16")?;
        let Ok(a) = a.extract::<PyReadonlyArray2<u16>>() else {
            return invalid("lifetimes: expected shape [N, 2]".into());
        };
        if a.shape()[1] != 2 {
            return invalid(format!("lifetimes: expected shape [N, 2], got {:?}", a.shape()));
        }
        group.lifetimes = Some(a.as_array().outer_iter().map(|r| [r[0], r[1]]).collect());
    }
    group.header = header;
    Ok(group)
}

fn sh_degree(channels: &Bound<PyDict>) -> PyResult<u8> {
    for key in channels.keys().iter() {
        let name: String = key.extract()?;
        if !Attribute::canonical(3).iter().any(|a| a.name() == name) {
            return invalid(format!("channels: unknown attribute '{name}'"));
        }
    }
    let Some(sh) = optional(channels, "shN")? else {
        return Ok(0);
    };
    let sh: Bound<PyDict> = sh.extract()?;
    let width: usize = item(&sh, "values")?.len()?;
    match (0..=3u8).find(|d| 3 * sh_coefficients(*d) == width) {
        Some(d) => Ok(d),
        None => invalid(format!("shN: expected 0, 9, 24 or 45 channels, got {width}")),
    }
}

/// [C, N] -> C per Gaussian.
fn planar(a: &Bound<PyAny>, name: &str, channels: usize, count: usize) -> PyResult<Vec<i32>> {
    let Ok(a) = a.extract::<PyReadonlyArray2<i32>>() else {
        return invalid(format!("{name}: expected shape [C, N]"));
    };
    if a.shape() != [channels, count] {
        return invalid(format!(
            "{name}: expected shape [{channels}, {count}], got {:?}",
            a.shape()
        ));
    }
    Ok(a.as_array().t().iter().copied().collect())
}

fn motion_from(t: &Bound<PyDict>, header: &mut Header, group: &mut Group) -> PyResult<()> {
    for key in t.keys().iter() {
        let name: String = key.extract()?;
        if !Attribute::ALL.iter().any(|a| a.name() == name) {
            return invalid(format!("trajectories: unknown attribute '{name}'"));
        }
    }
    for attribute in Attribute::ALL {
        let Some(a) = optional(t, attribute.name())? else {
            continue;
        };
        let a: Bound<PyDict> = a.extract()?;
        let channels = attribute.channels(header.sh_degree);
        let (coefficients, out) = coefficients(&a, attribute.name(), channels, group.positions.len())?;
        header.trajectories.push(TrajectoryHeader {
            attribute,
            coefficients,
            step: value(&a, "step")?,
        });
        group.trajectories.push(out);
    }
    Ok(())
}

/// `coefficients` [K, C, N] -> K and sparse trajectories.
fn coefficients(d: &Bound<PyDict>, name: &str, channels: usize, count: usize) -> PyResult<(u16, Trajectories)> {
    let a = array(d, "coefficients", "int32")?;
    let Ok(a) = a.extract::<PyReadonlyArray3<i32>>() else {
        return invalid(format!("trajectories of {name}: expected shape [K, C, N]"));
    };
    let &[k, c, n] = a.shape() else {
        return invalid(format!("trajectories of {name}: expected shape [K, C, N]"));
    };
    if (c, n) != (channels, count) || k == 0 || k > usize::from(u16::MAX) {
        return invalid(format!(
            "trajectories of {name}: expected shape [K, {channels}, {count}], got {:?}",
            a.shape()
        ));
    }
    let view = a.as_array();
    let flat: Vec<i32> = view.permuted_axes([2, 0, 1]).iter().copied().collect();
    let mut out = Trajectories::new(channels);
    (0..n).for_each(|i| out.push(flat.get(i * k * c..(i + 1) * k * c).unwrap_or(&[])));
    Ok((k as u16, out))
}

fn nodes_from(d: &Bound<PyDict>, header: &mut Header, group: &mut Group) -> PyResult<()> {
    group.node_positions = points(d, "positions")?;
    if group.node_positions.is_empty() {
        return Ok(());
    }
    let (k, t) = coefficients(d, "nodes", 6, group.node_positions.len())?;
    group.node_trajectories = t;
    header.nodes = NodeHeader {
        count: group.node_positions.len() as u32,
        neighbors: value(d, "neighbors")?,
        coefficients: k,
        rotation_step: value(d, "rotation_step")?,
        translation_step: value(d, "translation_step")?,
    };
    Ok(())
}

/// A decoded group: integers, and f32 attributes of any frame.
#[pyclass(frozen, module = "gscodec._native")]
struct DecodedGroup {
    evaluator: Evaluator,
    units: Vec<(String, Option<&'static str>, u8, usize, usize)>,
}

#[pymethods]
impl DecodedGroup {
    #[new]
    fn new(py: Python, payload: &Bound<PyAny>, level: u8) -> PyResult<Self> {
        let bytes = bytes_of(payload)?.as_slice()?.to_vec(); // ours while the GIL is released
        let decoded = py.detach(|| {
            let group = gsv::decode::decode_group(&bytes, &Level::get(level)?)?;
            let units = unit::split(&bytes)?;
            let label = |u: &unit::Unit| u.kind.map_or("unknown", |k| k.name()).to_string();
            let units = units
                .iter()
                .map(|u| (label(u), u.attribute.map(|a| a.name()), u.layer, u.offset, u.size));
            Ok(DecodedGroup {
                units: units.collect(),
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
    fn count(&self) -> u32 {
        self.evaluator.group().header.count
    }

    #[getter]
    fn sh_degree(&self) -> u8 {
        self.evaluator.group().header.sh_degree
    }

    /// The group as encode_group takes it.
    fn integers<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        integers(py, &self.evaluator)
    }

    /// Attributes of frame `t` of all Gaussians, f32.
    fn frame<'py>(&self, py: Python<'py>, t: u16) -> PyResult<Bound<'py, PyDict>> {
        self.check(t)?;
        let mut frame = Frame::default();
        py.detach(|| self.evaluator.frame(t, &mut frame));
        let n = self.count() as usize;
        let k = sh_coefficients(self.sh_degree());
        let d = PyDict::new(py);
        let flat = |v: Vec<[f32; 3]>| v.into_flattened().into_pyarray(py).reshape([n, 3]);
        d.set_item("means", flat(frame.means)?)?;
        d.set_item("quats", frame.quats.into_flattened().into_pyarray(py).reshape([n, 4])?)?;
        d.set_item("log_scales", frame.log_scales.into_pyarray(py).reshape([n, 3])?)?;
        d.set_item("logit_opacities", frame.logit_opacities.into_pyarray(py))?;
        d.set_item("sh0", frame.sh0.into_pyarray(py).reshape([n, 3])?)?;
        d.set_item("shN", frame.sh_n.into_pyarray(py).reshape([n, k, 3])?)?;
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

    /// Attribute maps (spec 7.2): name of the channel -> [H, W] i32; cells without a Gaussian are 0.
    fn maps<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let group = self.evaluator.group();
        let map = Map::new(group.positions.len());
        let d = PyDict::new(py);
        for a in 0..3 {
            d.set_item(
                format!("means_{a}"),
                map.arrange(|i| group.positions[i][a] as i32)
                    .into_pyarray(py)
                    .reshape([map.height, map.width])?,
            )?;
        }
        for (a, values) in group.header.attributes().iter().zip(&group.channels) {
            let channels = a.channels(group.header.sh_degree);
            for c in 0..channels {
                let cells = map.arrange(|i| values[i * channels + c]);
                d.set_item(
                    format!("{}_{c}", a.name()),
                    cells.into_pyarray(py).reshape([map.height, map.width])?,
                )?;
            }
        }
        Ok(d)
    }
}

impl DecodedGroup {
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
        channels.set_item(a.name(), one)?;
    }
    d.set_item("channels", channels)?;
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

/// The caps of each level (spec 5), as dicts.
#[pyfunction]
fn levels<'py>(py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
    let list = PyList::empty(py);
    for l in LEVELS {
        let d = PyDict::new(py);
        d.set_item("level", l.level)?;
        d.set_item("gaussians", l.gaussians)?;
        d.set_item("frames", l.frames)?;
        d.set_item("nodes", l.nodes)?;
        d.set_item("symbols", l.symbols)?;
        d.set_item("bytes", l.bytes)?;
        list.append(d)?;
    }
    Ok(list)
}

fn config_from(py: Python, d: &Bound<PyDict>) -> PyResult<Config> {
    let fps = item(d, "fps")?;
    let (timescale, frame_duration) = match fps.extract::<(u32, u32)>() {
        Ok((n, d)) if n > 0 && d > 0 => (n, d),
        Ok(_) => return invalid(format!("fps: expected a positive rational, got {fps}")),
        Err(_) => rate(value(d, "fps")?).map_err(|e| raise(py, e))?,
    };
    let choice = |key: &str, names: &[&str]| -> PyResult<u8> {
        let v: String = value(d, key)?;
        match names.iter().position(|n| *n == v) {
            Some(i) => Ok(i as u8),
            None => invalid(format!("{key}: expected one of {}, got '{v}'", names.join(", "))),
        }
    };
    let mut config = Config {
        timescale,
        frame_duration,
        level: value(d, "level")?,
        metres_per_unit: value(d, "metres_per_unit")?,
        up_axis: choice("up", &UP_AXES)?,
        color_space: choice("color_space", &COLOR_SPACES)?,
        background: value(d, "background")?,
        sh_degree: value(d, "sh_degree")?,
        sh_frame: choice("sh_frame", &SH_FRAMES)?,
        cameras: Vec::new(),
    };
    Level::get(config.level).map_err(|e| PyValueError::new_err(e.to_string()))?;
    if let Some(cameras) = optional(d, "cameras")? {
        for c in cameras.try_iter()? {
            config.cameras.push(camera_from(&c?.extract()?)?);
        }
    }
    Ok(config)
}

fn camera_from(d: &Bound<PyDict>) -> PyResult<Camera> {
    let np = d.py().import("numpy")?;
    let matrix = |key: &str, n: usize| -> PyResult<Vec<f64>> {
        let a = np.call_method1("asarray", (item(d, key)?, "float64"))?;
        if a.getattr("shape")?.extract::<Vec<usize>>()? != [n, n] {
            return invalid(format!("camera {key}: expected shape [{n}, {n}]"));
        }
        a.call_method0("ravel")?.call_method0("tolist")?.extract()
    };
    let (k, v) = (matrix("K", 3)?, matrix("viewmat", 4)?);
    if [k[3], k[6], k[7], k[8]] != [0.0, 0.0, 0.0, 1.0] {
        return invalid("camera K: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]]".into());
    }
    if v[12..] != [0.0, 0.0, 0.0, 1.0] {
        return invalid("camera viewmat: expected a last row of 0, 0, 0, 1".into());
    }
    Ok(Camera {
        name: value(d, "name")?,
        width: value(d, "width")?,
        height: value(d, "height")?,
        k: [k[0], k[1], k[2], k[4], k[5]].map(|v| v as f32),
        viewmat: std::array::from_fn(|i| v[i] as f32),
    })
}

fn config_into<'py>(py: Python<'py>, c: &Config) -> PyResult<Bound<'py, PyDict>> {
    let name = |names: &[&'static str], i: u8| names.get(usize::from(i)).copied();
    let d = PyDict::new(py);
    d.set_item("fps", (c.timescale, c.frame_duration))?;
    d.set_item("level", c.level)?;
    d.set_item("metres_per_unit", c.metres_per_unit)?;
    d.set_item("up", name(&UP_AXES, c.up_axis))?;
    d.set_item("color_space", name(&COLOR_SPACES, c.color_space))?;
    d.set_item("background", c.background.to_vec())?;
    d.set_item("sh_degree", c.sh_degree)?;
    d.set_item("sh_frame", name(&SH_FRAMES, c.sh_frame))?;
    let cameras = PyList::empty(py);
    for c in &c.cameras {
        let [fx, skew, cx, fy, cy] = c.k.map(f64::from);
        let mut v: Vec<f64> = c.viewmat.iter().map(|v| f64::from(*v)).collect();
        v.extend([0.0, 0.0, 0.0, 1.0]);
        let one = PyDict::new(py);
        one.set_item("name", &c.name)?;
        one.set_item(
            "K",
            vec![fx, skew, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
                .into_pyarray(py)
                .reshape([3, 3])?,
        )?;
        one.set_item("viewmat", v.into_pyarray(py).reshape([4, 4])?)?;
        one.set_item("width", c.width)?;
        one.set_item("height", c.height)?;
        cameras.append(one)?;
    }
    d.set_item("cameras", cameras)?;
    Ok(d)
}

/// ftyp and moov: what opens a file.
#[pyfunction]
fn init_segment<'py>(py: Python<'py>, config: &Bound<'py, PyDict>) -> PyResult<Bound<'py, PyBytes>> {
    let out = write::init_segment(&config_from(py, config)?).map_err(|e| raise(py, e))?;
    Ok(PyBytes::new(py, &out))
}

/// moof and mdat of one group; sequence numbers count from 1, frames from 0.
#[pyfunction]
fn fragment<'py>(
    py: Python<'py>,
    payload: &Bound<'py, PyAny>,
    sequence_number: u32,
    start_frame: u64,
    frames: u32,
    sync: bool,
    config: &Bound<'py, PyDict>,
) -> PyResult<Bound<'py, PyBytes>> {
    let config = config_from(py, config)?;
    let out = write::fragment(
        bytes_of(payload)?.as_slice()?,
        sequence_number,
        start_frame,
        frames,
        sync,
        &config,
    )
    .map_err(|e| raise(py, e))?;
    Ok(PyBytes::new(py, &out))
}

/// What precedes the fragments of a finished file: `init` and an index of (fragment size, frames, sync).
#[pyfunction]
fn finish<'py>(
    py: Python<'py>,
    init: &Bound<'py, PyAny>,
    index: Vec<(u64, u32, bool)>,
) -> PyResult<Bound<'py, PyBytes>> {
    let mut demuxer = Demuxer::default();
    let init = bytes_of(init)?;
    let init = init.as_slice()?;
    demuxer.push(init).map_err(|e| raise(py, e))?;
    let Some(config) = demuxer.config() else {
        return invalid("expected an init segment".into());
    };
    let groups: Vec<Reference> = index
        .into_iter()
        .map(|(size, frames, sync)| Reference { size, frames, sync })
        .collect();
    let out = write::finish(init, config, &groups).map_err(|e| raise(py, e))?;
    Ok(PyBytes::new(py, &out))
}

/// Bytes that the demuxer is shown at a time between the boxes that it passes over.
const LOOK: usize = 4096;

/// Config and groups of a file in any object with the buffer protocol; only headers are read.
#[pyfunction]
fn demux<'py>(py: Python<'py>, buffer: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyDict>> {
    let data = bytes_of(buffer)?;
    let data = data.as_slice()?;
    let mut demuxer = Demuxer::default();
    let mut at = 0;
    while at < data.len() {
        let skip = usize::try_from(demuxer.skippable())
            .unwrap_or(usize::MAX)
            .min(data.len() - at);
        if skip > 0 {
            demuxer.skip(skip as u64);
            at += skip;
            continue;
        }
        let to = data.len().min(at + LOOK);
        demuxer.push(&data[at..to]).map_err(|e| raise(py, e))?;
        at = to;
    }
    let Some(config) = demuxer.config() else {
        return Err(raise(
            py,
            Error::bitstream(at, "file", "a moov box, found the end of the data"),
        ));
    };
    let d = PyDict::new(py);
    d.set_item("config", config_into(py, config)?)?;
    let groups = PyList::empty(py);
    for g in demuxer.groups() {
        let one = PyDict::new(py);
        one.set_item("offset", g.offset)?;
        one.set_item("size", g.size)?;
        one.set_item("start_frame", g.start_frame)?;
        one.set_item("frames", g.frames)?;
        one.set_item("sync", g.sync)?;
        groups.append(one)?;
    }
    d.set_item("groups", groups)?;
    d.set_item("complete", demuxer.complete())?;
    Ok(d)
}

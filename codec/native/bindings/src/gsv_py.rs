//! Python face of the bitstream core: QuantizedGroup <-> group, config dicts <-> container. Planar [C, N] arrays on the
//! Python side, interleaved ones in Rust. Long work releases the GIL.

mod container;
mod decoded;
mod group_from;
mod parametric;
mod placement;
mod quantized_from;
mod report;
mod reposing;
mod rig;
mod rigid_blend;
mod values;

use gsv::attributes::Attribute;
use gsv::evaluate::Evaluator;
use gsv::levels::LEVELS;
use gsv::unit::{self, ALL_LAYERS};
use numpy::{IntoPyArray, PyArray1, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyList};
use values::{bytes_of, invalid, raise, rows};

/// Gaussians of a tile, unless the group says otherwise.
const TILE_CELLS: usize = 1 << 12;

pub fn register(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add_function(wrap_pyfunction!(morton_order, m)?)?;
    m.add_function(wrap_pyfunction!(node_weights, m)?)?;
    m.add_function(wrap_pyfunction!(context_neighbors, m)?)?;
    m.add_function(wrap_pyfunction!(quantize_rotations, m)?)?;
    m.add_function(wrap_pyfunction!(encode_group, m)?)?;
    m.add_function(wrap_pyfunction!(units, m)?)?;
    m.add_function(wrap_pyfunction!(reference_of, m)?)?;
    m.add_function(wrap_pyfunction!(levels, m)?)?;
    m.add_function(wrap_pyfunction!(container::init_segment, m)?)?;
    m.add_function(wrap_pyfunction!(container::fragment, m)?)?;
    m.add_function(wrap_pyfunction!(container::finish, m)?)?;
    m.add_function(wrap_pyfunction!(container::track_count, m)?)?;
    m.add_function(wrap_pyfunction!(container::demux, m)?)?;
    m.add_function(wrap_pyfunction!(container::read_audio, m)?)?;
    m.add_function(wrap_pyfunction!(placement::pose_at, m)?)?;
    m.add_function(wrap_pyfunction!(rigid_blend::blend_rigid, m)?)?;
    m.add_function(wrap_pyfunction!(rigid_blend::node_gradients, m)?)?;
    m.add_function(wrap_pyfunction!(rigid_blend::quat_product, m)?)?;
    m.add_function(wrap_pyfunction!(rigid_blend::turned_harmonics, m)?)?;
    m.add_function(wrap_pyfunction!(rig::rig_motion, m)?)?;
    m.add_function(wrap_pyfunction!(reposing::repose, m)?)?;
    m.add_function(wrap_pyfunction!(attributes, m)?)?;
    m.add_class::<parametric::ParametricEvaluator>()?;
    m.add_class::<decoded::DecodedGroup>()
}

/// Rows of a matrix of grid points.
fn grid(a: &PyReadonlyArray2<u32>, name: &str) -> PyResult<Vec<[u32; 3]>> {
    let p = rows(a, name)?;
    if p.iter().flatten().any(|v| *v >= 1 << 21) {
        return invalid(format!("{name}: expected grid coordinates below 2^21"));
    }
    Ok(p)
}

/// Stable permutation [N] u32 that puts positions [N, 3] u32 into Morton order.
#[pyfunction]
fn morton_order<'py>(py: Python<'py>, positions: PyReadonlyArray2<'py, u32>) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let p = grid(&positions, "positions")?;
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
    let (p, n) = (grid(&positions, "positions")?, grid(&nodes, "nodes")?);
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

/// Contexts of the entropy coder (spec 7.3): [N, 4] i64, for each of the positions [N, 3] u32 (in Morton order) the
/// nearest of those just before it, nearest first; its own index where there is none. `cells`: most Gaussians of a
/// tile.
#[pyfunction]
#[pyo3(signature = (positions, cells = TILE_CELLS))]
fn context_neighbors<'py>(
    py: Python<'py>,
    positions: PyReadonlyArray2<'py, u32>,
    cells: usize,
) -> PyResult<Bound<'py, PyAny>> {
    let p = grid(&positions, "positions")?;
    let near = py.detach(|| gsv::neighbors::nearest_in_tiles(&p, cells));
    let own = near.iter().enumerate().flat_map(|(i, near)| {
        let known = move |j: &u32| if *j == u32::MAX { i as i64 } else { i64::from(*j) };
        near.iter().map(known).collect::<Vec<_>>()
    });
    let flat: Vec<i64> = own.collect();
    Ok(flat
        .into_pyarray(py)
        .reshape([p.len(), gsv::neighbors::NEAR])?
        .into_any())
}

/// Quaternions [N, 4] f32 of the births of a layer -> integers [N, 3] i32 of quats, and the form [N] u8 of each: the
/// quaternion was multiplied from the right by the inverse of 1, i, j or k (form 0 to 3).
///
/// `steps` [N, 3] f32; `positions` [N, 3] u32 in Morton order; `worth` [N, 3] f32: cost in bits of an error of one
/// step, x^2 times as much for x steps; `lengths` [3, 31, 31] f32, flat: bits of an integer (last) in a context, from
/// -15 to 15 each; empty: all integers cost the same. `cells`: most Gaussians of a tile.
#[pyfunction]
#[pyo3(signature = (quats, steps, positions, worth, lengths, cells = TILE_CELLS))]
fn quantize_rotations<'py>(
    py: Python<'py>,
    quats: PyReadonlyArray2<'py, f32>,
    steps: PyReadonlyArray2<'py, f32>,
    positions: PyReadonlyArray2<'py, u32>,
    worth: PyReadonlyArray2<'py, f32>,
    lengths: PyReadonlyArray1<'py, f32>,
    cells: usize,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let p = grid(&positions, "positions")?;
    let (quats, steps, worth) = (quats.as_slice()?, steps.as_slice()?, worth.as_slice()?);
    let lengths = lengths.as_slice()?;
    if [quats.len() / 4, steps.len() / 3, worth.len() / 3] != [p.len(); 3] {
        return invalid(format!(
            "expected as many quats, steps and worths as positions, {}",
            p.len()
        ));
    }
    let residuals = gsv::rotation_residuals::RotationResiduals {
        quats: quats.as_chunks().0,
        steps: steps.as_chunks().0,
        error_bits: worth.as_chunks().0,
        lengths,
    };
    let coded = py.detach(|| residuals.quantize(&gsv::neighbors::nearest_in_tiles(&p, cells)));
    let integers: Vec<i32> = coded.iter().flat_map(|c| c.integers).collect();
    let forms: Vec<u8> = coded.iter().map(|c| c.form).collect();
    Ok((
        integers.into_pyarray(py).reshape([p.len(), 3])?.into_any(),
        forms.into_pyarray(py).into_any(),
    ))
}

/// Encodes a `QuantizedGroup`: payload and a report per unit. A predicted group needs the group that it refers to.
#[pyfunction]
#[pyo3(signature = (group, reference = None))]
fn encode_group<'py>(
    py: Python<'py>,
    group: &Bound<'py, PyAny>,
    reference: Option<Py<decoded::DecodedGroup>>,
) -> PyResult<(Bound<'py, PyBytes>, Bound<'py, PyList>)> {
    let reference = reference.as_ref().map(|r| r.get().group());
    let group = group_from::group_from(group, reference)?;
    let (payload, units) = py
        .detach(|| {
            let mut evaluator = Evaluator::reconstruct(group, reference)?;
            gsv::tile_bounds::set(&mut evaluator);
            let group = evaluator.into_group();
            let payload = gsv::encode::encode_group(&group, reference)?;
            let units = report::units(&payload, &group.header, reference.map(|r| &r.header), ALL_LAYERS)?;
            Ok((payload, units))
        })
        .map_err(|e| raise(py, e))?;
    Ok((PyBytes::new(py, &payload), report::units_into(py, &units)?))
}

/// The units of a payload: dicts of unit, type, layer, index, offset, bytes. Unit 0 is the header.
#[pyfunction]
fn units<'py>(py: Python<'py>, payload: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyList>> {
    units_of(py, bytes_of(payload)?.as_slice()?)
}

/// How many groups back the group of a payload refers, 0: it is independent; only its header is read.
#[pyfunction]
fn reference_of<'py>(py: Python<'py>, payload: &Bound<'py, PyAny>) -> PyResult<u16> {
    gsv::decode::reference_of(bytes_of(payload)?.as_slice()?).map_err(|e| raise(py, e))
}

fn units_of<'py>(py: Python<'py>, payload: &[u8]) -> PyResult<Bound<'py, PyList>> {
    let list = PyList::empty(py);
    for (i, u) in unit::split(payload, unit::ALL_LAYERS)
        .map_err(|e| raise(py, e))?
        .iter()
        .enumerate()
    {
        let d = PyDict::new(py);
        d.set_item("unit", i)?;
        d.set_item("type", u.kind.map_or("unknown", |k| k.name()))?;
        d.set_item("layer", u.layer)?;
        d.set_item("index", u.index)?;
        d.set_item("offset", u.offset)?;
        d.set_item("bytes", u.size)?;
        list.append(d)?;
    }
    Ok(list)
}

/// The attribute table (spec 3.2): dicts of name, number, channels (of shN for one coefficient), companded.
#[pyfunction]
fn attributes<'py>(py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
    let list = PyList::empty(py);
    for a in Attribute::ALL {
        let d = PyDict::new(py);
        d.set_item("name", a.name())?;
        d.set_item("number", a as u8)?;
        d.set_item("channels", a.channels(1) / if a == Attribute::ShN { 3 } else { 1 })?;
        d.set_item(
            "companded",
            [Attribute::LogScales, Attribute::LogitOpacities].contains(&a),
        )?;
        list.append(d)?;
    }
    Ok(list)
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
        d.set_item("pairs", l.pairs)?;
        d.set_item("symbols", l.symbols)?;
        d.set_item("bytes", l.bytes)?;
        list.append(d)?;
    }
    Ok(list)
}

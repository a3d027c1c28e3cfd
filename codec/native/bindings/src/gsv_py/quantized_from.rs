//! `gsv::group::Group` -> `gscodec.bitstream.quantized_group.QuantizedGroup`. The mirror of group_from.rs.

use super::rig::rig_into;
use gsv::companding::{Companding, PIECES};
use gsv::evaluate::Evaluator;
use gsv::group::{BIRTH, Group};
use gsv::trajectories::Trajectories;
use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

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
pub fn parents_into<'py>(py: Python<'py>, parents: &[u32]) -> Bound<'py, PyArray1<i32>> {
    let known = |p: &u32| if *p == BIRTH { -1 } else { *p as i32 };
    parents.iter().map(known).collect::<Vec<_>>().into_pyarray(py)
}

/// low, width, slopes.
fn companding_row(c: &Companding) -> [f32; 2 + PIECES] {
    let slopes = c.slopes.iter().map(|s| f32::from(*s));
    let mut row = [c.low, c.width].into_iter().chain(slopes);
    std::array::from_fn(|_| row.next().unwrap_or(0.0))
}

/// An instance of a dataclass of gscodec.bitstream.quantized_group.
fn dataclass<'py>(py: Python<'py>, name: &str, fields: &Bound<'py, PyDict>) -> PyResult<Bound<'py, PyAny>> {
    let class = py.import("gscodec.bitstream.quantized_group")?.getattr(name)?;
    class.call((), Some(fields))
}

pub fn quantized<'py>(py: Python<'py>, e: &Evaluator) -> PyResult<Bound<'py, PyAny>> {
    let (g, h) = (e.group(), &e.group().header);
    let d = PyDict::new(py);
    d.set_item("frames", h.frames)?;
    d.set_item("origin", h.origin.to_vec().into_pyarray(py))?;
    d.set_item("grid_step", h.grid_step)?;
    d.set_item("grid_bits", h.grid_bits)?;
    d.set_item("positions", grid(py, &g.positions)?)?;
    d.set_item("channels", channels_of(py, g)?)?;
    d.set_item(
        "scale_exponents",
        matrix(py, &h.scale_exponents.map(|l| l.map(i32::from)))?,
    )?;
    d.set_item("tile_side_log2", h.tile_side_log2)?;
    d.set_item("turned_harmonics", h.turned)?;
    let layers = g.layers.iter().map(|l| l.count).collect::<Vec<_>>();
    d.set_item("layers", PyTuple::new(py, layers)?)?;
    d.set_item("corrections", matrix(py, &g.corrections)?)?;
    if !h.shifts.is_empty() {
        let rows: Vec<&[u8]> = h.shifts.iter().map(|s| &s[..1 + h.attributes().len()]).collect();
        let width = 1 + h.attributes().len();
        d.set_item("shifts", rows.concat().into_pyarray(py).reshape([rows.len(), width])?)?;
    }
    if let Some(parents) = &g.parents {
        d.set_item("reference", h.reference)?;
        d.set_item("parents", parents_into(py, parents))?;
    }
    let trajectories = PyDict::new(py);
    for (head, t) in h.trajectories.iter().zip(e.trajectories()) {
        let one = PyDict::new(py);
        one.set_item("coefficients", dense(py, t, head.coefficients))?;
        one.set_item("step", head.step)?;
        trajectories.set_item(head.attribute.name(), dataclass(py, "QuantizedTrajectories", &one)?)?;
    }
    d.set_item("trajectories", trajectories)?;
    if let Some(l) = &g.lifetimes {
        d.set_item("lifetimes", matrix(py, l)?)?;
    }
    if h.nodes.count > 0 {
        let one = PyDict::new(py);
        one.set_item("positions", grid(py, &g.node_positions)?)?;
        one.set_item("coefficients", dense(py, &g.node_trajectories, h.nodes.coefficients))?;
        one.set_item("rotation_step", h.nodes.rotation_step)?;
        one.set_item("translation_step", h.nodes.translation_step)?;
        one.set_item("neighbors", h.nodes.neighbors)?;
        if let Some(rig) = &g.rig {
            let fields = rig_into(py, rig, &h.rig)?;
            fields.set_item("poses", dense(py, &rig.poses, h.frames))?;
            one.set_item("rig", dataclass(py, "QuantizedRig", &fields)?)?;
        }
        d.set_item("nodes", dataclass(py, "QuantizedNodes", &one)?)?;
    }
    dataclass(py, "QuantizedGroup", &d)
}

fn channels_of<'py>(py: Python<'py>, g: &Group) -> PyResult<Bound<'py, PyDict>> {
    let (h, channels) = (&g.header, PyDict::new(py));
    for ((a, values), scale) in h.attributes().iter().zip(&g.channels).zip(&h.scales) {
        let c = scale.steps.len();
        let planes = Array2::from_shape_fn((c, g.positions.len()), |(k, i)| values[i * c + k]);
        let one = PyDict::new(py);
        one.set_item("values", planes.into_pyarray(py))?;
        one.set_item("steps", scale.steps.clone().into_pyarray(py))?;
        one.set_item("offsets", scale.offsets.clone().into_pyarray(py))?;
        let rows: Vec<[f32; 2 + PIECES]> = h.companding_of(*a).iter().map(companding_row).collect();
        if !rows.is_empty() {
            one.set_item("companding", matrix(py, &rows)?)?;
        }
        channels.set_item(a.name(), dataclass(py, "QuantizedChannels", &one)?)?;
    }
    Ok(channels)
}

/// Rows as a matrix.
fn matrix<'py, T: numpy::Element + Copy, const C: usize>(
    py: Python<'py>,
    rows: &[[T; C]],
) -> PyResult<Bound<'py, PyAny>> {
    let flat = rows.as_flattened().to_vec().into_pyarray(py);
    Ok(flat.reshape([rows.len(), C])?.into_any())
}

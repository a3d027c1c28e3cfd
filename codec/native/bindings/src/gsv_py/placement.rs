//! Placements of tracks (spec 2.8) <-> dicts, and the pose of one at a time.

use super::values::{optional, raise, value};
use gsv::container::placement::{Key, Placement};
use gsv::pose::Pose;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// time, rotation (wxyz), translation, scale.
type KeyTuple = (i32, [f32; 4], [f32; 3], f32);

/// rotation (wxyz), translation, scale.
pub type PoseTuple = ([f32; 4], [f32; 3], f32);

pub fn pose_from((rotation, translation, scale): PoseTuple) -> Pose {
    Pose {
        rotation,
        translation,
        scale,
    }
}

/// The placement of a dict; the default one for None and for {}.
pub fn placement_from(d: Option<Bound<PyAny>>) -> PyResult<Placement> {
    let mut out = Placement::default();
    let Some(d) = d else { return Ok(out) };
    let d: Bound<PyDict> = d.extract()?;
    let key = |(time, rotation, translation, scale): KeyTuple| Key {
        time,
        pose: pose_from((rotation, translation, scale)),
    };
    if optional(&d, "name")?.is_some() {
        out.name = value(&d, "name")?;
        out.hidden = value(&d, "hidden")?;
        out.offset = value(&d, "offset")?;
        out.repeats = value(&d, "repeats")?;
        out.keys = value::<Vec<KeyTuple>>(&d, "keys")?.into_iter().map(key).collect();
    }
    Ok(out)
}

pub fn placement_into<'py>(py: Python<'py>, p: &Placement) -> PyResult<Bound<'py, PyDict>> {
    let key = |k: &Key| (k.time, k.pose.rotation, k.pose.translation, k.pose.scale);
    let d = PyDict::new(py);
    d.set_item("name", &p.name)?;
    d.set_item("hidden", p.hidden)?;
    d.set_item("offset", p.offset)?;
    d.set_item("repeats", p.repeats)?;
    d.set_item("keys", p.keys.iter().map(key).collect::<Vec<_>>())?;
    Ok(d)
}

/// The pose at time `u` of the scene, in units of the track's timescale: rotation (wxyz), translation, scale. Checks
/// the placement.
#[pyfunction]
pub fn pose_at(py: Python, placement: Bound<PyAny>, u: f64) -> PyResult<PoseTuple> {
    let placement = placement_from(Some(placement))?;
    placement.write().map_err(|e| raise(py, e))?;
    let pose = placement.pose(u);
    Ok((pose.rotation, pose.translation, pose.scale))
}

//! Rigs: `gscodec.bitstream.quantized_group.QuantizedRig` <-> `gsv::rig::Rig`, and the motion that a rig in floats
//! predicts.

use super::values::{array, invalid, value};
use gsv::header::RigHeader;
use gsv::rig::{CHANNELS, Rig};
use gsv::skinning::Skinning;
use numpy::ndarray::Array2;
use numpy::{
    Element, IntoPyArray, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// A rig of `nodes` nodes, without its poses.
pub fn rig_from(d: &Bound<PyAny>, nodes: usize) -> PyResult<(RigHeader, Rig)> {
    let joints = integers(d, "joints")?;
    let (parents, weights) = (array(d, "parents", "uint8")?, array(d, "weights", "uint8")?);
    let Ok(parents) = parents.extract::<PyReadonlyArray1<u8>>() else {
        return invalid("parents: expected shape [J]".into());
    };
    let Ok(weights) = weights.extract::<PyReadonlyArray2<u8>>() else {
        return invalid("weights: expected shape [M, J]".into());
    };
    let count = joints.len();
    if !(1..=255).contains(&count) || weights.shape() != [nodes, count] {
        return invalid(format!(
            "weights: expected shape [{nodes}, J] for 1 to 255 joints, got {:?} for {count}",
            weights.shape()
        ));
    }
    let rig = Rig {
        joints,
        parents: parents.as_slice()?.to_vec(),
        bind: integers(d, "bind")?,
        weights: weights.as_slice()?.to_vec(),
        ..Rig::default()
    };
    let header = RigHeader {
        joints: count as u8,
        rotation_step: value(d, "rotation_step")?,
        translation_step: value(d, "translation_step")?,
    };
    Ok((header, rig))
}

/// Rows of `C` integers.
fn integers<const C: usize>(d: &Bound<PyAny>, name: &str) -> PyResult<Vec<[i32; C]>> {
    let a = array(d, name, "int32")?;
    match a.extract::<PyReadonlyArray2<i32>>() {
        Ok(a) if a.shape()[1] == C => Ok(a.as_slice()?.as_chunks().0.to_vec()),
        _ => invalid(format!("{name}: expected shape [J, {C}]")),
    }
}

/// The fields of a `QuantizedRig` without its poses.
pub fn rig_into<'py>(py: Python<'py>, rig: &Rig, header: &RigHeader) -> PyResult<Bound<'py, PyDict>> {
    let d = PyDict::new(py);
    d.set_item("joints", matrix(py, rig.joints.as_flattened(), 3))?;
    d.set_item("parents", rig.parents.clone().into_pyarray(py))?;
    d.set_item("bind", matrix(py, rig.bind.as_flattened(), CHANNELS))?;
    d.set_item("weights", matrix(py, &rig.weights, rig.joints.len()))?;
    d.set_item("rotation_step", header.rotation_step)?;
    d.set_item("translation_step", header.translation_step)?;
    Ok(d)
}

fn matrix<'py, T: Element + Copy>(py: Python<'py>, flat: &[T], width: usize) -> Bound<'py, PyAny> {
    let rows = flat.len() / width.max(1);
    Array2::from_shape_fn((rows, width), |(i, j)| flat[i * width + j])
        .into_pyarray(py)
        .into_any()
}

/// Positions [T, M, 3] and rotations [T, M, 4] wxyz of points that a rig carries over the frames (spec 13.3).
///
/// # Arguments
/// * `skeleton`: joints [J, 3]; parents [J] u8, at most the own index, which means a root; bind [J, 6], the bind pose,
///   in which the points rest: rotation vector and translation of each joint.
/// * `poses`: [T, J, 6]. `points`: [M, 3]; `weights`: [M, J] u8, all 0 for a point that does not move.
#[pyfunction]
pub fn rig_motion<'py>(
    py: Python<'py>,
    skeleton: (
        PyReadonlyArray2<'py, f32>,
        PyReadonlyArray1<'py, u8>,
        PyReadonlyArray2<'py, f32>,
    ),
    poses: PyReadonlyArray3<'py, f32>,
    points: PyReadonlyArray2<'py, f32>,
    weights: PyReadonlyArray2<'py, u8>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let (joints, parents, bind) = &skeleton;
    let (j, m, frames) = (joints.shape()[0], points.shape()[0], poses.shape()[0]);
    let fits = joints.shape() == [j, 3] && parents.shape() == [j] && bind.shape() == [j, CHANNELS];
    if !fits || poses.shape() != [frames, j, CHANNELS] || points.shape() != [m, 3] || weights.shape() != [m, j] {
        return invalid(
            "expected joints [J, 3], parents [J], bind [J, 6], poses [T, J, 6], points [M, 3] and weights [M, J]"
                .into(),
        );
    }
    let places: Vec<[f32; 3]> = points.as_slice()?.as_chunks().0.to_vec();
    let skinning = Skinning::new(
        joints.as_slice()?.as_chunks().0.to_vec(),
        parents.as_slice()?.to_vec(),
        bind.as_slice()?.as_chunks().0,
        weights.as_slice()?,
    );
    let (mut moved, mut rotations) = (Vec::new(), Vec::new());
    for pose in poses.as_slice()?.as_chunks().0.chunks(j.max(1)) {
        let (x, q) = skinning.carry(pose, &places);
        moved.extend(x);
        rotations.extend(q);
    }
    let moved = moved
        .into_flattened()
        .into_pyarray(py)
        .reshape([frames, m, 3])?
        .into_any();
    let rotations = rotations.into_flattened().into_pyarray(py).reshape([frames, m, 4])?;
    Ok((moved, rotations.into_any()))
}

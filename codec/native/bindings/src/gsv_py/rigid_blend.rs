//! The blend of rigid motions for training and fitting, and its gradient.

use super::values::invalid;
use gsv::blend::Blend;
use gsv::rigid_blend::{Pose, RigidBlend};
use numpy::{IntoPyArray, PyArrayMethods, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

/// Neighbours and weights of `count` Gaussians, as the core takes them.
pub fn blend_of(
    index: &PyReadonlyArray2<u32>,
    weight: &PyReadonlyArray2<f32>,
    count: usize,
    nodes: usize,
) -> PyResult<Blend> {
    if index.shape() != weight.shape() || index.shape()[0] != count {
        return invalid(format!(
            "neighbors and weights: expected shape [{count}, k] of both, got {:?} and {:?}",
            index.shape(),
            weight.shape()
        ));
    }
    if index.as_slice()?.iter().any(|j| *j as usize >= nodes) {
        return invalid(format!("neighbors: expected indices of {nodes} nodes"));
    }
    Ok(Blend {
        per: index.shape()[1],
        index: index.as_slice()?.to_vec(),
        weight: weight.as_slice()?.to_vec(),
    })
}

/// The rows of `a`, named `name`, each of `K` numbers: as many as `count` says, else any number, called `letter`.
fn rows<'a, const K: usize>(
    a: &'a PyReadonlyArray2<f32>,
    name: &str,
    letter: &str,
    count: Option<usize>,
) -> PyResult<&'a [[f32; K]]> {
    if a.shape()[1] != K || count.is_some_and(|c| c != a.shape()[0]) {
        let first = count.map_or(letter.to_string(), |c| c.to_string());
        return invalid(format!("{name}: expected shape [{first}, {K}], got {:?}", a.shape()));
    }
    Ok(a.as_slice()?.as_chunks().0)
}

/// Poses [M, 16] f32 (rows of R, offset s of x -> R x + s, quaternion wxyz) -> `RigidBlend`.
fn poses(a: &PyReadonlyArray2<f32>) -> PyResult<RigidBlend> {
    let pose = |r: &[f32; 16]| -> Pose {
        let column = |b: usize| [r[b], r[3 + b], r[6 + b], 0.0];
        [
            column(0),
            column(1),
            column(2),
            [r[9], r[10], r[11], 0.0],
            [r[12], r[13], r[14], r[15]],
        ]
    };
    Ok(RigidBlend::new(rows(a, "poses", "M", None)?.iter().map(pose).collect()))
}

/// Where [N, 3] positions at rest are carried, [N, 3], and by which rotations, [N, 4] wxyz (spec 13.3).
///
/// `poses` [M, 16] f32: rows of the rotation matrix R, offset s of x -> R x + s, quaternion of R.
#[pyfunction]
pub fn blend_rigid<'py>(
    py: Python<'py>,
    poses: PyReadonlyArray2<'py, f32>,
    rest: PyReadonlyArray2<'py, f32>,
    neighbors: PyReadonlyArray2<'py, u32>,
    weights: PyReadonlyArray2<'py, f32>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let (nodes, x) = (self::poses(&poses)?, rows(&rest, "rest", "N", None)?);
    let blend = blend_of(&neighbors, &weights, x.len(), poses.shape()[0])?;
    let (mut means, mut rotations) = (vec![[0.0f32; 3]; x.len()], vec![[0.0f32; 4]; x.len()]);
    py.detach(|| nodes.carry(&blend, x, (&mut means, &mut rotations), |_, x, q| (x, q)));
    let means = means
        .into_flattened()
        .into_pyarray(py)
        .reshape([x.len(), 3])?
        .into_any();
    let rotations = rotations.into_flattened().into_pyarray(py);
    Ok((means, rotations.reshape([x.len(), 4])?.into_any()))
}

/// The gradient [M, 16] by `poses` of a loss, from its gradients by the results of `blend_rigid`.
#[pyfunction]
pub fn blend_rigid_backward<'py>(
    py: Python<'py>,
    poses: PyReadonlyArray2<'py, f32>,
    rest: PyReadonlyArray2<'py, f32>,
    neighbors: PyReadonlyArray2<'py, u32>,
    weights: PyReadonlyArray2<'py, f32>,
    by_means: PyReadonlyArray2<'py, f32>,
    by_rotations: PyReadonlyArray2<'py, f32>,
) -> PyResult<Bound<'py, PyAny>> {
    let (nodes, x) = (self::poses(&poses)?, rows(&rest, "rest", "N", None)?);
    let blend = blend_of(&neighbors, &weights, x.len(), poses.shape()[0])?;
    let (g, h) = (
        rows(&by_means, "by_means", "N", Some(x.len()))?,
        rows(&by_rotations, "by_rotations", "N", Some(x.len()))?,
    );
    let grads = py.detach(|| nodes.backward(&blend, x, g, h));
    let row = |p: &Pose| -> [f32; 16] {
        let r = |a: usize, b: usize| p[b][a];
        let [s, q] = [p[3], p[4]];
        [
            r(0, 0),
            r(0, 1),
            r(0, 2),
            r(1, 0),
            r(1, 1),
            r(1, 2),
            r(2, 0),
            r(2, 1),
            r(2, 2),
            s[0],
            s[1],
            s[2],
            q[0],
            q[1],
            q[2],
            q[3],
        ]
    };
    let rows: Vec<[f32; 16]> = grads.iter().map(row).collect();
    let count = rows.len();
    Ok(rows.into_flattened().into_pyarray(py).reshape([count, 16])?.into_any())
}

//! The blend of rigid motions for training and fitting, and its gradient by the variables that move the nodes.

use super::values::invalid;
use gsv::blend::Blend;
use gsv::dequantize::multiply;
use gsv::pose_gradient::{self, Edges, Moved};
use gsv::rigid_blend::{self, RigidBlend};
use numpy::{IntoPyArray, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;

type Floats<'py> = PyReadonlyArray2<'py, f32>;

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

/// The rows of `a`, `K` numbers each: `count` rows, or any number if None. `name`, `letter`: `a` and its length in
/// messages.
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

/// Nodes: rest positions [M, 3], rotations [M, 4] wxyz about them, moved positions [M, 3].
type Nodes<'py> = (Floats<'py>, Floats<'py>, Floats<'py>);

/// The poses of nodes.
fn poses(nodes: &Nodes) -> PyResult<RigidBlend> {
    let rest: &[[f32; 3]] = rows(&nodes.0, "nodes", "M", None)?;
    let count = Some(rest.len());
    let rotations: &[[f32; 4]] = rows(&nodes.1, "rotations of nodes", "M", count)?;
    let positions: &[[f32; 3]] = rows(&nodes.2, "positions of nodes", "M", count)?;
    let all = rest.iter().zip(rotations).zip(positions);
    let pose = |((c, q), p): ((&[f32; 3], &[f32; 4]), &[f32; 3])| {
        rigid_blend::pose(*q, *c, [p[0] - c[0], p[1] - c[1], p[2] - c[2]])
    };
    Ok(RigidBlend::new(all.map(pose).collect()))
}

/// Carried positions [N, 3] and rotations [N, 4] wxyz of points with rest positions [N, 3] (spec 13.3).
///
/// `nodes`: rest positions [M, 3], rotations [M, 4] about them, moved positions [M, 3].
#[pyfunction]
pub fn blend_rigid<'py>(
    py: Python<'py>,
    nodes: Nodes<'py>,
    rest: Floats<'py>,
    neighbors: PyReadonlyArray2<'py, u32>,
    weights: Floats<'py>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let (count, x) = (nodes.0.shape()[0], rows(&rest, "rest", "N", None)?);
    let blend = blend_of(&neighbors, &weights, x.len(), count)?;
    let nodes = poses(&nodes)?;
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

/// Gradients [M, 3] and [M, 3] of a loss by the turns and by the shifts of nodes (`gsv::pose_gradient`).
///
/// # Arguments
/// * `nodes`: as in `blend_rigid`; `turned`: rotation vectors (turns) [M, 3], base rotations [M, 4] before the turns.
/// * `blend`: rest [N, 3], neighbors [N, k], weights [N, k].
/// * `by_carried`: gradients [N, 3] and [N, 4] by the results of `blend_rigid`.
/// * `edges`: nodes [M, e] u32 at the other ends, their weights [M, e], strength of the rigidity term.
#[pyfunction]
pub fn node_gradients<'py>(
    py: Python<'py>,
    nodes: Nodes<'py>,
    turned: (Floats<'py>, Floats<'py>),
    blend: (Floats<'py>, PyReadonlyArray2<'py, u32>, Floats<'py>),
    by_carried: (Floats<'py>, Floats<'py>),
    edges: (PyReadonlyArray2<'py, u32>, Floats<'py>, f32),
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    let (motion, x) = (poses(&nodes)?, rows(&blend.0, "rest", "N", None)?);
    let (n, m) = (Some(x.len()), Some(nodes.0.shape()[0]));
    let by_means = rows(&by_carried.0, "by_means", "N", n)?;
    let by_rotations = rows(&by_carried.1, "by_rotations", "N", n)?;
    let moved = Moved {
        rest: rows(&nodes.0, "nodes", "M", m)?,
        turns: rows(&turned.0, "turns", "M", m)?,
        base: rows(&turned.1, "base rotations", "M", m)?,
        positions: rows(&nodes.2, "positions of nodes", "M", m)?,
    };
    let count = moved.rest.len();
    let graph = blend_of(&edges.0, &edges.1, count, count)?;
    let edges = Edges {
        per: graph.per,
        index: &graph.index,
        weights: &graph.weight,
        strength: edges.2,
    };
    let blend = blend_of(&blend.1, &blend.2, x.len(), count)?;
    let (by_turns, by_shifts) = py.detach(|| {
        let by_poses = motion.backward(&blend, x, by_means, by_rotations);
        pose_gradient::backward(&moved, &by_poses, &edges)
    });
    let array = |a: Vec<[f32; 3]>| -> PyResult<Bound<'py, PyAny>> {
        Ok(a.into_flattened().into_pyarray(py).reshape([count, 3])?.into_any())
    };
    Ok((array(by_turns)?, array(by_shifts)?))
}

/// Products [N, 4] of quaternions [N, 4] wxyz, each of the two as it is or conjugated: the rotation `b`, then `a`.
#[pyfunction]
pub fn quat_product<'py>(
    py: Python<'py>,
    a: Floats<'py>,
    b: Floats<'py>,
    conjugated: (bool, bool),
) -> PyResult<Bound<'py, PyAny>> {
    let first: &[[f32; 4]] = rows(&a, "a", "N", None)?;
    let second: &[[f32; 4]] = rows(&b, "b", "N", Some(first.len()))?;
    let signs = [conjugated.0, conjugated.1].map(|c| if c { -1.0 } else { 1.0 });
    let of = |[w, x, y, z]: [f32; 4], s: f32| [w, s * x, s * y, s * z];
    let all = first.iter().zip(second);
    let products: Vec<[f32; 4]> = all.map(|(a, b)| multiply(of(*a, signs[0]), of(*b, signs[1]))).collect();
    let count = products.len();
    Ok(products
        .into_flattened()
        .into_pyarray(py)
        .reshape([count, 4])?
        .into_any())
}

/// Harmonics [N, K, 3], rotated by the unit quaternions [N, 4] (wxyz), or with `back` by their inverse; a new array.
#[pyfunction]
pub fn turned_harmonics<'py>(
    py: Python<'py>,
    harmonics: PyReadonlyArray3<'py, f32>,
    rotations: Floats<'py>,
    back: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let &[n, k, _] = harmonics.shape() else {
        return invalid("harmonics: expected shape [N, K, 3]".into());
    };
    let rotations: &[[f32; 4]] = rows(&rotations, "rotations", "N", Some(n))?;
    let mut sh = harmonics.as_slice()?.to_vec();
    py.detach(|| {
        let sign = if back { -1.0 } else { 1.0 };
        let turns: Vec<[f32; 4]> = rotations
            .iter()
            .map(|[w, x, y, z]| [*w, sign * x, sign * y, sign * z])
            .collect();
        gsv::harmonics::turn(&mut sh, &turns);
    });
    Ok(sh.into_pyarray(py).reshape([n, k, 3])?.into_any())
}

//! Training: gradient by the poses of nodes (`RigidBlend::backward`) -> gradient by the turns and shifts that move the
//! nodes, and the gradient of the as-rigid-as-possible term of their graph (Sorkine and Alexa 2007).
//!
//! A node is rotated by a base rotation and then by a rotation vector (turn), and is shifted: q = unit(quaternion(turn)
//! base), p = base + shift.

use crate::dequantize::{Quat, multiply};
use crate::rigid_blend::{Pose, matrix};

/// Keeps a rotation vector of 0 differentiable.
const LEAST_SQUARE: f32 = 1e-16;
/// Half an angle below which its series is exact to f32.
const SMALL: f32 = 1e-2;
/// Keeps the length of the deviation of an edge from rigid motion differentiable at 0.
const LEAST_EDGE: f32 = 1e-12;

/// M nodes and their motion.
pub struct Moved<'a> {
    /// [M] positions at rest.
    pub rest: &'a [[f32; 3]],
    /// [M] rotation vectors, radians.
    pub turns: &'a [[f32; 3]],
    /// [M] unit quaternions before the turn.
    pub base: &'a [Quat],
    /// [M] positions after the shift.
    pub positions: &'a [[f32; 3]],
}

/// Edges of the graph, `per` of each node, and the weight of the term in the loss (`strength`).
pub struct Edges<'a> {
    pub per: usize,
    /// [M, per] nodes at the other ends; [M, per] weights of the difference between an edge and its rest edge rotated
    /// by the node.
    pub index: &'a [u32],
    pub weights: &'a [f32],
    pub strength: f32,
}

/// Gradients by the turns and by the shifts; `by_poses`: [M], by the poses that `rigid_blend::pose` returns.
pub fn backward(nodes: &Moved, by_poses: &[Pose], edges: &Edges) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let turned: Vec<Turn> = nodes
        .turns
        .iter()
        .zip(nodes.base)
        .map(|(v, b)| Turn::new(*v, *b))
        .collect();
    let mut by_matrices = vec![[[0.0f32; 3]; 3]; nodes.rest.len()];
    let mut by_positions = vec![[0.0f32; 3]; nodes.rest.len()];
    for (((g, p), r), by) in by_matrices
        .iter_mut()
        .zip(nodes.rest)
        .zip(&mut by_positions)
        .zip(by_poses)
    {
        // offset = position - R rest
        for a in 0..3 {
            r[a] = by[3][a];
            (0..3).for_each(|b| g[a][b] = by[b][a] - by[3][a] * p[b]);
        }
    }
    add_rigidity(nodes, &turned, edges, &mut by_matrices, &mut by_positions);
    let by_turns = turned
        .iter()
        .zip(&by_matrices)
        .zip(by_poses)
        .map(|((t, by_matrix), by)| t.backward(by_matrix, by[4]))
        .collect();
    (by_turns, by_positions)
}

fn add_rigidity(
    nodes: &Moved,
    turned: &[Turn],
    edges: &Edges,
    by_matrices: &mut [[[f32; 3]; 3]],
    by_positions: &mut [[f32; 3]],
) {
    let share = edges.strength / edges.index.len().max(1) as f32;
    let less = |a: [f32; 3], b: [f32; 3]| -> [f32; 3] { std::array::from_fn(|i| a[i] - b[i]) };
    let rows = edges
        .index
        .chunks(edges.per.max(1))
        .zip(edges.weights.chunks(edges.per.max(1)));
    for (m, (ends, weights)) in rows.enumerate() {
        let rotation = matrix(turned[m].unit);
        for (end, weight) in ends.iter().zip(weights) {
            let end = *end as usize;
            let edge = less(nodes.rest[end], nodes.rest[m]);
            let now = less(nodes.positions[end], nodes.positions[m]);
            let missed: [f32; 3] =
                std::array::from_fn(|a| (0..3).map(|b| rotation[a][b] * edge[b]).sum::<f32>() - now[a]);
            let square = weight * weight;
            let length = (square * missed.iter().map(|v| v * v).sum::<f32>() + LEAST_EDGE).sqrt();
            let by = missed.map(|v| share * square * v / length);
            for a in 0..3 {
                (0..3).for_each(|b| by_matrices[m][a][b] += by[a] * edge[b]);
                by_positions[end][a] -= by[a];
                by_positions[m][a] += by[a];
            }
        }
    }
}

/// The rotation of one node.
struct Turn {
    vector: [f32; 3],
    half: f32, // of the angle
    base: Quat,
    length: f32, // of the product, before it is made a unit
    unit: Quat,
}

impl Turn {
    fn new(vector: [f32; 3], base: Quat) -> Turn {
        let half = (vector.iter().map(|v| v * v).sum::<f32>() + LEAST_SQUARE).sqrt() / 2.0;
        let k = half.sin() / (2.0 * half);
        let whole = multiply([half.cos(), k * vector[0], k * vector[1], k * vector[2]], base);
        let length = whole.iter().map(|v| v * v).sum::<f32>().sqrt();
        Turn {
            vector,
            half,
            base,
            length,
            unit: whole.map(|v| v / length),
        }
    }

    /// The gradient by the rotation vector.
    fn backward(&self, g: &[[f32; 3]; 3], by_quat: Quat) -> [f32; 3] {
        let [w, x, y, z] = self.unit;
        let by_matrix = [
            x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1]),
            y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0]) + w * (g[2][1] - g[1][2]) - 2.0 * x * (g[1][1] + g[2][2]),
            x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1]) + w * (g[0][2] - g[2][0]) - 2.0 * y * (g[0][0] + g[2][2]),
            x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1]) + w * (g[1][0] - g[0][1]) - 2.0 * z * (g[0][0] + g[1][1]),
        ];
        let by: Quat = std::array::from_fn(|i| by_quat[i] + 2.0 * by_matrix[i]);
        let along: f32 = by.iter().zip(&self.unit).map(|(a, b)| a * b).sum();
        let by: Quat = std::array::from_fn(|i| (by[i] - along * self.unit[i]) / self.length);
        let [b, i, j, k] = self.base;
        let by = multiply(by, [b, -i, -j, -k]);
        let (half, v) = (self.half, self.vector);
        let sine = half.sin() / half;
        let bend = if half < SMALL {
            half * half / 240.0 - 1.0 / 24.0
        } else {
            (half * half.cos() - half.sin()) / (8.0 * half.powi(3))
        };
        let inner = v[0] * by[1] + v[1] * by[2] + v[2] * by[3];
        std::array::from_fn(|a| 0.5 * sine * by[a + 1] + v[a] * (inner * bend - 0.25 * sine * by[0]))
    }
}

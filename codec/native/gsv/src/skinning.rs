//! Skinning (spec 13.3): joint poses -> positions and rotations of the nodes as the rig predicts them. Linear blend
//! skinning of the joints' rigid motions; decoding of integers does not depend on its result, so f32 is enough.

use crate::blend::Blend;
use crate::dequantize::{Quat, multiply};
use crate::rig::CHANNELS;
use crate::rigid_blend::{Pose, REST, RigidBlend, from_rotation_vector, matrix, pose};

/// A rigid motion x -> R x + s: quaternion of R, s.
type Motion = (Quat, [f32; 3]);

/// Joints, and the weights by which they move nodes.
#[derive(Debug, Clone, Default)]
pub struct Skinning {
    joints: Vec<[f32; 3]>,
    parents: Vec<u8>,
    /// Inverse of the motion of each joint in the bind pose, in which the group rests.
    unbind: Vec<Motion>,
    blend: Blend,
}

impl Skinning {
    /// # Arguments
    /// * `joints`: [J] positions; `parents`: [J], at most the own index, which means a root; `bind`: [J] rotation
    ///   vector and translation of the bind pose; `weights`: [M, J].
    pub fn new(joints: Vec<[f32; 3]>, parents: Vec<u8>, bind: &[[f32; CHANNELS]], weights: &[u8]) -> Skinning {
        let mut own = Skinning {
            blend: blend_of(weights, joints.len()),
            joints,
            parents,
            unbind: Vec::new(),
        };
        own.unbind = own.chain(bind).into_iter().map(inverse).collect();
        own
    }

    /// Motion of each joint from the rest pose of the skeleton to `poses`.
    fn chain(&self, poses: &[[f32; CHANNELS]]) -> Vec<Motion> {
        let mut out: Vec<Motion> = Vec::with_capacity(self.joints.len());
        for (j, (place, parent)) in self.joints.iter().zip(&self.parents).enumerate() {
            let [a, b, c, x, y, z] = poses.get(j).copied().unwrap_or_default();
            let q = from_rotation_vector([a, b, c]);
            let turned = rotate(q, *place);
            let shift = [x, y, z];
            let own = (q, std::array::from_fn(|i| place[i] + shift[i] - turned[i]));
            let parent = usize::from(*parent);
            let motion = out.get(parent).filter(|_| parent < j).map_or(own, |p| compose(*p, own));
            out.push(motion);
        }
        out
    }

    /// Carried positions and rotations, in `poses` ([J] rotation vector and translation), of nodes that rest at
    /// `nodes`.
    pub fn carry(&self, poses: &[[f32; CHANNELS]], nodes: &[[f32; 3]]) -> (Vec<[f32; 3]>, Vec<Quat>) {
        let moved = self.chain(poses).into_iter().zip(&self.unbind);
        let mut motions: Vec<Pose> = moved.map(|(to, from)| compose(to, *from)).map(pose_of).collect();
        motions.push(REST); // of nodes without weights
        let (poses, per) = (RigidBlend::new(motions), self.blend.per.max(1));
        let rows = self.blend.index.chunks(per).zip(self.blend.weight.chunks(per));
        nodes
            .iter()
            .zip(rows)
            .map(|(x, (index, weight))| poses.carry_one(*x, index, weight))
            .unzip()
    }
}

/// Rows of weights [M, J] -> joints of each node, largest weight first, and their shares of the sum. A node without
/// weights has the index J.
fn blend_of(weights: &[u8], joints: usize) -> Blend {
    let rows = || weights.chunks(joints.max(1));
    let used = |row: &[u8]| row.iter().filter(|w| **w > 0).count();
    let per = rows().map(used).max().unwrap_or(0).max(1);
    let mut blend = Blend {
        per,
        ..Blend::default()
    };
    for row in rows() {
        let mut own: Vec<(u8, u32)> = row.iter().copied().zip(0..).filter(|(w, _)| *w > 0).collect();
        own.sort_by_key(|(w, _)| std::cmp::Reverse(*w)); // stable: of equal weights the lower index
        if own.is_empty() {
            own.push((1, joints as u32));
        }
        let sum: f32 = own.iter().map(|(w, _)| f32::from(*w)).sum();
        own.resize(per, (0, own[0].1));
        blend.index.extend(own.iter().map(|(_, j)| *j));
        blend.weight.extend(own.iter().map(|(w, _)| f32::from(*w) / sum));
    }
    blend
}

/// `v` rotated by a unit quaternion.
pub fn rotate(q: Quat, v: [f32; 3]) -> [f32; 3] {
    matrix(q).map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// `b`, then `a`.
fn compose(a: Motion, b: Motion) -> Motion {
    let turned = rotate(a.0, b.1);
    (multiply(a.0, b.0), std::array::from_fn(|i| turned[i] + a.1[i]))
}

fn inverse((q, s): Motion) -> Motion {
    let back = [q[0], -q[1], -q[2], -q[3]];
    (back, rotate(back, s).map(|v| -v))
}

fn pose_of((q, s): Motion) -> Pose {
    pose(q, [0.0; 3], s)
}

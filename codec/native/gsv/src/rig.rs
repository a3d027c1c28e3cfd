//! The rig of a group (spec 11.1, 11.2) <-> bins: joints, the bind pose, in which the group rests, the weights by which
//! joints move each node, and the poses of the joints over the frames.
//!
//! The rig predicts the motion of the nodes (skinning.rs); the trajectories of the nodes are the residual. Poses are a
//! unit of their own, so a stream is reposed by new bytes of that unit alone.

use crate::neighbors::{NEAR, Near};
use crate::range_coder::Bins;
use crate::trajectories::{Kind, Stop, Trajectories, TrajectoryModel, code as code_trajectories};
use crate::values::ValueModel;

/// Channels of the pose of a joint: rotation vector, translation.
pub const CHANNELS: usize = 6;
/// Largest weight of a joint for a node.
pub const WEIGHT_MAX: i32 = 64;

/// Classes of the value model.
const JOINTS: usize = 0;
const BIND: usize = 1;
const WEIGHTS: usize = 2;
const CLASSES: usize = 3;

/// J joints that move M nodes, in integers.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rig {
    /// [J] positions in the rest pose of the skeleton, in grid steps from the origin.
    pub joints: Vec<[i32; 3]>,
    /// [J] parent of each joint, at most its own index; its own index: a root.
    pub parents: Vec<u8>,
    /// [J] bind pose, in which the group rests, in steps.
    pub bind: Vec<[i32; CHANNELS]>,
    /// [M, J] weights of 0 to `WEIGHT_MAX`.
    pub weights: Vec<u8>,
    /// [J] DCT coefficients of the poses over the frames, in steps.
    pub poses: Trajectories,
}

/// Codes a rig of `joints` joints without its poses. `near`: neighbours of each node among the nodes; `source`: the rig
/// to encode, in the decoder empty. None: a forbidden value was read, or the payload is over.
pub fn code<C: Bins>(c: &mut C, joints: usize, near: &[Near], source: &Rig) -> Option<Rig> {
    let (mut model, mut out) = (ValueModel::new(CLASSES), Rig::default());
    for j in 0..joints {
        let told = source.parents.get(j).copied().unwrap_or_default();
        let parent = c.bits(u64::from(told), 8) as u8;
        if usize::from(parent) > j {
            return None;
        }
        let known = out.joints.get(usize::from(parent)).copied();
        let own = source.joints.get(j).copied().unwrap_or_default();
        let place = std::array::from_fn(|axis| {
            let expected = known.map(|k: [i32; 3]| k[axis]);
            value(c, &mut model, JOINTS, own[axis], (expected.as_slice(), [0; 2]))
        });
        let own = source.bind.get(j).copied().unwrap_or_default();
        let bind = own.map(|v| value(c, &mut model, BIND, v, (&[], [0; 2])));
        out.joints.push(place);
        out.parents.push(parent);
        out.bind.push(bind);
        if model.broken || !c.alive() {
            return None;
        }
    }
    for (i, near) in near.iter().enumerate() {
        weights(c, &mut model, (i, joints), near, source, &mut out)?;
        if !c.alive() {
            return None;
        }
    }
    Some(out)
}

/// Not inlined: a rig takes no time, and each copy would cost bytes of the page.
#[inline(never)]
fn value<C: Bins>(c: &mut C, m: &mut ValueModel, class: usize, v: i32, (near, prev): (&[i32], [i32; 2])) -> i32 {
    m.value(c, class, v, near, prev)
}

/// Codes the weights of node `i`. None: one of them is out of range.
fn weights<C: Bins>(
    c: &mut C,
    model: &mut ValueModel,
    (i, joints): (usize, usize),
    near: &Near,
    source: &Rig,
    out: &mut Rig,
) -> Option<()> {
    let (mut before, mut left) = (0, WEIGHT_MAX);
    for j in 0..joints {
        let (mut around, mut present) = ([0; NEAR], 0);
        for n in near.iter().filter(|n| **n != u32::MAX) {
            let weight = out.weights.get(*n as usize * joints + j).copied();
            around[present] = i32::from(weight.unwrap_or_default());
            present += 1;
        }
        let told = source.weights.get(i * joints + j).copied().unwrap_or_default();
        let weight = value(c, model, WEIGHTS, i32::from(told), (&around[..present], [before, left]));
        if model.broken || !(0..=WEIGHT_MAX).contains(&weight) {
            return None;
        }
        out.weights.push(weight as u8);
        (before, left) = (weight, left - weight);
    }
    Some(())
}

/// Codes poses of at most `frames` coefficients of joints with these parents. `source`: as in `code`.
pub fn code_poses<C: Bins>(
    c: &mut C,
    parents: &[u8],
    frames: u16,
    source: &Trajectories,
) -> Result<Trajectories, Stop> {
    let mut model = TrajectoryModel::new(Kind::Node);
    let budget = u64::MAX; // counted from the header
    code_trajectories(c, &mut model, usize::from(frames), &ancestors(parents), source, budget)
}

/// Ancestors of each joint, the parent first, at most `NEAR`.
fn ancestors(parents: &[u8]) -> Vec<Near> {
    let mut out: Vec<Near> = Vec::with_capacity(parents.len());
    for (j, parent) in parents.iter().enumerate() {
        let mut own = [u32::MAX; NEAR];
        if let Some(theirs) = out.get(usize::from(*parent)).filter(|_| usize::from(*parent) < j) {
            own[0] = u32::from(*parent);
            own[1..].copy_from_slice(&theirs[..NEAR - 1]);
        }
        out.push(own);
    }
    out
}

//! Lifetimes (spec 10): the frames [t0, t1) in which each Gaussian is shown <-> bins, in the context of the neighbours'
//! lifetimes.

use crate::model::Model;
use crate::neighbors::Near;
use crate::range_coder::Bins;

const POINT: usize = 16; // first context of the end points; the contexts before it are for the flag
const NODES: usize = 256;
const BITS: usize = 8;

/// A new model of lifetimes.
pub fn model() -> Model {
    Model::new(POINT + 2 * NODES, POINT + 2 * BITS * 3, 1 + 2 * BITS)
}

/// Codes the lifetimes of a group of `frames` frames. False if a forbidden one was read.
pub fn code<C: Bins>(c: &mut C, model: &mut Model, frames: u16, near: &[Near], lifetimes: &mut [[u16; 2]]) -> bool {
    let bits = 16 - (frames - 1).leading_zeros();
    let whole = [0, frames];
    for (i, near) in near.iter().enumerate() {
        let (done, rest) = lifetimes.split_at_mut(i);
        let Some(own) = rest.first_mut() else { return false };
        let cut = near.map(|j| usize::from(done.get(j as usize).is_some_and(|l| *l != whole)));
        if !model.bin(c, *own != whole, 2 * cut[0] + cut[1], cut.iter().sum(), 0) {
            *own = whole;
            continue;
        }
        let [first, end] = done.get(near[0] as usize).copied().unwrap_or(whole);
        let t0 = point(c, model, 0, bits, own[0], first);
        let t1 = point(c, model, 1, bits, own[1].wrapping_sub(1), end - 1) + 1;
        if t0 >= t1 || t1 > frames || !c.alive() {
            return false;
        }
        *own = [t0, t1];
    }
    true
}

/// Codes one end point, most significant bit first; `near`: the end point of the nearest neighbour.
fn point<C: Bins>(c: &mut C, model: &mut Model, end: usize, bits: u32, want: u16, near: u16) -> u16 {
    let (mut v, mut node) = (0u16, 1);
    for j in 0..bits {
        let shift = bits - 1 - j;
        let follow = if u32::from(v) == u32::from(near) >> (shift + 1) {
            usize::from(near >> shift & 1)
        } else {
            2
        };
        let set = BITS * end + j as usize;
        let bin = model.bin(
            c,
            want >> shift & 1 != 0,
            POINT + NODES * end + node,
            POINT + 3 * set + follow,
            1 + set,
        );
        v = v << 1 | u16::from(bin);
        node = node << 1 | usize::from(bin);
    }
    v
}

//! Positions (spec 8): a sorted multiset of grid points <-> bins.
//!
//! An octree, breadth first, whose nodes know how many points they hold. One syntax element, the number of points in
//! the lower half, codes emptiness, single points and duplicates; its contexts are the points of the face neighbours. A
//! point with few neighbours leaves the tree and its remaining bits are bypass bins, since they can hardly be
//! predicted.

mod octree;
mod split;

use crate::range_coder::{Bins, Decoder, Encoder};
use octree::{Children, Node, link};
pub use split::SplitModel;
use split::{Seen, Split, SplitCoder, seen};

const LONELY: usize = 2; // most face neighbours of a point that leaves the tree

/// Encodes points of `bits` bits per axis, given as sorted Morton codes.
pub fn encode(model: &mut SplitModel, points: &[u64], bits: u32) -> Vec<u8> {
    let mut c = Encoder::default();
    code(&mut c, model, points, points.len() as u32, bits);
    c.finish()
}

/// Decodes `count` points; returns their sorted Morton codes, or an error message.
pub fn decode(model: &mut SplitModel, payload: &[u8], count: u32, bits: u32) -> Result<Vec<u64>, &'static str> {
    let mut c = Decoder::new(payload);
    let points = code(&mut c, model, &[], count, bits);
    c.finish().map(|()| points)
}

/// Codes `count` points of `bits` bits per axis as one tree. `points`: their sorted Morton codes, in the decoder empty.
/// Returns the codes.
fn code<C: Bins>(c: &mut C, model: &mut SplitModel, points: &[u64], count: u32, bits: u32) -> Vec<u64> {
    let mut out = Vec::with_capacity(count as usize);
    let mut coder = SplitCoder { c, model };
    let mut level = if count > 0 {
        vec![Node::new(0, count, 0)]
    } else {
        Vec::new()
    };
    for rest in (1..=bits).rev() {
        level = coder.level(&level, points, rest, &mut out);
    }
    for node in &level {
        out.extend((0..node.count).map(|_| node.code));
    }
    out.sort_unstable();
    out
}

impl<C: Bins> SplitCoder<'_, C> {
    /// Splits the nodes of one level, of which `rest` bits per axis are unknown; returns the next level.
    fn level(&mut self, level: &[Node], points: &[u64], rest: u32, out: &mut Vec<u64>) -> Vec<Node> {
        let mut known: Vec<Seen> = Vec::with_capacity(level.len());
        let mut children: Vec<Children> = Vec::with_capacity(level.len());
        let mut next = Vec::with_capacity(level.len() * 2);
        for node in level {
            if !self.c.alive() {
                break;
            }
            let (first, mut mask, mut mine) = (next.len() as u32, 0, 0);
            if node.count == 1 && node.occupied() <= LONELY {
                let point = points.get(node.start as usize).copied().unwrap_or(0);
                out.push(node.code << (3 * rest) | self.c.bits(point & ((1 << (3 * rest)) - 1), 3 * rest));
            } else if node.count == 1 {
                let k = Split::new(node, level, &known, points, rest).child(self);
                (mine, mask) = (seen(k, 1), 1 << k);
                next.push(Node::new(node.code << 3 | k as u64, 1, node.start));
            } else {
                let mut start = node.start;
                let counts = Split::new(node, level, &known, points, rest).children(self);
                for (k, &n) in counts.iter().enumerate().filter(|(_, n)| **n > 0) {
                    mine |= seen(k, n);
                    mask |= 1 << k;
                    next.push(Node::new(node.code << 3 | k as u64, n, start));
                    start += n;
                }
            }
            known.push(mine);
            children.push(Children { first, mask });
        }
        link(level, &children, &mut next);
        next
    }
}

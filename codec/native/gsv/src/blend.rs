//! Which nodes move a Gaussian, and how much (spec 13.2): exact integers, so that encoder and decoder agree.

use crate::neighbors::distance;
use rayon::prelude::*;

/// Neighbours a Gaussian may have (spec 4).
pub const NEIGHBORS_MAX: usize = 8;
const CHUNK: usize = 16; // nodes per bounding box

/// Nodes and weights of all Gaussians: `per` entries each, nearest first.
#[derive(Debug, Clone, Default)]
pub struct Blend {
    pub per: usize,
    pub index: Vec<u32>,
    pub weight: Vec<f32>, // sum to 1
}

impl Blend {
    /// `nodes` in Morton order, so that runs of them are compact.
    pub fn new(positions: &[[u32; 3]], nodes: &[[u32; 3]], neighbors: usize) -> Blend {
        let per = neighbors.min(nodes.len()).min(NEIGHBORS_MAX);
        if per == 0 {
            return Blend::default();
        }
        let boxes: Vec<Bounds> = nodes.chunks(CHUNK).map(Bounds::new).collect();
        let search = |p: &[u32; 3]| weights(nearest(*p, nodes, &boxes, per + 1), per, nodes.len());
        let found: Vec<_> = positions.par_iter().with_min_len(1024).map(search).collect();
        let index = found.iter().flat_map(|f| f.0[..per].iter().copied()).collect();
        let weight = found.iter().flat_map(|f| f.1[..per].iter().copied()).collect();
        Blend { per, index, weight }
    }
}

/// A box around consecutive nodes.
struct Bounds {
    low: [u32; 3],
    high: [u32; 3],
}

impl Bounds {
    fn new(nodes: &[[u32; 3]]) -> Bounds {
        let fold = |f: fn(u32, u32) -> u32, start| {
            nodes
                .iter()
                .fold([start; 3], |b, n| [f(b[0], n[0]), f(b[1], n[1]), f(b[2], n[2])])
        };
        Bounds {
            low: fold(u32::min, u32::MAX),
            high: fold(u32::max, 0),
        }
    }

    /// Squared distance to the nearest point of the box.
    fn distance(&self, p: [u32; 3]) -> u64 {
        distance(p, std::array::from_fn(|a| p[a].clamp(self.low[a], self.high[a])))
    }
}

type Found = [(u64, u32); NEIGHBORS_MAX + 1];

/// The `count` nearest nodes by (squared distance, index): first those of the nearest box, then of those that reach so far.
fn nearest(p: [u32; 3], nodes: &[[u32; 3]], boxes: &[Bounds], count: usize) -> Found {
    let mut best: Found = [(u64::MAX, u32::MAX); NEIGHBORS_MAX + 1];
    let home = boxes
        .iter()
        .map(|b| b.distance(p))
        .enumerate()
        .min_by_key(|(_, d)| *d)
        .map_or(0, |(i, _)| i);
    let mut visit = |chunk: usize| {
        let from = chunk * CHUNK;
        for (node, j) in nodes[from..].iter().take(CHUNK).zip(from as u32..) {
            let mut key = (distance(p, *node), j);
            if key < best[count - 1] {
                for b in &mut best[..count] {
                    if key < *b {
                        std::mem::swap(&mut key, b);
                    }
                }
            }
        }
        best[count - 1].0
    };
    let mut reach = visit(home);
    for (i, b) in boxes.iter().enumerate().filter(|(i, _)| *i != home) {
        if b.distance(p) <= reach {
            reach = visit(i);
        }
    }
    best
}

fn weights(found: Found, per: usize, nodes: usize) -> ([u32; NEIGHBORS_MAX], [f32; NEIGHBORS_MAX]) {
    let scale = if nodes > per {
        found[per].0
    } else {
        2 * found[per - 1].0
    };
    let mut w = [0u64; NEIGHBORS_MAX];
    for (w, (d, _)) in w.iter_mut().zip(&found[..per]) {
        let f = ((scale - d) << 16).checked_div(scale).unwrap_or(0);
        *w = f * f;
    }
    if w.iter().all(|w| *w == 0) {
        w[..per].fill(1);
    }
    let sum: u64 = w.iter().sum();
    let index = std::array::from_fn(|j| found[j].1);
    (index, w.map(|w| (w as f64 / sum as f64) as f32))
}

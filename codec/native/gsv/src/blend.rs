//! Node weights (spec 13.2): which nodes move a Gaussian, and by how much. Exact integers, so that encoder and decoder
//! agree.

pub use crate::node_search::NEIGHBORS_MAX;
use crate::node_search::NodeSearch;
use rayon::prelude::*;

/// Nodes and weights of all Gaussians: `per` entries each, nearest node first.
#[derive(Debug, Clone, Default)]
pub struct Blend {
    pub per: usize,
    pub index: Vec<u32>,
    pub weight: Vec<f32>, // sum to 1
}

impl Blend {
    /// `positions` and `nodes` are in Morton order: runs are compact and the search is fast. The result does not depend
    /// on the order.
    pub fn new(positions: &[[u32; 3]], nodes: &[[u32; 3]], neighbors: usize) -> Blend {
        let per = neighbors.min(nodes.len()).min(NEIGHBORS_MAX);
        if per == 0 {
            return Blend::default();
        }
        let search = NodeSearch::new(nodes, per + 1);
        let mut index = vec![0; positions.len() * per];
        let mut weight = vec![0.0; positions.len() * per];
        let rows = index.par_chunks_mut(RUN * per).zip(weight.par_chunks_mut(RUN * per));
        positions
            .par_chunks(RUN)
            .zip(rows)
            .with_min_len(32)
            .for_each(|(run, (index, weight))| {
                let mut rows = index.chunks_exact_mut(per).zip(weight.chunks_exact_mut(per));
                search.run(run, |found| {
                    if let Some((i, w)) = rows.next() {
                        weights(found, nodes.len(), i, w);
                    }
                });
            });
        Blend { per, index, weight }
    }
}

/// Gaussians that share a search.
const RUN: usize = 128;

/// Weights of one Gaussian. `found` holds one more neighbour than there are weights.
fn weights(found: &[(u64, u32)], nodes: usize, index: &mut [u32], weight: &mut [f32]) {
    let per = index.len();
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
    for (((i, out), (_, j)), w) in index.iter_mut().zip(weight).zip(found).zip(w) {
        (*i, *out) = (*j, (w as f64 / sum as f64) as f32);
    }
}

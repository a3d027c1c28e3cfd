//! Nearest nodes of points (spec 13.2), exact: a run of points shares the few nodes that can be nearest to any of them.
//!
//! Gaussians come in Morton order, so runs are compact. A node is a candidate of a run if its distance to the bounding
//! box is at most the distance within which every point of the box has enough nodes; the same test is repeated for
//! short runs. In the worst case (a hostile file with all nodes on a sphere and all Gaussians around its centre) every
//! node stays a candidate of every point; the level caps that cost (spec 5). Coordinates are below 2^21, so sums of
//! squared differences are exact in f64, which vectorizes.

/// Most nodes that move a Gaussian (spec 4).
pub const NEIGHBORS_MAX: usize = 8;

pub type Neighbor = (u64, u32); // (squared distance, index of the node)
const FAR: Neighbor = (u64::MAX, u32::MAX);
/// Most nodes that a search returns: one more than there are weights.
const NEAREST_MAX: usize = NEIGHBORS_MAX + 1;

/// Points of a short run.
const SHORT: usize = 16;

/// Coordinates of nodes, axis by axis, and their indices.
#[derive(Default)]
struct NodeTable {
    axes: [Vec<f64>; 3],
    index: Vec<u32>,
}

impl NodeTable {
    fn push(&mut self, place: [f64; 3], index: u32) {
        self.axes.iter_mut().zip(place).for_each(|(axis, v)| axis.push(v));
        self.index.push(index);
    }

    /// `out`: the sum over the axes of f(axis, coordinate)^2, for each node.
    #[inline]
    fn sums(&self, out: &mut Vec<f64>, f: impl Fn(usize, f64) -> f64) {
        out.clear();
        out.resize(self.index.len(), 0.0);
        for (a, axis) in self.axes.iter().enumerate() {
            for (sum, v) in out.iter_mut().zip(axis) {
                let d = f(a, *v);
                *sum += d * d;
            }
        }
    }

    /// Writes to `few` the candidates, which include the `count` nearest nodes of each of `points`. `d`: scratch space.
    fn near(&self, points: &[[u32; 3]], count: usize, d: &mut Vec<f64>, few: &mut NodeTable) {
        let bounds = |a: usize| {
            points
                .iter()
                .fold((u32::MAX, 0), |(l, h), p| (l.min(p[a]), h.max(p[a])))
        };
        let box_ = [0, 1, 2].map(bounds).map(|(l, h)| (f64::from(l), f64::from(h)));
        self.sums(d, |a, v| larger((v - box_[a].0).abs(), (v - box_[a].1).abs()));
        let mut farthest = [f64::INFINITY; NEAREST_MAX];
        for d in d.iter() {
            if *d < farthest[count - 1] {
                insert(&mut farthest[..count], *d);
            }
        }
        let reach = farthest[count - 1];
        self.sums(d, |a, v| larger(larger(box_[a].0 - v, v - box_[a].1), 0.0));
        few.axes.iter_mut().for_each(Vec::clear);
        few.index.clear();
        for (i, _) in d.iter().enumerate().filter(|(_, d)| **d <= reach) {
            few.push([0, 1, 2].map(|a| self.axes[a][i]), self.index[i]);
        }
    }
}

pub struct NodeSearch {
    nodes: NodeTable,
    count: usize,
}

impl NodeSearch {
    /// A search for the `count` nearest nodes, 1 to `NEIGHBORS_MAX + 1`.
    pub fn new(nodes: &[[u32; 3]], count: usize) -> Self {
        let mut all = NodeTable::default();
        nodes.iter().zip(0..).for_each(|(n, i)| all.push(n.map(f64::from), i));
        NodeSearch {
            nodes: all,
            count: count.clamp(1, NEAREST_MAX),
        }
    }

    /// Calls `found` for each point with its nearest nodes, sorted by (squared distance, index); places beyond the
    /// number of nodes hold `FAR`.
    pub fn run(&self, points: &[[u32; 3]], mut found: impl FnMut(&[Neighbor])) {
        let (mut d, mut some, mut few) = (Vec::new(), NodeTable::default(), NodeTable::default());
        self.nodes.near(points, self.count, &mut d, &mut some);
        for points in points.chunks(SHORT) {
            some.near(points, self.count, &mut d, &mut few);
            for p in points {
                let p = p.map(f64::from);
                few.sums(&mut d, |a, v| v - p[a]);
                let mut best = [FAR; NEAREST_MAX];
                for (d, j) in d.iter().zip(&few.index) {
                    if *d < best[self.count - 1].0 as f64 {
                        insert(&mut best[..self.count], (*d as u64, *j));
                    }
                }
                found(&best[..self.count]);
            }
        }
    }
}

/// The larger of two numbers, neither NaN: `f64::max` is a call in wasm.
#[inline]
fn larger(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

/// Inserts into a sorted list; the last item is dropped.
#[inline]
fn insert<T: PartialOrd>(list: &mut [T], mut new: T) {
    for item in list {
        if new < *item {
            std::mem::swap(&mut new, item);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::neighbors::distance;
    use proptest::prelude::*;

    /// Spec 13.2 as written.
    fn brute_force(p: [u32; 3], nodes: &[[u32; 3]], count: usize) -> Vec<Neighbor> {
        let mut all: Vec<Neighbor> = nodes.iter().map(|n| distance(p, *n)).zip(0..).collect();
        all.sort_unstable();
        all.resize(all.len().max(count), FAR);
        all.truncate(count);
        all
    }

    fn cloud(most: usize) -> impl Strategy<Value = Vec<[u32; 3]>> {
        // crowded grids have ties and nodes on one point
        prop_oneof![Just(2u32), Just(7), Just(100), Just(1 << 21)]
            .prop_flat_map(move |side| proptest::collection::vec([0..side, 0..side, 0..side], 1..most))
    }

    proptest! {
        #[test]
        fn as_by_brute_force(nodes in cloud(1200), mut points in cloud(60), sorted: bool, count in 1..=NEAREST_MAX) {
            points.extend(nodes.iter().step_by(100));
            if sorted {
                points.sort_by_key(|n| crate::morton::encode(*n));
            }
            let search = NodeSearch::new(&nodes, count);
            for run in points.chunks(16) {
                let mut wanted = run.iter().map(|p| brute_force(*p, &nodes, count));
                search.run(run, |found| assert_eq!(Some(found.to_vec()), wanted.next()));
                prop_assert!(wanted.next().is_none());
            }
        }
    }
}

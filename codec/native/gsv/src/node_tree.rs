//! The nodes nearest to a point (spec 13.2), exactly: boxes around runs of nodes, boxes around runs of boxes, and so on.
//!
//! Nodes come in Morton order, so runs are compact and no sorting is needed. Gaussians do as well: what was near the last
//! one bounds the search for the next. A search costs a few boxes a tier; where a hostile file makes boxes useless (all
//! nodes on a sphere, all Gaussians around its centre) it falls back to one pass over the nodes, never more.
//! Coordinates are below 2^21: their differences are exact in f32 and the sums of squares in f64.

use crate::blend::NEIGHBORS_MAX;

/// Nodes per box, and boxes per box of the next tier.
const FAN: usize = 16;
type Lanes = [f32; FAN];

/// Boxes around FAN runs of nodes, or FAN nodes (low = high); lanes without one are infinitely far.
#[derive(Clone)]
struct Tile {
    low: [Lanes; 3],
    high: [Lanes; 3],
}

impl Tile {
    const EMPTY: Tile = Tile {
        low: [[f32::INFINITY; FAN]; 3],
        high: [[f32::INFINITY; FAN]; 3],
    };

    /// The box around all lanes.
    fn hull(&self) -> [[f32; 3]; 2] {
        let fold =
            |v: &Lanes, f: fn(f32, f32) -> f32, start| v.iter().filter(|v| v.is_finite()).copied().fold(start, f);
        [
            std::array::from_fn(|a| fold(&self.low[a], f32::min, f32::INFINITY)),
            std::array::from_fn(|a| fold(&self.high[a], f32::max, 0.0)),
        ]
    }

    /// Tiles of FAN boxes each.
    fn of(boxes: impl Iterator<Item = [[f32; 3]; 2]>) -> Vec<Tile> {
        let mut tiles = Vec::new();
        for (i, [low, high]) in boxes.enumerate() {
            if i % FAN == 0 {
                tiles.push(Tile::EMPTY);
            }
            if let Some(tile) = tiles.last_mut() {
                for a in 0..3 {
                    (tile.low[a][i % FAN], tile.high[a][i % FAN]) = (low[a], high[a]);
                }
            }
        }
        tiles
    }

    /// Squared distances from `p` to the boxes.
    #[inline]
    fn to_boxes(&self, p: [f32; 3]) -> [f64; FAN] {
        let mut sum = [0.0; FAN];
        for ((low, high), p) in self.low.iter().zip(&self.high).zip(p) {
            for ((low, high), sum) in low.iter().zip(high).zip(&mut sum) {
                let (below, above) = (low - p, p - high);
                let d = if below > above { below } else { above };
                let d = f64::from(if d > 0.0 { d } else { 0.0 });
                *sum += d * d;
            }
        }
        sum
    }

    /// False only if no node is as near as `reach`, a squared distance: rounding errors are below 2^-21.
    #[inline]
    fn may_reach(&self, p: [f32; 3], reach: f64) -> bool {
        let mut sum = [0.0f32; FAN];
        for (x, p) in self.low.iter().zip(p) {
            for (x, sum) in x.iter().zip(&mut sum) {
                *sum += (x - p) * (x - p);
            }
        }
        let reach = (reach * (1.0 + 2f64.powi(-20))) as f32;
        sum.iter().fold(false, |any, d| any | (*d <= reach))
    }

    /// Squared distances from `p` to the nodes.
    #[inline]
    fn to_nodes(&self, p: [f32; 3]) -> [f64; FAN] {
        let mut sum = [0.0; FAN];
        for (x, p) in self.low.iter().zip(p) {
            for (x, sum) in x.iter().zip(&mut sum) {
                let d = f64::from(x - p);
                *sum += d * d;
            }
        }
        sum
    }
}

pub struct NodeTree {
    /// Tier 0 has the nodes, tier t a box for each tile of tier t - 1; the last is one tile.
    tiers: Vec<Vec<Tile>>,
}

impl NodeTree {
    pub fn new(nodes: &[[u32; 3]]) -> Self {
        let points = nodes.iter().map(|n| [n.map(|v| v as f32); 2]);
        let mut tiers = vec![Tile::of(points)];
        while let Some(top) = tiers.last().filter(|t| t.len() > 1) {
            tiers.push(Tile::of(top.iter().map(Tile::hull)));
        }
        NodeTree { tiers }
    }

    /// Squared distance to node `j`, if there is one.
    fn distance(&self, p: [f32; 3], j: u32) -> Option<u64> {
        let tile = self.tiers[0].get(j as usize / FAN)?;
        Some(tile.to_nodes(p)[j as usize % FAN] as u64)
    }
}

pub type Key = (u64, u32); // squared distance, index of the node
const FAR: Key = (u64::MAX, u32::MAX);

/// Searches for points one after the other.
pub struct Search<'a> {
    tree: &'a NodeTree,
    count: usize,
    last: Option<[u32; 3]>,
    best: [Key; NEIGHBORS_MAX + 1],
}

impl<'a> Search<'a> {
    /// For the `count` nearest, 1 to `NEIGHBORS_MAX + 1`.
    pub fn new(tree: &'a NodeTree, count: usize) -> Self {
        Search {
            tree,
            count: count.clamp(1, NEIGHBORS_MAX + 1),
            last: None,
            best: [FAR; NEIGHBORS_MAX + 1],
        }
    }

    /// The nearest nodes by (squared distance, index); places beyond the number of nodes hold the maximum.
    pub fn nearest(&mut self, p: [u32; 3]) -> &[Key] {
        if self.last != Some(p) {
            self.last = Some(p);
            let p = p.map(|v| v as f32);
            let bound = self.bound(p);
            self.best = [FAR; NEIGHBORS_MAX + 1];
            if !self.tree.tiers[0].is_empty() {
                self.visit(p, self.tree.tiers.len() - 1, 0, bound);
            }
        }
        &self.best[..self.count]
    }

    /// No key beyond this one is among the nearest of `p`: the nodes found for the last point are as many.
    fn bound(&self, p: [f32; 3]) -> Key {
        let key = |(_, j): &Key| self.tree.distance(p, *j).map_or(FAR, |d| (d, *j));
        self.best[..self.count].iter().map(key).max().unwrap_or(FAR)
    }

    /// A tile, its nearest box first; no key above `bound` is of interest.
    fn visit(&mut self, p: [f32; 3], tier: usize, tile: usize, bound: Key) {
        if tier == 0 {
            return self.leaf(p, tile, bound);
        }
        let d = self.tree.tiers[tier][tile].to_boxes(p);
        let home = (0..FAN).fold(0, |m, i| if d[i] < d[m] { i } else { m });
        for i in std::iter::once(home).chain((0..FAN).filter(|i| *i != home)) {
            // no node in the box has a key below this one
            let lowest = (d[i] as u64, ((tile * FAN + i) * FAN.pow(tier as u32)) as u32);
            if d[i].is_finite() && lowest <= bound.min(self.best[self.count - 1]) {
                self.visit(p, tier - 1, tile * FAN + i, bound);
            }
        }
    }

    fn leaf(&mut self, p: [f32; 3], tile: usize, bound: Key) {
        let nodes = &self.tree.tiers[0][tile];
        let reach = bound.min(self.best[self.count - 1]).0 as f64;
        if !nodes.may_reach(p, reach) {
            return;
        }
        let d = nodes.to_nodes(p);
        for (d, j) in d.iter().zip((tile * FAN) as u32..).filter(|(d, _)| **d <= reach) {
            let mut key = (*d as u64, j);
            for b in &mut self.best[..self.count] {
                if key < *b {
                    std::mem::swap(&mut key, b);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::neighbors::distance;
    use proptest::prelude::*;

    /// Spec 13.2 as written.
    fn brute_force(p: [u32; 3], nodes: &[[u32; 3]], count: usize) -> Vec<Key> {
        let mut all: Vec<Key> = nodes.iter().map(|n| distance(p, *n)).zip(0..).collect();
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
        fn as_by_brute_force(mut nodes in cloud(1200), points in cloud(40), sorted: bool, count in 1..=NEIGHBORS_MAX + 1) {
            if sorted {
                nodes.sort_by_key(|n| crate::morton::encode(*n));
            }
            let tree = NodeTree::new(&nodes);
            let mut search = Search::new(&tree, count);
            for p in points.iter().flat_map(|p| [*p, *p, nodes[p[0] as usize % nodes.len()]]) {
                prop_assert_eq!(search.nearest(p), brute_force(p, &nodes, count));
            }
        }
    }
}

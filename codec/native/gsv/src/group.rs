//! A group of integers and its invariants: the input of `encode`, the output of `decode`.
//!
//! Gaussians are stored layer after layer, in each layer the survivors of the reference before the births. A predicted
//! group holds all of its integers, also those that its payload takes from the reference.

use crate::attributes::Attribute;
use crate::error::{Error, Result};
use crate::fields::Writer;
use crate::header::{Header, LayerHeader};
use crate::levels::LEVELS;
use crate::morton;
use crate::rig::{self, Rig};
use crate::trajectories::Trajectories;
use crate::values::MAX_VALUE;

/// In `parents`: the Gaussian is a birth.
pub const BIRTH: u32 = u32::MAX;

/// N Gaussians over T frames. The births of a layer are in Morton order.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Group {
    pub header: Header,
    /// Gaussians of each decoded layer: those of the header, unless units are damaged.
    pub layers: Vec<LayerHeader>,
    /// Gaussians of each decoded tile of each layer: those of the header, or 0 where the tile is damaged or was not
    /// asked for.
    pub tiles: Vec<Vec<u32>>,
    /// In a predicted group: index in the reference of each Gaussian, or `BIRTH`.
    pub parents: Option<Vec<u32>>,
    pub positions: Vec<[u32; 3]>,
    /// Per attribute of the header: C integers per Gaussian.
    pub channels: Vec<Vec<i32>>,
    /// Decoded quaternions, wxyz; empty in a group to be encoded.
    pub rotations: Vec<[f32; 4]>,
    pub lifetimes: Option<Vec<[u16; 2]>>,
    pub node_positions: Vec<[u32; 3]>,
    pub node_trajectories: Trajectories,
    /// Predicts the motion of the nodes.
    pub rig: Option<Rig>,
    /// In the order of `header.trajectories`.
    pub trajectories: Vec<Trajectories>,
    /// Per layer: offsets that are added to log_scales and logit_opacities while it is the last decoded layer.
    pub corrections: Vec<[f32; 2]>,
}

fn must(holds: bool, message: impl FnOnce() -> String) -> Result<()> {
    if holds { Ok(()) } else { Err(Error::Input(message())) }
}

impl Group {
    /// Checks all rules that the bitstream cannot express; the message names the expected value. `reference`: the group
    /// that a predicted one refers to.
    pub fn validate(&self, reference: Option<&Group>) -> Result<()> {
        let h = &self.header;
        let before = reference.map(|r| &r.header);
        self.validate_parents()?;
        h.clone().fields(&mut Writer::default(), &mut Vec::new(), before)?;
        let top = LEVELS[LEVELS.len() - 1];
        h.check(&top, before).map_err(|e| Error::Input(e.to_string()))?;
        let n = self.range(0..self.layers.len()).len();
        must(self.layers.len() <= h.layers.len(), || {
            "expected the layers that the header announces".into()
        })?;
        must(self.positions.len() == n, || {
            format!("expected {n} positions, got {}", self.positions.len())
        })?;
        let sums = self.tiles.iter().map(|t| t.iter().sum::<u32>());
        must(sums.eq(self.layers.iter().map(|l| l.count)), || {
            "expected tiles that make up the layers".into()
        })?;
        must(self.lifetimes.is_some() == h.lifetimes, || {
            "expected lifetimes as the header says".into()
        })?;
        must(self.corrections.len() == self.layers.len(), || {
            "expected a correction for each layer".into()
        })?;
        must(self.node_positions.len() == h.nodes.count as usize, || {
            "expected as many nodes as the header says".into()
        })?;
        points("nodes", &self.node_positions, h.grid_bits)?;
        must(self.channels.len() == h.scales.len(), || {
            "expected channels for each attribute".into()
        })?;
        for ((values, scale), a) in self.channels.iter().zip(&h.scales).zip(h.attributes()) {
            let count = n * scale.steps.len();
            must(values.len() == count, || {
                format!("{}: expected {count} integers, got {}", a.name(), values.len())
            })?;
            range(a.name(), values)?;
        }
        self.validate_layers(reference)?;
        self.validate_time()
    }

    /// Checks that a predicted group, and no other, has `parents`, one per Gaussian.
    fn validate_parents(&self) -> Result<()> {
        let h = &self.header;
        must(self.parents.is_some() == (h.reference > 0), || {
            "expected parents in a predicted group only".into()
        })?;
        let parents = self.parents.as_deref().unwrap_or(&[]);
        must(
            parents.len() == if h.reference > 0 { self.positions.len() } else { 0 },
            || format!("expected {} parents, got {}", self.positions.len(), parents.len()),
        )
    }

    /// Checks that survivors have the order and the integers of the reference, and that births are in Morton order.
    fn validate_layers(&self, reference: Option<&Group>) -> Result<()> {
        let h = &self.header;
        let parents = self.parents.as_deref().unwrap_or(&[]);
        for (k, layer) in self.layers.iter().enumerate() {
            let range = self.range(k..k + 1);
            let middle = range.start + layer.survivors() as usize;
            points("positions", &self.positions[middle..range.end], h.grid_bits)?;
            self.validate_shifts(k, &range)?;
            let Some(r) = reference.filter(|_| h.reference > 0) else {
                continue;
            };
            let (survivors, births) = parents[range.clone()].split_at(middle - range.start);
            let theirs = r.range(k..k + 1);
            let known = survivors.iter().all(|p| theirs.contains(&(*p as usize)));
            must(
                known && survivors.is_sorted_by(|a, b| a < b) && births.iter().all(|p| *p == BIRTH),
                || {
                    format!(
                        "parents of layer {k}: expected increasing indices in that layer of the reference, then births"
                    )
                },
            )?;
            let same = |(i, p): (usize, &u32)| self.same(range.start + i, r, *p as usize);
            must(survivors.iter().enumerate().all(same), || {
                format!("layer {k}: expected survivors to have the integers of the reference")
            })?;
        }
        Ok(())
    }

    /// Checks that the integers of layer `k`, at `range`, are multiples of 2^shift of the layer.
    fn validate_shifts(&self, k: usize, range: &std::ops::Range<usize>) -> Result<()> {
        let h = &self.header;
        let holds = |shift: u32, v: i32| v & ((1 << shift) - 1) == 0;
        let shift = h.shift(k, Attribute::Means);
        let mut whole = self.positions[range.clone()]
            .iter()
            .flatten()
            .all(|v| holds(shift, *v as i32));
        for ((values, scale), a) in self.channels.iter().zip(&h.scales).zip(h.attributes()) {
            let (shift, c) = (h.shift(k, *a), scale.steps.len());
            whole &= values[range.start * c..range.end * c].iter().all(|v| holds(shift, *v));
        }
        must(whole, || {
            format!("layer {k}: expected integers that are multiples of 2^shift, as its shifts say")
        })
    }

    /// True if Gaussian `i` has the canonical integers of Gaussian `j` of the reference.
    fn same(&self, i: usize, reference: &Group, j: usize) -> bool {
        let mut channels = self.channels.iter().zip(&reference.channels).zip(&self.header.scales);
        self.positions.get(i) == reference.positions.get(j)
            && channels.all(|((own, r), s)| {
                let c = s.steps.len();
                own.get(i * c..(i + 1) * c) == r.get(j * c..(j + 1) * c)
            })
    }

    /// Index range of the Gaussians of some layers.
    pub fn range(&self, layers: std::ops::Range<usize>) -> std::ops::Range<usize> {
        let sum = |k: usize| self.layers.iter().take(k).map(|l| l.count as usize).sum();
        sum(layers.start)..sum(layers.end)
    }

    /// Index range of the Gaussians of tile `t` of layer `k`; empty if there is no such tile.
    pub fn tile_range(&self, k: usize, t: usize) -> std::ops::Range<usize> {
        let tiles = self.tiles.get(k).map_or(&[][..], Vec::as_slice);
        let first = self.range(k..k + 1).start + tiles.iter().take(t).map(|n| *n as usize).sum::<usize>();
        first..first + tiles.get(t).map_or(0, |n| *n as usize)
    }

    /// Divides the Gaussians of each layer into tiles: survivors as the reference is divided, births in order. Keeps
    /// the bounds.
    pub fn divide(&mut self, reference: Option<&Group>) {
        let cells = self.header.tile_cells() as usize;
        self.tiles = (0..self.layers.len())
            .map(|k| self.tiles_of(k, cells, reference))
            .collect();
        self.header.tiles.resize(self.tiles.len(), Vec::new());
        for (tiles, counts) in self.header.tiles.iter_mut().zip(&self.tiles) {
            tiles.resize(counts.len(), Default::default());
            tiles.iter_mut().zip(counts).for_each(|(tile, n)| tile.count = *n);
        }
    }

    fn tiles_of(&self, k: usize, cells: usize, reference: Option<&Group>) -> Vec<u32> {
        let range = self.range(k..k + 1);
        let born = range.start + self.layers[k].survivors() as usize;
        let parents = self
            .parents
            .as_deref()
            .and_then(|p| p.get(range.start..born))
            .unwrap_or(&[]);
        let mut out = Vec::new();
        if let Some(r) = reference {
            for t in 0..r.tiles.get(k).map_or(0, Vec::len) {
                let theirs = r.tile_range(k, t);
                let own = parents.iter().filter(|p| theirs.contains(&(**p as usize)));
                out.push(own.count() as u32);
            }
        }
        let births = range.end - born;
        out.extend((0..births.div_ceil(cells)).map(|t| (births - t * cells).min(cells) as u32));
        out
    }

    /// The correction of the last decoded layer, for log_scales and logit_opacities.
    pub fn correction(&self) -> [f32; 2] {
        self.corrections.last().copied().unwrap_or_default()
    }

    fn validate_time(&self) -> Result<()> {
        let h = &self.header;
        let n = self.positions.len();
        must(self.trajectories.len() == h.trajectories.len(), || {
            "expected trajectories as the header says".into()
        })?;
        for (t, head) in self.trajectories.iter().zip(&h.trajectories) {
            trajectory(
                head.attribute.name(),
                t,
                n,
                head.attribute.channels(h.sh_degree),
                head.coefficients,
            )?;
        }
        if h.nodes.count > 0 {
            trajectory(
                "nodes",
                &self.node_trajectories,
                self.node_positions.len(),
                6,
                h.nodes.coefficients,
            )?;
        }
        must(self.rig.is_some() == (h.rig.joints > 0), || {
            "expected a rig as the header says".into()
        })?;
        if let Some(rig) = &self.rig {
            validate_rig(rig, h)?;
        }
        for (i, [t0, t1]) in self.lifetimes.iter().flatten().enumerate() {
            must(t0 < t1 && *t1 <= h.frames, || {
                format!(
                    "lifetime of Gaussian {i}: expected 0 <= t0 < t1 <= {}, got [{t0}, {t1})",
                    h.frames
                )
            })?;
        }
        let lifetimes = self.lifetimes.as_ref().map_or(n, Vec::len);
        must(lifetimes == n, || format!("expected {n} lifetimes, got {lifetimes}"))
    }

    /// The channels of `a`; None if the group has none.
    pub fn channels_of(&self, a: Attribute) -> Option<&[i32]> {
        let at = self.header.attributes().iter().position(|b| *b == a)?;
        self.channels.get(at).map(Vec::as_slice)
    }
}

fn validate_rig(r: &Rig, h: &Header) -> Result<()> {
    let (j, m) = (usize::from(h.rig.joints), h.nodes.count as usize);
    let counts = [r.joints.len(), r.parents.len(), r.bind.len()];
    must(counts == [j; 3] && r.weights.len() == m * j, || {
        format!("rig: expected {j} joints, and {j} weights for each of {m} nodes")
    })?;
    must(r.parents.iter().zip(0..).all(|(p, j)| usize::from(*p) <= j), || {
        "rig: expected the parent of a joint before it".into()
    })?;
    must(r.weights.iter().all(|w| i32::from(*w) <= rig::WEIGHT_MAX), || {
        format!("rig: expected weights of 0 to {}", rig::WEIGHT_MAX)
    })?;
    range("rig", r.joints.as_flattened())?;
    range("rig", r.bind.as_flattened())?;
    trajectory("joints", &r.poses, j, rig::CHANNELS, h.frames)
}

fn points(name: &str, points: &[[u32; 3]], bits: u8) -> Result<()> {
    let outside = points.iter().flatten().find(|v| **v >> bits != 0);
    must(outside.is_none(), || {
        format!(
            "{name}: expected grid coordinates below 2^{bits}, got {}",
            outside.copied().unwrap_or(0)
        )
    })?;
    must(morton::is_sorted(points), || {
        format!("{name}: expected Morton order (see morton_order)")
    })
}

fn range(name: &str, values: &[i32]) -> Result<()> {
    let outside = values.iter().find(|v| v.unsigned_abs() > MAX_VALUE as u32);
    must(outside.is_none(), || {
        format!(
            "{name}: expected integers within +-{MAX_VALUE}, got {}; use a larger step",
            outside.copied().unwrap_or(0)
        )
    })
}

fn trajectory(name: &str, t: &Trajectories, count: usize, channels: usize, k: u16) -> Result<()> {
    must(t.channels == channels && t.len() == count, || {
        format!(
            "trajectories of {name}: expected {count} of {channels} channels, got {} of {}",
            t.len(),
            t.channels
        )
    })?;
    must(t.max_length() <= usize::from(k), || {
        format!("trajectories of {name}: expected at most {k} coefficients")
    })?;
    (0..count).try_for_each(|i| range(name, t.get(i)))
}

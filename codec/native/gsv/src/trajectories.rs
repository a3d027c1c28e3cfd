//! Trajectories (spec 11, 12): DCT-II coefficients of Gaussians or nodes <-> bins.
//!
//! Most Gaussians have no coefficients, so storage is sparse: time and memory are proportional to the coefficients
//! present.

use crate::model::Model;
use crate::neighbors::{NEAR, Near};
use crate::range_coder::Bins;
use crate::values::ValueModel;

const LENGTHS: usize = 32; // lengths with contexts of their own
const BLOCK: usize = 16; // indices that share a bin: 0 if none of them has coefficients

/// Coefficients of N Gaussians or nodes, `channels` values each, lowest frequency first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trajectories<V = i32> {
    pub channels: usize,
    /// N + 1 offsets, in coefficients: those of i are `start[i]..start[i + 1]`.
    start: Vec<u32>,
    /// `channels` values per coefficient.
    values: Vec<V>,
}

impl<V> Default for Trajectories<V> {
    fn default() -> Self {
        Trajectories {
            channels: 0,
            start: Vec::new(),
            values: Vec::new(),
        }
    }
}

impl<V: Copy + Default + PartialEq> Trajectories<V> {
    pub fn new(channels: usize) -> Self {
        Trajectories {
            channels,
            start: vec![0],
            values: Vec::new(),
        }
    }

    /// `count` Gaussians without coefficients.
    pub fn still(channels: usize, count: usize) -> Self {
        Trajectories {
            channels,
            start: vec![0; count + 1],
            values: Vec::new(),
        }
    }

    /// Appends one Gaussian. `coefficients`: `channels` values per coefficient; trailing zeros are dropped.
    pub fn push(&mut self, coefficients: &[V]) {
        let used = coefficients
            .iter()
            .rposition(|v| *v != V::default())
            .map_or(0, |last| last / self.channels.max(1) + 1);
        self.values.extend_from_slice(&coefficients[..used * self.channels]);
        self.start.push((self.values.len() / self.channels.max(1)) as u32);
    }

    /// The trajectories of `count` Gaussians from `first` on.
    pub fn part(&self, first: usize, count: usize) -> Self {
        let mut out = Trajectories::new(self.channels);
        (first..first + count).for_each(|i| out.push(self.get(i)));
        out
    }

    /// Appends the Gaussians of another layer.
    pub fn append(&mut self, other: Self) {
        if self.is_empty() {
            *self = other;
            return;
        }
        let base = self.start.last().copied().unwrap_or(0);
        self.start.extend(other.start.iter().skip(1).map(|s| base + s));
        self.values.extend(other.values);
    }

    pub fn len(&self) -> usize {
        self.start.len().saturating_sub(1)
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of values present.
    pub fn symbols(&self) -> usize {
        self.values.len()
    }

    /// The values of `i`, `channels` per coefficient; empty if there is no `i`.
    #[inline]
    pub fn get(&self, i: usize) -> &[V] {
        let place = |i: usize| self.start.get(i).map(|s| *s as usize * self.channels);
        match (place(i), place(i + 1)) {
            (Some(from), Some(to)) => self.values.get(from..to).unwrap_or(&[]),
            _ => &[],
        }
    }

    /// The largest number of coefficients.
    pub fn max_length(&self) -> usize {
        self.start.windows(2).map(|w| (w[1] - w[0]) as usize).max().unwrap_or(0)
    }
}

/// Chooses the contexts of the values.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Gaussians,
    Node,
}

impl Kind {
    fn class(self, k: usize, channel: usize) -> usize {
        match self {
            Kind::Gaussians => 3 * k.min(3) + channel % 3,
            Kind::Node => 6 * k.min(3) + channel,
        }
    }
}

/// Why decoding stopped.
#[derive(Debug, PartialEq, Eq)]
pub enum Stop {
    /// A forbidden value was read, or the payload is over.
    Broken,
    /// More symbols than the budget.
    Symbols,
}

/// Codes trajectories of at most `k_max` coefficients. `source`: the trajectories to encode, in the decoder empty;
/// `budget`: most values to decode.
pub fn code<C: Bins>(
    c: &mut C,
    model: &mut TrajectoryModel,
    k_max: usize,
    near: &[Near],
    source: &Trajectories,
    budget: u64,
) -> Result<Trajectories, Stop> {
    let channels = source.channels;
    let mut out = Trajectories::new(channels);
    let mut before = [false; 2]; // whether the two blocks before have coefficients, the last one first
    for (block, near) in near.chunks(BLOCK).enumerate() {
        let own = block * BLOCK..block * BLOCK + near.len();
        let any = model.any(c, own.clone().any(|i| !source.get(i).is_empty()), before);
        before = [any, before[0]];
        for (i, near) in own.zip(near) {
            if !any {
                out.push(&[]);
                continue;
            }
            let length = model.length(c, near, &out, source.get(i).len() / channels.max(1), k_max);
            if (out.values.len() + length * channels) as u64 > budget {
                return Err(Stop::Symbols);
            }
            model.coefficients(c, near, &mut out, source.get(i), length);
            if model.values.broken {
                return Err(Stop::Broken);
            }
        }
        if !c.alive() {
            return Err(Stop::Broken);
        }
    }
    Ok(out)
}

/// Adaptive model of the trajectories of one attribute, or of the nodes.
#[derive(Clone)]
pub struct TrajectoryModel {
    kind: Kind,
    lengths: Model,
    values: ValueModel,
}

impl TrajectoryModel {
    pub fn new(kind: Kind) -> Self {
        TrajectoryModel {
            kind,
            lengths: Model::new(16 * LENGTHS + 4, 16 * LENGTHS + 2, LENGTHS + 1),
            values: ValueModel::new(if kind == Kind::Node { 24 } else { 12 }),
        }
    }

    /// See `Counter::settle`.
    pub fn settle(&mut self) {
        self.lengths.settle();
        self.values.settle();
    }

    /// Codes whether any Gaussian of a block has coefficients.
    fn any<C: Bins>(&mut self, c: &mut C, want: bool, before: [bool; 2]) -> bool {
        let [last, other] = before.map(usize::from);
        let first = 16 * LENGTHS; // contexts of its own
        self.lengths
            .bin(c, want, first + 2 * last + other, first + last, LENGTHS)
    }

    #[cfg_attr(target_arch = "wasm32", inline(never))] // see channels.rs
    fn length<C: Bins>(&mut self, c: &mut C, near: &Near, out: &Trajectories, want: usize, k_max: usize) -> usize {
        let l = near.map(|j| out.get(j as usize).len() / out.channels.max(1));
        let a = 4 * l[0].min(3) + l[1].min(3);
        let b = (2 * l[0] + l[1] + l[2] + l[3]).min(15);
        let mut length = 0;
        while length < k_max {
            let z = length.min(LENGTHS - 1);
            if !self.lengths.bin(c, want > length, LENGTHS * a + z, LENGTHS * b + z, z) {
                break;
            }
            length += 1;
        }
        length
    }

    #[cfg_attr(target_arch = "wasm32", inline(never))] // see channels.rs
    fn coefficients<C: Bins>(&mut self, c: &mut C, near: &Near, out: &mut Trajectories, want: &[i32], length: usize) {
        let (channels, base) = (out.channels, out.values.len());
        for place in 0..length * channels {
            let mut around = [0; NEAR];
            let mut present = 0;
            for j in near.iter().filter(|j| **j != u32::MAX) {
                around[present] = out.get(*j as usize).get(place).copied().unwrap_or(0);
                present += 1;
            }
            let (k, channel) = (place / channels, place % channels);
            let own = &out.values[base..];
            let before = place.checked_sub(channels).map_or(0, |p| own[p]);
            let left = if channel > 0 { own[place - 1] } else { 0 };
            let x = want.get(place).copied().unwrap_or(0);
            let v = self
                .values
                .value(c, self.kind.class(k, channel), x, &around[..present], [before, left]);
            out.values.push(v);
        }
        out.start.push((out.values.len() / channels.max(1)) as u32);
    }
}

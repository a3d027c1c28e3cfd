//! A group in integers, and its invariants: what `encode` takes and `decode` gives.

use crate::attributes::Attribute;
use crate::error::{Error, Result};
use crate::fields::Writer;
use crate::header::Header;
use crate::levels::LEVELS;
use crate::morton;
use crate::trajectories::Trajectories;
use crate::values::MAX_VALUE;

/// N Gaussians over T frames, in Morton order.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Group {
    pub header: Header,
    pub positions: Vec<[u32; 3]>,
    /// Per attribute of the header, C integers per Gaussian.
    pub channels: Vec<Vec<i32>>,
    pub lifetimes: Option<Vec<[u16; 2]>>,
    pub node_positions: Vec<[u32; 3]>,
    pub node_trajectories: Trajectories,
    /// In the order of `header.trajectories`.
    pub trajectories: Vec<Trajectories>,
}

fn must(holds: bool, message: impl FnOnce() -> String) -> Result<()> {
    if holds { Ok(()) } else { Err(Error::Input(message())) }
}

impl Group {
    /// Checks everything that the bitstream cannot express; the message says what was expected.
    pub fn validate(&self) -> Result<()> {
        let h = &self.header;
        let n = h.count as usize;
        h.clone().fields(&mut Writer::default())?;
        let top = LEVELS[LEVELS.len() - 1];
        h.check(&top).map_err(|e| Error::Input(e.to_string()))?;
        must(self.positions.len() == n, || {
            format!("expected {n} positions, got {}", self.positions.len())
        })?;
        must(self.node_positions.len() == h.nodes.count as usize, || {
            "expected as many nodes as the header says".into()
        })?;
        points("positions", &self.positions, h.grid_bits)?;
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
        self.validate_time()
    }

    fn validate_time(&self) -> Result<()> {
        let h = &self.header;
        let n = h.count as usize;
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

    /// The channels of `a`, if the group has any.
    pub fn channels_of(&self, a: Attribute) -> Option<&[i32]> {
        let at = self.header.attributes().iter().position(|b| *b == a)?;
        self.channels.get(at).map(Vec::as_slice)
    }
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

//! Group header (spec 4): what a group holds and how to dequantize it, and the caps that it must keep (spec 5).
//!
//! A predicted group shares grid, attributes and layers with its reference, so its header is read and written with the
//! header of the reference.

mod syntax;

use crate::attributes::Attribute;
use crate::companding::Companding;
use crate::error::Result;
use crate::levels::Level;

/// Channels that may be companded: those of log_scales, and logit_opacities.
pub const COMPANDED_CHANNELS: usize = 4;
/// Scale exponents are integers in units of 1 / SCALE_EXPONENT_UNIT.
pub const SCALE_EXPONENT_UNIT: f32 = 32.0;
/// Most low bits that a layer may leave out.
pub const SHIFT_MAX: u8 = 15;
/// Most layers of a group.
pub const LAYERS_MAX: usize = 16;

/// Dequantization of the channels of one attribute: value = offset + step * integer.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scale {
    pub steps: Vec<f32>,
    pub offsets: Vec<f32>,
}

/// Trajectories of one attribute.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrajectoryHeader {
    pub attribute: Attribute,
    pub coefficients: u16,
    pub step: f32,
}

/// Header of the nodes, which carry the coarse motion of the group.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct NodeHeader {
    pub count: u32,
    pub neighbors: u8,
    pub coefficients: u16,
    pub rotation_step: f32,
    pub translation_step: f32,
}

/// Gaussians of one layer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LayerHeader {
    pub count: u32,
    /// Gaussians that are not in the reference; in an independent group all.
    pub births: u32,
}

impl LayerHeader {
    pub fn survivors(&self) -> u32 {
        self.count - self.births
    }
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct Header {
    pub frames: u16,
    /// The reference is this many groups back; 0: independent.
    pub reference: u16,
    pub origin: [f32; 3],
    pub grid_step: f32,
    pub grid_bits: u8,
    pub sh_degree: u8,
    pub layers: Vec<LayerHeader>,
    /// In the order of `Attribute::canonical(sh_degree)`.
    pub scales: Vec<Scale>,
    /// [channel of quats][channel of log_scales]: the step of the channel is divided by 2^(scale_exponent /
    /// SCALE_EXPONENT_UNIT * log_scale).
    pub scale_exponents: [[i8; 3]; 3],
    /// Of each layer: number of low bits of positions, then of the integers of each attribute, that are 0 and not coded.
    /// Empty: 0.
    pub shifts: Vec<[u8; 6]>,
    /// Of the channels of log_scales, then of logit_opacities. None: no companding.
    pub companding: Option<[Companding; COMPANDED_CHANNELS]>,
    pub trajectories: Vec<TrajectoryHeader>,
    /// `count` 0: none.
    pub nodes: NodeHeader,
}

impl Header {
    pub fn attributes(&self) -> &'static [Attribute] {
        Attribute::canonical(self.sh_degree)
    }

    /// Gaussians in all layers.
    pub fn count(&self) -> u64 {
        self.layers.iter().map(|l| u64::from(l.count)).sum()
    }

    /// Low bits that layer `k` leaves out of the integers of an attribute; `Means`: of positions.
    pub fn shift(&self, k: usize, attribute: Attribute) -> u32 {
        let own = self.shifts.get(k).and_then(|s| s.get(attribute as usize - 1));
        own.map_or(0, |s| u32::from(*s))
    }

    /// Companding of the channels of an attribute; empty: none.
    pub fn companding_of(&self, attribute: Attribute) -> &[Companding] {
        let all = self.companding.as_ref().map_or(&[][..], |c| &c[..]);
        match attribute {
            Attribute::LogScales => all.get(..3).unwrap_or(&[]),
            Attribute::LogitOpacities => all.get(3..).unwrap_or(&[]),
            _ => &[],
        }
    }

    /// Checks the caps; returns the symbols that the header announces (spec 5).
    pub fn check(&self, level: &Level, reference: Option<&Header>) -> Result<u64> {
        let unit = "group header";
        let (count, nodes) = (self.count(), u64::from(self.nodes.count));
        level.cap(unit, "Gaussians", count, u64::from(level.gaussians))?;
        level.cap(unit, "frames", u64::from(self.frames), u64::from(level.frames))?;
        level.cap(unit, "nodes", nodes, u64::from(level.nodes))?;
        level.cap(unit, "pairs of Gaussian and node", count * nodes, level.pairs)?;
        let channels: u64 = self.scales.iter().map(|s| s.steps.len() as u64).sum();
        let births: u64 = self.layers.iter().map(|l| u64::from(l.births)).sum();
        let deaths: u64 = (0..self.layers.len()).map(|k| self.candidates(k, reference)).sum();
        let symbols = births * (3 + channels)
            + count * self.trajectories.len() as u64
            + nodes * (3 + 6 * u64::from(self.nodes.coefficients))
            + deaths;
        level.cap(unit, "symbols", symbols, level.symbols)?;
        Ok(symbols)
    }

    /// Gaussians of the reference that the deaths unit of layer `k` codes; 0: there is no such unit.
    pub fn candidates(&self, k: usize, reference: Option<&Header>) -> u64 {
        let before = reference.filter(|_| self.reference > 0).and_then(|r| r.layers.get(k));
        match (self.layers.get(k), before) {
            (Some(own), Some(before)) if own.survivors() < before.count => u64::from(before.count),
            _ => 0,
        }
    }
}

//! Group header (spec 4): what a group holds and how to dequantize it, and the caps it must keep (spec 5).
//!
//! A predicted group has the grid, the attributes and the layers of the group that it refers to, so its header is read and
//! written with that group's header at hand.

mod syntax;

use crate::attributes::Attribute;
use crate::companding::Companding;
use crate::error::Result;
use crate::levels::Level;

/// Channels with a curve: those of log_scales, and logit_opacities.
pub const COMPANDED_CHANNELS: usize = 4;
/// Levers of the header are in units of 1 / SCALE_EXPONENT_UNIT.
pub const SCALE_EXPONENT_UNIT: f32 = 32.0;
/// Low bits that a layer may leave out.
pub const SHIFT_MAX: u8 = 15;
/// Layers of a group.
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

/// Coarse motion of the group.
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
    /// Those that the group codes itself, behind the survivors of the reference; all of an independent group.
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
    /// How many groups back the one is whose canonical integers this one takes; 0: independent.
    pub reference: u16,
    pub origin: [f32; 3],
    pub grid_step: f32,
    pub grid_bits: u8,
    pub sh_degree: u8,
    pub layers: Vec<LayerHeader>,
    /// In the order of `Attribute::canonical(sh_degree)`.
    pub scales: Vec<Scale>,
    /// Of each channel of quats: how its step falls with each of the log_scales, in octaves, times `SCALE_EXPONENT_UNIT`.
    pub scale_exponents: [[i8; 3]; 3],
    /// Of each layer: how many low bits of positions, then of each attribute's integers, are 0 and not coded. Empty: none.
    pub shifts: Vec<[u8; 6]>,
    /// Of the channels of log_scales, then of logit_opacities. None: their values are as they are coded.
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

    /// Low bits that layer `k` leaves out of an attribute's integers, `Means`: of positions.
    pub fn shift(&self, k: usize, attribute: Attribute) -> u32 {
        let own = self.shifts.get(k).and_then(|s| s.get(attribute as usize - 1));
        own.map_or(0, |s| u32::from(*s))
    }

    /// Of the channels of an attribute; empty if they have none.
    pub fn companding_of(&self, attribute: Attribute) -> &[Companding] {
        let all = self.companding.as_ref().map_or(&[][..], |c| &c[..]);
        match attribute {
            Attribute::LogScales => all.get(..3).unwrap_or(&[]),
            Attribute::LogitOpacities => all.get(3..).unwrap_or(&[]),
            _ => &[],
        }
    }

    /// Symbols known from the header (spec 5), after all caps were found to be kept.
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

    /// Gaussians of the reference that the deaths unit of layer `k` speaks about; 0: there is no such unit.
    pub fn candidates(&self, k: usize, reference: Option<&Header>) -> u64 {
        let before = reference.filter(|_| self.reference > 0).and_then(|r| r.layers.get(k));
        match (self.layers.get(k), before) {
            (Some(own), Some(before)) if own.survivors() < before.count => u64::from(before.count),
            _ => 0,
        }
    }
}

//! Group header (spec 4): the content of a group, its dequantization, and the caps that it must keep (spec 5).
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
/// Sides of tiles, log2.
pub const TILE_SIDES: std::ops::RangeInclusive<u8> = 4..=7;
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

/// Header of the rig, which predicts the motion of the nodes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RigHeader {
    pub joints: u8,
    pub rotation_step: f32,
    pub translation_step: f32,
}

/// Entry of one tile in the index of tiles (spec 4).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TileHeader {
    /// Number of Gaussians: survivors of the tile with the same index in the reference, or births.
    pub count: u32,
    /// Lower corner and upper corner, both included, in parts of the grid (tile_bounds.rs).
    pub bounds: [u16; 6],
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
    /// Spherical harmonics rotate with the nodes (spec 13.4); otherwise they stay fixed in the world.
    pub turned: bool,
    pub layers: Vec<LayerHeader>,
    /// A tile has up to 2^tile_side_log2 x 2^tile_side_log2 cells of the map.
    pub tile_side_log2: u8,
    /// Of each layer: first a tile of survivors for each tile of the reference, then the tiles of births.
    pub tiles: Vec<Vec<TileHeader>>,
    /// Every tile codes the lifetimes of its Gaussians; otherwise they are shown in all frames.
    pub lifetimes: bool,
    /// In the order of `Attribute::canonical(sh_degree)`.
    pub scales: Vec<Scale>,
    /// [channel of quats][channel of log_scales]: the step of the channel is divided by 2^(scale_exponent /
    /// SCALE_EXPONENT_UNIT * log_scale).
    pub scale_exponents: [[i8; 3]; 3],
    /// Per layer: number of low bits that are 0 and not coded, of positions, then of the integers of each attribute.
    /// Empty: 0.
    pub shifts: Vec<[u8; 6]>,
    /// Of the channels of log_scales, then of logit_opacities. None: no companding.
    pub companding: Option<[Companding; COMPANDED_CHANNELS]>,
    pub trajectories: Vec<TrajectoryHeader>,
    /// `count` 0: none.
    pub nodes: NodeHeader,
    /// `joints` 0: none.
    pub rig: RigHeader,
}

impl Header {
    pub fn attributes(&self) -> &'static [Attribute] {
        Attribute::canonical(self.sh_degree)
    }

    /// Gaussians in all layers.
    pub fn count(&self) -> u64 {
        self.layers.iter().map(|l| u64::from(l.count)).sum()
    }

    /// Most Gaussians of a tile.
    pub fn tile_cells(&self) -> u32 {
        1 << (2 * u32::from(self.tile_side_log2))
    }

    /// Number of tiles of layer `k` that hold survivors; the tiles of births follow.
    pub fn survivor_tiles(&self, k: usize) -> usize {
        let births = self.layers.get(k).map_or(0, |l| l.births.div_ceil(self.tile_cells()));
        self.tiles.get(k).map_or(0, |t| t.len().saturating_sub(births as usize))
    }

    /// The leading tiles of layer `k`, from whose models the others start: the first tile, unless it is empty, and the
    /// first tile of births.
    pub fn leading_tiles(&self, k: usize) -> [Option<usize>; 2] {
        let tiles = self.tiles.get(k).map_or(&[][..], Vec::as_slice);
        let born = self.survivor_tiles(k);
        let first = tiles.first().filter(|t| t.count > 0);
        [first.map(|_| 0), (born < tiles.len()).then_some(born)]
    }

    /// Number of Gaussians in the stream of deaths of a tile of survivors; 0: none has died, or a tile of births.
    pub fn candidates(&self, k: usize, t: usize, reference: Option<&Header>) -> u32 {
        let before = reference.filter(|_| t < self.survivor_tiles(k));
        let all = before.and_then(|r| r.tiles.get(k)?.get(t)).map_or(0, |r| r.count);
        let own = self
            .tiles
            .get(k)
            .and_then(|tiles| tiles.get(t))
            .map_or(0, |own| own.count);
        if own > 0 && own < all { all } else { 0 }
    }

    /// Number of low bits that layer `k` omits from the integers of an attribute; `Means`: from positions.
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
        let pairs = self.tiles.iter().enumerate();
        let deaths: u64 = pairs
            .flat_map(|(k, tiles)| (0..tiles.len()).map(move |t| (k, t)))
            .map(|(k, t)| u64::from(self.candidates(k, t, reference)))
            .sum();
        let symbols = births * (3 + channels)
            + count * self.trajectories.len() as u64
            + nodes * (3 + 6 * u64::from(self.nodes.coefficients))
            + u64::from(self.rig.joints) * (9 + 6 * u64::from(self.frames) + nodes)
            + deaths;
        level.cap(unit, "symbols", symbols, level.symbols)?;
        Ok(symbols)
    }
}

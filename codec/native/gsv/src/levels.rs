//! Levels (spec 5): caps on the size of a group, checked before memory is allocated.

use crate::error::{Error, Result};

/// The caps of one level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Level {
    pub level: u8,
    pub gaussians: u32,
    pub frames: u16,
    pub nodes: u32,
    /// Gaussians times nodes, which bounds the cost of the node search.
    pub pairs: u64,
    pub symbols: u64,
    pub bytes: u64,
}

const fn level(level: u8, gaussians: u32, frames: u16, nodes: u32, pairs: u64, symbols: u64, bytes: u64) -> Level {
    Level {
        level,
        gaussians,
        frames,
        nodes,
        pairs,
        symbols,
        bytes,
    }
}

pub const LEVELS: [Level; 4] = [
    level(1, 1 << 16, 64, 1 << 10, 1 << 26, 1 << 23, 1 << 24),
    level(2, 1 << 18, 128, 1 << 12, 1 << 28, 1 << 25, 1 << 26),
    level(3, 1 << 20, 256, 1 << 14, 1 << 30, 1 << 27, 1 << 28),
    level(4, 1 << 22, 256, 1 << 16, 1 << 32, 1 << 29, 1 << 30),
];

impl Level {
    pub fn get(number: u8) -> Result<Level> {
        let known = LEVELS.iter().find(|l| l.level == number);
        known
            .copied()
            .ok_or_else(|| Error::limit("level", format!("level {number} is not one of 1 to 4 of this version")))
    }

    /// `Error::Limit` if `value` exceeds `cap`.
    pub fn cap(&self, unit: &str, what: &str, value: u64, cap: u64) -> Result<()> {
        if value <= cap {
            return Ok(());
        }
        Err(Error::limit(
            unit,
            format!("{value} {what}, level {} allows {cap}", self.level),
        ))
    }
}

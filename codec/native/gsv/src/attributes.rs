//! The attribute table (spec 3.2): numbers, names and channels, declared once.

/// An attribute by its number in the stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Attribute {
    Means = 1,
    LogScales = 2,
    Quats = 3,
    LogitOpacities = 4,
    Sh0 = 5,
    ShN = 6,
}

use Attribute::*;

impl Attribute {
    pub const ALL: [Attribute; 6] = [Means, LogScales, Quats, LogitOpacities, Sh0, ShN];

    pub fn from_number(n: u8) -> Option<Attribute> {
        Self::ALL.into_iter().find(|a| *a as u8 == n)
    }

    pub fn name(self) -> &'static str {
        match self {
            Means => "means",
            LogScales => "log_scales",
            Quats => "quats",
            LogitOpacities => "logit_opacities",
            Sh0 => "sh0",
            ShN => "shN",
        }
    }

    /// Number of channels: integers per Gaussian.
    pub fn channels(self, sh_degree: u8) -> usize {
        match self {
            LogitOpacities => 1,
            ShN => 3 * sh_coefficients(sh_degree),
            _ => 3,
        }
    }

    /// Attributes with a channels unit, in the order of the header (spec 4).
    pub fn canonical(sh_degree: u8) -> &'static [Attribute] {
        let all = &[LogScales, Quats, LogitOpacities, Sh0, ShN];
        if sh_degree == 0 { &all[..4] } else { all }
    }
}

/// SH coefficients above degree 0, per colour channel.
pub fn sh_coefficients(sh_degree: u8) -> usize {
    (usize::from(sh_degree) + 1).pow(2) - 1
}

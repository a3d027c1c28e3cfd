//! Conformance of a group to its header (spec 3.1): every announced unit is present, and no other unit. Also finds the
//! units that are lost with a damaged one.

use crate::attributes::Attribute;
use crate::error::{Error, Result};
use crate::header::Header;
use crate::unit::{Unit, UnitKey, UnitType, unit_name};

/// A unit that is not decoded, because it is damaged or needs a damaged unit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// Index of the unit in the group.
    pub unit: usize,
    /// None: a type that this version skips.
    pub kind: Option<UnitType>,
    pub layer: u8,
    /// Index of a tile in its layer.
    pub index: u16,
    pub message: String,
}

/// A unit as a number: type, layer, index.
fn number((kind, layer, index): UnitKey) -> u32 {
    u32::from(kind as u8) << 24 | u32::from(layer) << 16 | u32::from(index)
}

/// The undamaged units of a group that may be decoded.
pub struct Sound<'a> {
    announced: Vec<(UnitKey, bool)>,
    units: Vec<Option<&'a Unit<'a>>>, // one per announced unit
}

impl<'a> Sound<'a> {
    pub fn get(&self, key: UnitKey) -> Option<&'a Unit<'a>> {
        self.units.get(find(&self.announced, key)?).copied().flatten()
    }
}

/// Index of a unit among the announced ones.
fn find(announced: &[(UnitKey, bool)], key: UnitKey) -> Option<usize> {
    announced
        .binary_search_by_key(&number(key), |(key, _)| number(*key))
        .ok()
}

/// Compares the units with the header; returns the units that can be decoded, and the damaged and lost ones. `layers`:
/// number of layers to decode; `wanted(layer, tile)`: whether to decode a tile.
///
/// # Errors
/// A unit that the header does not announce, or a second one with the same key; a missing unit; a damaged first tile of
/// an independent group.
pub fn check<'a>(
    units: &'a [Unit<'a>],
    header: &Header,
    layers: usize,
    wanted: impl Fn(u8, u16) -> bool,
) -> Result<(Sound<'a>, Vec<Damage>)> {
    let announced = announced(header, layers);
    let mut found: Vec<Option<&Unit>> = vec![None; announced.len()];
    for u in units {
        let Some(key) = u.key() else { continue };
        let fail = |expected: &str| Err(Error::bitstream(u.offset, u.label(), expected));
        match find(&announced, key).and_then(|at| found.get_mut(at)) {
            None => return fail("only units that the header announces"),
            Some(Some(_)) => return fail("one unit of each type, layer and index"),
            Some(slot) => *slot = Some(u),
        }
    }
    let end = units.last().map_or(0, |u| u.offset + u.payload.len());
    for ((key, required), found) in announced.iter().zip(&found) {
        let skipped = key.0 == UnitType::Tile && !wanted(key.1, key.2);
        if *required && !skipped && found.is_none() {
            let expected = format!("a unit {}, found none", unit_name(*key));
            return Err(Error::bitstream(end, "group", expected));
        }
    }
    let hurt = |key| {
        find(&announced, key)
            .and_then(|at| found[at])
            .filter(|u| u.damage.is_some())
    };
    let first = (UnitType::Tile, 0, 0);
    if let (0, Some(e)) = (header.reference, hurt(first).and_then(|u| u.damage.as_ref())) {
        return Err(e.clone());
    }
    let mut damage = Vec::new();
    for u in units {
        let message = match (&u.damage, u.key()) {
            (Some(e), _) => e.to_string(),
            (None, None) => continue,
            (None, Some(key)) => match needs(header, key).into_iter().flatten().find_map(hurt) {
                None => continue,
                Some(d) => {
                    let expected = format!("sound units to start from, but unit {} is damaged", d.number);
                    Error::bitstream(u.offset, u.label(), expected).to_string()
                }
            },
        };
        damage.push(Damage {
            unit: u.number,
            kind: u.kind,
            layer: u.layer,
            index: u.index,
            message,
        });
    }
    for u in found.iter_mut() {
        let lost = |u: &Unit| damage.iter().any(|d| d.unit == u.number);
        *u = u.filter(|u| damage.is_empty() || !lost(u));
    }
    let units = found;
    Ok((Sound { announced, units }, damage))
}

/// The units that a unit needs to be decoded.
fn needs(header: &Header, key: UnitKey) -> [Option<UnitKey>; 2] {
    let (kind, layer, index) = key;
    let k = usize::from(layer);
    let needed = match kind {
        UnitType::Tile => {
            let [first, born] = header.leading_tiles(k);
            let born = born.filter(|_| usize::from(index) >= header.survivor_tiles(k));
            [first, born].map(|t| t.map(|t| (UnitType::Tile, layer, t as u16)))
        }
        UnitType::NodeTrajectories | UnitType::Rig => [Some((UnitType::NodePositions, 0, 0)), None],
        UnitType::JointPoses => [(UnitType::NodePositions, 0, 0), (UnitType::Rig, 0, 0)].map(Some),
        _ => [None; 2],
    };
    needed.map(|need| need.filter(|need| *need != key))
}

/// The units that a header announces, in the order of `number`, each with a flag: required.
fn announced(h: &Header, layers: usize) -> Vec<(UnitKey, bool)> {
    let mut out = vec![((UnitType::GroupHeader, 0, 0), true)];
    for (k, tiles) in h.tiles.iter().enumerate().take(layers) {
        let present = tiles.iter().enumerate().filter(|(_, tile)| tile.count > 0);
        out.extend(present.map(|(t, _)| ((UnitType::Tile, k as u8, t as u16), true)));
    }
    if h.nodes.count > 0 {
        out.push(((UnitType::NodePositions, 0, 0), true));
        out.push(((UnitType::NodeTrajectories, 0, 0), true));
    }
    let poses = [UnitType::Rig, UnitType::JointPoses].map(|kind| ((kind, 0, 0), true));
    for k in 0..h.tiles.len().min(layers) {
        let corrected = [Attribute::LogScales, Attribute::LogitOpacities];
        out.extend(corrected.map(|a| ((UnitType::LayerCorrection, k as u8, a as u16), false)));
    }
    out.extend(poses.iter().filter(|_| h.rig.joints > 0));
    out
}

//! Conformance of a group to its header (spec 3.1): every announced unit is present, and no other unit is; and which units
//! are lost with a damaged one.

use crate::attributes::Attribute;
use crate::error::{Error, Result};
use crate::header::Header;
use crate::unit::{Unit, UnitKey, UnitType, unit_name};
use std::collections::{BTreeMap, BTreeSet};

/// A unit that is damaged, or needs one that is, and so is not decoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// Index of the unit in the group.
    pub unit: usize,
    /// None: a type that this version skips.
    pub kind: Option<UnitType>,
    pub layer: u8,
    /// Of a tile in its layer.
    pub index: u16,
    pub message: String,
}

/// The undamaged units of a group that may be decoded.
pub struct Sound<'a> {
    units: BTreeMap<(u8, u8, u16), &'a Unit<'a>>,
}

impl<'a> Sound<'a> {
    pub fn get(&self, (kind, layer, index): UnitKey) -> Option<&'a Unit<'a>> {
        self.units.get(&(kind as u8, layer, index)).copied()
    }
}

/// Compares the units with the header; returns those that can be decoded, and the others. `layers`: number of layers to
/// decode; `wanted(layer, tile)`: which tiles.
///
/// # Errors
/// A unit that the header does not announce, or twice; a missing unit; a damaged first tile of an independent group.
pub fn check<'a>(
    units: &'a [Unit<'a>],
    header: &Header,
    layers: usize,
    wanted: impl Fn(u8, u16) -> bool,
) -> Result<(Sound<'a>, Vec<Damage>)> {
    let announced = announced(header, layers);
    let mut found = BTreeSet::new();
    for u in units {
        let Some((kind, layer, index)) = u.key() else { continue };
        let key = (kind as u8, layer, index);
        let fail = |expected: &str| Err(Error::bitstream(u.offset, u.label(), expected));
        if !announced.contains_key(&key) {
            return fail("only units that the header announces");
        }
        if !found.insert(key) {
            return fail("one unit of each type, layer and index");
        }
    }
    let end = units.last().map_or(0, |u| u.offset + u.payload.len());
    for (key, (name, required)) in &announced {
        let skipped = key.0 == UnitType::Tile as u8 && !wanted(key.1, key.2);
        if *required && !skipped && !found.contains(key) {
            let expected = format!("a unit {}, found none", unit_name(*name));
            return Err(Error::bitstream(end, "group", expected));
        }
    }
    sort_out(units, header)
}

/// Separates what can be decoded from what is damaged or needs a damaged unit.
fn sort_out<'a>(units: &'a [Unit<'a>], header: &Header) -> Result<(Sound<'a>, Vec<Damage>)> {
    let hurt: BTreeMap<_, _> = units
        .iter()
        .filter(|u| u.damage.is_some())
        .filter_map(|u| Some((u.key().map(|(k, layer, index)| (k as u8, layer, index))?, u.number)))
        .collect();
    let (mut sound, mut damage) = (BTreeMap::new(), Vec::new());
    for u in units {
        let mut message = u.damage.as_ref().map(Error::to_string);
        if let Some((kind, layer, index)) = u.key() {
            let lost = needs(header, (kind, layer, index)).find_map(|key| hurt.get(&key));
            if let Some(d) = lost.filter(|_| message.is_none()) {
                let expected = format!("sound units to start from, but unit {d} is damaged");
                message = Some(Error::bitstream(u.offset, u.label(), expected).to_string());
            }
            let vital = header.reference == 0 && header.leading_tiles(0)[0] == Some(usize::from(index));
            if let (UnitType::Tile, 0, true, Some(e)) = (kind, layer, vital, &u.damage) {
                return Err(e.clone());
            }
            if message.is_none() {
                sound.insert((kind as u8, layer, index), u);
            }
        }
        damage.extend(message.map(|message| Damage {
            unit: u.number,
            kind: u.kind,
            layer: u.layer,
            index: u.index,
            message,
        }));
    }
    Ok((Sound { units: sound }, damage))
}

/// The units without which a unit cannot be decoded.
fn needs(header: &Header, (kind, layer, index): UnitKey) -> impl Iterator<Item = (u8, u8, u16)> {
    let k = usize::from(layer);
    let [first, born] = header.leading_tiles(k);
    let born = born.filter(|_| usize::from(index) >= header.survivor_tiles(k));
    let tiles = [first, born]
        .into_iter()
        .flatten()
        .map(move |t| (UnitType::Tile, layer, t as u16));
    let nodes = (kind == UnitType::NodeTrajectories).then_some((UnitType::NodePositions, 0, 0));
    let all = tiles.filter(move |_| kind == UnitType::Tile).chain(nodes);
    all.filter(move |need| *need != (kind, layer, index))
        .map(|(kind, layer, index)| (kind as u8, layer, index))
}

/// The units that a header announces; of each its name, and whether it is required.
fn announced(h: &Header, layers: usize) -> BTreeMap<(u8, u8, u16), (UnitKey, bool)> {
    let mut out = BTreeMap::new();
    let mut add = |key: UnitKey, required| _ = out.insert((key.0 as u8, key.1, key.2), (key, required));
    add((UnitType::GroupHeader, 0, 0), true);
    if h.nodes.count > 0 {
        add((UnitType::NodePositions, 0, 0), true);
        add((UnitType::NodeTrajectories, 0, 0), true);
    }
    for (k, tiles) in h.tiles.iter().enumerate().take(layers) {
        for (t, _) in tiles.iter().enumerate().filter(|(_, tile)| tile.count > 0) {
            add((UnitType::Tile, k as u8, t as u16), true);
        }
        for a in [Attribute::LogScales, Attribute::LogitOpacities] {
            add((UnitType::LayerCorrection, k as u8, a as u16), false);
        }
    }
    out
}

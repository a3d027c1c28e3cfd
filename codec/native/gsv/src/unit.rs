//! Units (spec 3): a group payload <-> the group header and typed, checksummed pieces.
//!
//! The header has a directory of the units: type, layer, index, size and checksum of each. So damage never hides where
//! the next unit begins, and a reader that has the header can fetch the units that it wants.

use crate::crc::crc32;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader, Writer};
use crate::header::Header;
use crate::parallel;

/// The unit types of this version (spec 3.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum UnitType {
    GroupHeader = 0,
    Tile = 1,
    NodePositions = 2,
    NodeTrajectories = 3,
    LayerCorrection = 4,
    Rig = 5,
    JointPoses = 6,
}

use UnitType::*;

impl UnitType {
    const ALL: [UnitType; 7] = [
        GroupHeader,
        Tile,
        NodePositions,
        NodeTrajectories,
        LayerCorrection,
        Rig,
        JointPoses,
    ];

    pub fn from_number(n: u8) -> Option<UnitType> {
        Self::ALL.into_iter().find(|u| *u as u8 == n)
    }

    pub fn name(self) -> &'static str {
        match self {
            GroupHeader => "group_header",
            Tile => "tile",
            NodePositions => "node_positions",
            NodeTrajectories => "node_trajectories",
            LayerCorrection => "layer_correction",
            Rig => "rig",
            JointPoses => "joint_poses",
        }
    }
}

/// Directory entry of a unit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Entry {
    pub number: u8,
    pub layer: u8,
    pub index: u16,
    pub size: u32,
    pub crc: u32,
}

impl Entry {
    pub fn new((kind, layer, index): UnitKey, payload: &[u8]) -> Result<Entry> {
        let size = u32::try_from(payload.len()).map_err(|_| Error::Input("a unit of more than 4 GiB".into()))?;
        Ok(Entry {
            number: kind as u8,
            layer,
            index,
            size,
            crc: crc32(&[payload]),
        })
    }

    pub fn fields<F: Fields>(&mut self, f: &mut F) -> Result<()> {
        f.u8(&mut self.number)?;
        f.u8(&mut self.layer)?;
        f.u16(&mut self.index)?;
        f.u32(&mut self.size)?;
        f.u32(&mut self.crc)
    }
}

/// Key of a unit in a group: type, layer, and the index of a tile, or the attribute of a correction.
pub type UnitKey = (UnitType, u8, u16);

/// One unit of a group; unit 0 is the group header. `kind` is None for a type that this version skips.
#[derive(Debug, Clone)]
pub struct Unit<'a> {
    /// Its index in the group.
    pub number: usize,
    pub kind: Option<UnitType>,
    pub layer: u8,
    pub index: u16,
    /// Offset of its payload in the group payload.
    pub offset: usize,
    pub size: usize,
    pub payload: &'a [u8],
    crc: u32,
    /// The error, if the unit is damaged.
    pub damage: Option<Error>,
}

impl Unit<'_> {
    pub fn key(&self) -> Option<UnitKey> {
        Some((self.kind?, self.layer, self.index))
    }

    /// For messages: "unit 3 (tile 2)".
    pub fn label(&self) -> String {
        let name = self.key().map_or("unknown".into(), unit_name);
        format!("unit {} ({name})", self.number)
    }
}

/// "tile 2 of layer 1".
pub fn unit_name((kind, layer, index): UnitKey) -> String {
    let index = if kind == Tile {
        format!(" {index}")
    } else {
        String::new()
    };
    let of = if layer > 0 {
        format!(" of layer {layer}")
    } else {
        String::new()
    };
    format!("{}{index}{of}", kind.name())
}

/// A number of layers that no group exceeds.
pub const ALL_LAYERS: usize = 256;
const HEAD: usize = 8; // length and checksum of the group header

/// Splits a group payload; damage is an error.
pub fn split(payload: &[u8], layers: usize) -> Result<Vec<Unit<'_>>> {
    let mut units = scan(payload, layers, false, |_, _| true)?;
    match units.iter_mut().find_map(|u| u.damage.take()) {
        Some(damage) => Err(damage),
        None => Ok(units),
    }
}

/// Splits a group payload and marks damaged units (spec 3): a wrong CRC, or cut off by the end of the payload.
///
/// Returns the units of the first `layers` layers only; the payload may end anywhere behind them. Of the tiles it
/// returns those with `wanted(layer, index)`; the bytes of other tiles are not read, and a `packed` payload does not
/// have them.
///
/// # Errors
/// The header is damaged, or its directory breaks a rule.
pub fn scan(payload: &[u8], layers: usize, packed: bool, wanted: impl Fn(u8, u16) -> bool) -> Result<Vec<Unit<'_>>> {
    let first = first(payload)?;
    let at_header = |e: Error| e.at(HEAD, "unit 0 (group_header)");
    let (_, directory) = Header::open(first.payload).map_err(at_header)?;
    let mut offset = first.offset + first.size;
    let mut units = vec![first];
    for (i, entry) in directory.iter().enumerate() {
        let fail = |expected: &str| {
            Err(Error::bitstream(
                HEAD,
                format!("unit {} of the directory", i + 1),
                expected,
            ))
        };
        let kind = UnitType::from_number(entry.number);
        match (kind, entry.index) {
            (Some(GroupHeader), _) => return fail("no second group_header"),
            (Some(NodePositions | NodeTrajectories | Rig | JointPoses), 1..) => return fail("an index of 0"),
            (Some(LayerCorrection), 0 | 1 | 3 | 5..) => return fail("a layer_correction of attribute 2 or 4"),
            _ => {}
        }
        let before = i.checked_sub(1).and_then(|i| directory.get(i));
        if before.is_some_and(|b| b.layer > entry.layer) {
            return fail("layers in increasing order");
        }
        if usize::from(entry.layer) >= layers {
            return Ok(checked(units));
        }
        let read = kind != Some(Tile) || wanted(entry.layer, entry.index);
        let size = if read || !packed { entry.size as usize } else { 0 };
        let own = payload.get(offset..).and_then(|rest| rest.get(..size));
        let rest = payload.len().saturating_sub(offset);
        if read {
            let mut unit = Unit {
                number: i + 1,
                kind,
                layer: entry.layer,
                index: entry.index,
                offset,
                size,
                payload: own.unwrap_or(&[]),
                crc: entry.crc,
                damage: None,
            };
            if own.is_none() {
                let expected = format!("{size} more bytes, found {rest}");
                unit.damage = Some(Error::bitstream(offset, unit.label(), expected));
            }
            units.push(unit);
        }
        offset = offset.saturating_add(size);
    }
    if offset < payload.len() {
        let expected = format!("the end of the group, found {} more bytes", payload.len() - offset);
        return Err(Error::bitstream(offset, "group", expected));
    }
    Ok(checked(units))
}

/// Compares the checksums of units that are not cut off with the directory.
fn checked(mut units: Vec<Unit>) -> Vec<Unit> {
    let computed = parallel::map(&units, |u| crc32(&[u.payload]));
    for (u, computed) in units.iter_mut().zip(computed).skip(1) {
        if u.damage.is_none() && u.crc != computed {
            let expected = format!("CRC-32 {:08x}, found {computed:08x}: the unit is damaged", u.crc);
            u.damage = Some(Error::bitstream(u.offset, u.label(), expected));
        }
    }
    units
}

/// The group header of a payload, which may end behind it.
pub fn first(payload: &[u8]) -> Result<Unit<'_>> {
    let mut r = Reader::new(payload);
    let (mut length, mut told) = (0, 0);
    let fail = |e: Error| e.at(0, "unit 0 (group_header)");
    r.u32(&mut length).map_err(fail)?;
    r.u32(&mut told).map_err(fail)?;
    let header = r.take(length as usize).map_err(fail)?;
    let computed = crc32(&[header]);
    if told != computed {
        let expected = format!("CRC-32 {told:08x}, found {computed:08x}: the unit is damaged");
        return Err(Error::bitstream(HEAD, "unit 0 (group_header)", expected));
    }
    Ok(Unit {
        number: 0,
        kind: Some(GroupHeader),
        layer: 0,
        index: 0,
        offset: HEAD,
        size: header.len(),
        payload: header,
        crc: told,
        damage: None,
    })
}

/// The payload of a group: header, then units.
pub fn write(header: &[u8], units: &[Vec<u8>]) -> Result<Vec<u8>> {
    let mut w = Writer::default();
    let mut length = u32::try_from(header.len()).map_err(|_| Error::Input("a header of more than 4 GiB".into()))?;
    w.u32(&mut length)?;
    w.u32(&mut crc32(&[header]))?;
    w.0.extend_from_slice(header);
    units.iter().for_each(|u| w.0.extend_from_slice(u));
    Ok(w.0)
}

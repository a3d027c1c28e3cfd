//! Units (spec 3): a group payload <-> typed, checksummed pieces.

use crate::attributes::Attribute;
use crate::crc::crc32;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader, Writer};
use crate::header::Header;

/// The unit types of this version (spec 3.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum UnitType {
    GroupHeader = 0,
    Positions = 1,
    Channels = 2,
    Lifetimes = 3,
    NodePositions = 4,
    NodeTrajectories = 5,
    Trajectories = 6,
    Deaths = 8,
    LayerCorrection = 9,
}

use UnitType::*;

impl UnitType {
    const ALL: [UnitType; 9] = [
        GroupHeader,
        Positions,
        Channels,
        Lifetimes,
        NodePositions,
        NodeTrajectories,
        Trajectories,
        Deaths,
        LayerCorrection,
    ];

    pub fn from_number(n: u8) -> Option<UnitType> {
        Self::ALL.into_iter().find(|u| *u as u8 == n)
    }

    pub fn name(self) -> &'static str {
        match self {
            GroupHeader => "group_header",
            Positions => "positions",
            Channels => "channels",
            Lifetimes => "lifetimes",
            NodePositions => "node_positions",
            NodeTrajectories => "node_trajectories",
            Trajectories => "trajectories",
            Deaths => "deaths",
            LayerCorrection => "layer_correction",
        }
    }

    /// The units that a unit of this type and `attribute` must depend on, where its layer has them.
    pub fn needs(self, attribute: Option<Attribute>) -> &'static [(UnitType, Option<Attribute>)] {
        match (self, attribute) {
            (Channels, Some(Attribute::Quats)) => &[(Positions, None), (Channels, Some(Attribute::LogScales))],
            (Channels, _) => &[(Positions, None)],
            (Lifetimes | Trajectories, _) => &[(Positions, None), (Deaths, None)],
            (NodeTrajectories, _) => &[(NodePositions, None)],
            _ => &[],
        }
    }
}

/// One unit of a group; `kind` is None for a type that this version skips.
#[derive(Debug, Clone)]
pub struct Unit<'a> {
    pub number: u8,
    pub kind: Option<UnitType>,
    pub layer: u8,
    pub attribute: Option<Attribute>,
    attribute_number: u8,
    /// Offset of the unit in the group payload.
    pub offset: usize,
    /// Offset of its payload in the group payload.
    pub payload_offset: usize,
    pub size: usize,
    pub payload: &'a [u8],
    /// What was expected, if the unit is damaged; then the other fields are what its bytes claim.
    pub damage: Option<Error>,
    pub dependencies: Vec<u8>,
}

impl Unit<'_> {
    /// For messages: "unit 3 (channels sh0)".
    pub fn label(&self, index: usize) -> String {
        let kind = self.kind.map_or("unknown", UnitType::name);
        let attribute = self.attribute.map_or(String::new(), |a| format!(" {}", a.name()));
        let layer = if self.layer > 0 {
            format!(" of layer {}", self.layer)
        } else {
            String::new()
        };
        format!("unit {index} ({kind}{attribute}{layer})")
    }
}

const UNITS_MAX: usize = 255;

/// A number of layers that no group exceeds.
pub const ALL_LAYERS: usize = 256;

/// Splits a group payload; checks every CRC and dependency.
pub fn split(payload: &[u8], layers: usize) -> Result<Vec<Unit<'_>>> {
    let mut units = scan(payload, layers)?;
    let later = |u: &Unit| u.damage.is_some() && usize::from(u.layer) >= layers; // or so it claims: then others are missing
    units.truncate(units.iter().position(later).unwrap_or(units.len()));
    match units.iter_mut().find_map(|u| u.damage.take()) {
        Some(damage) => Err(damage),
        None => Ok(units),
    }
}

/// Splits a group payload and marks damaged units (spec 3): wrong CRC; a dependency on a damaged unit; cut off by the end of
/// the payload; or a broken rule behind a damaged unit whose length may be wrong (where the header has no unit sizes).
///
/// Returns the units of the first `layers` layers only; the payload may end anywhere behind them.
///
/// # Errors
/// Unit 0 is damaged; undamaged bytes break a rule.
pub fn scan(payload: &[u8], layers: usize) -> Result<Vec<Unit<'_>>> {
    let mut units: Vec<Unit> = Vec::new();
    let (mut offset, mut damaged, mut sizes) = (0, false, Vec::new().into_iter());
    while (offset < payload.len() && units.len() <= UNITS_MAX) || units.is_empty() {
        let index = units.len();
        let mut unit = read(
            &payload[offset..],
            offset,
            index,
            sizes.next().map(|size| size as usize),
        );
        if unit.damage.is_none() && usize::from(unit.layer) >= layers {
            break;
        }
        if unit.damage.is_none() {
            let checked = check(&unit, &units).map_err(|e| Error::bitstream(offset, unit.label(index), e));
            unit.damage = checked.err();
            if !damaged && let Some(e) = unit.damage {
                return Err(e);
            }
        }
        if index == 0
            && let Some(e) = unit.damage
        {
            return Err(e);
        }
        if index == 0 {
            let told = Header::open(unit.payload).map_or(Vec::new(), |(_, sizes)| sizes);
            sizes = told.into_iter(); // a header that breaks a rule is an error of who reads all of it
        }
        damaged |= unit.damage.is_some();
        offset += unit.size;
        units.push(unit);
    }
    Ok(units)
}

/// The group header of a payload, which may end behind it.
pub fn first(payload: &[u8]) -> Result<Unit<'_>> {
    let mut unit = read(payload, 0, 0, None);
    match unit.damage.take() {
        Some(damage) => Err(damage),
        None if unit.kind == Some(GroupHeader) => Ok(unit),
        None => Err(Error::bitstream(0, "unit 0", "a group header")),
    }
}

/// The unit at the start of `data`, of the size in the header (`told`); the rest of the data, damaged, if that is too short.
fn read(data: &[u8], offset: usize, index: usize, told: Option<usize>) -> Unit<'_> {
    let data = told.and_then(|size| data.get(..size)).unwrap_or(data);
    let mut h = [0u8; 4];
    h.iter_mut().zip(data).for_each(|(h, b)| *h = *b);
    let [number, layer, attribute, dependency_count] = h;
    let kind = UnitType::from_number(number);
    let mut unit = Unit {
        number,
        kind,
        layer,
        attribute: Attribute::from_number(attribute).filter(|_| kind.is_some()),
        attribute_number: attribute,
        offset,
        payload_offset: offset + data.len(),
        size: data.len(),
        payload: &[],
        damage: None,
        dependencies: Vec::new(),
    };
    let mut r = Reader::new(data);
    if let Err(e) = body(&mut unit, &mut r, data, usize::from(dependency_count)) {
        unit.damage = Some(e.at(offset, &format!("unit {index}")));
    }
    if told.is_some_and(|size| size != unit.size) || (told.is_some() && unit.damage.is_some()) {
        unit.size = data.len();
        let differ = || Error::bitstream(offset, format!("unit {index}"), "the size that the header tells");
        unit.damage = unit.damage.or_else(|| Some(differ()));
    }
    unit
}

fn body<'a>(unit: &mut Unit<'a>, r: &mut Reader<'a>, data: &'a [u8], dependency_count: usize) -> Result<()> {
    r.take(4)?;
    unit.dependencies = r.take(dependency_count)?.to_vec();
    let (mut length, mut crc) = (0, 0);
    r.u32(&mut length)?;
    let head = &data[..r.position()];
    r.u32(&mut crc)?;
    let payload_offset = r.position();
    unit.payload = r.take(length as usize)?;
    (unit.payload_offset, unit.size) = (unit.offset + payload_offset, r.position());
    let computed = crc32(&[head, unit.payload]);
    if crc == computed {
        return Ok(());
    }
    let expected = format!("CRC-32 {computed:08x}, found {crc:08x}: the unit is damaged");
    Err(Error::bitstream(0, "", expected))
}

/// Checks the rules of spec 3 for a unit behind those in `before`; returns what was expected if one is broken.
fn check(unit: &Unit, before: &[Unit]) -> std::result::Result<(), String> {
    let index = before.len();
    if index >= UNITS_MAX {
        return Err(format!("at most {UNITS_MAX} units in a group"));
    }
    if (index == 0) != (unit.kind == Some(GroupHeader)) {
        return Err("unit 0, and no other, to be the group header".into());
    }
    if !unit.dependencies.is_sorted_by(|a, b| a < b) || unit.dependencies.iter().any(|d| usize::from(*d) >= index) {
        return Err("dependencies on earlier units in increasing order".into());
    }
    let damaged = |d: &&u8| before[usize::from(**d)].damage.is_some();
    if let Some(d) = unit.dependencies.iter().find(damaged) {
        return Err(format!("sound units to depend on, but unit {d} is damaged"));
    }
    let sound = || before.iter().filter(|u| u.damage.is_none());
    if sound().any(|u| u.layer > unit.layer) {
        return Err("layers in increasing order".into());
    }
    let Some(kind) = unit.kind else { return Ok(()) };
    let allowed = match kind {
        Channels => 2..=6,
        Trajectories => 1..=6,
        LayerCorrection => 2..=4,
        _ => 0..=0,
    };
    if !allowed.contains(&unit.attribute_number) || (kind, unit.attribute_number) == (LayerCorrection, 3) {
        return Err(format!("an attribute of {allowed:?}, found {}", unit.attribute_number));
    }
    if sound().any(|u| (u.number, u.layer, u.attribute) == (unit.number, unit.layer, unit.attribute)) {
        return Err("one unit of each type, layer and attribute".into());
    }
    Ok(())
}

/// Appends a unit without checks. `id`: type, layer and attribute; `dependencies`: indices of earlier units.
pub fn write(out: &mut Vec<u8>, id: [u8; 3], dependencies: &[u8], payload: &[u8]) -> Result<()> {
    let length = u32::try_from(payload.len()).map_err(|_| Error::Input("a unit of more than 4 GiB".into()))?;
    let mut w = Writer([&id[..], &[dependencies.len() as u8]].concat());
    w.0.extend_from_slice(dependencies);
    w.0.extend_from_slice(&length.to_be_bytes());
    let crc = crc32(&[&w.0, payload]);
    w.0.extend_from_slice(&crc.to_be_bytes());
    out.extend_from_slice(&w.0);
    out.extend_from_slice(payload);
    Ok(())
}

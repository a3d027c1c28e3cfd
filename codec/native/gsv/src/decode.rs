//! Payload -> group in integers (spec 3 to 12). The mirror of encode.rs.
//!
//! Positions first, since all contexts come from them; then every other unit, in parallel. Memory is taken only for what
//! the header announces and the level allows, and trajectories grow against what is left of the level's symbols.
//! Damage (spec 3) is an error, or what is not affected is decoded and the rest stands still or takes its offsets.

use crate::attributes::Attribute;
use crate::channels;
use crate::error::{Error, Result};
use crate::group::Group;
use crate::header::{Header, NodeHeader};
use crate::inventory::{self, Damage};
use crate::levels::Level;
use crate::lifetimes;
use crate::morton;
use crate::neighbors::{self, Near};
use crate::positions;
use crate::range_coder::Decoder;
use crate::trajectories::{self, Kind, Stop, Trajectories};
use crate::unit::{self, Unit, UnitType};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// What a unit decodes to, besides points.
enum Part {
    Channels(Vec<i32>),
    Lifetimes(Vec<[u16; 2]>),
    Trajectories(Trajectories),
}

/// Decodes a group payload under the caps of `level`.
///
/// # Errors
/// `Error::Bitstream` with offsets from the start of the payload; `Error::Limit`.
pub fn decode_group(payload: &[u8], level: &Level) -> Result<Group> {
    level.cap("group", "bytes", payload.len() as u64, level.bytes)?;
    decode_units(&unit::split(payload)?, level)
}

/// Decodes what is not damaged: damaged trajectories are none, damaged channels 0, damaged node units no nodes or no motion
/// of theirs, and damaged lifetimes leave all Gaussians shown.
///
/// # Errors
/// As `decode_group`, for damage only if it is in the header or in the positions.
pub fn decode_damaged(payload: &[u8], level: &Level) -> Result<(Group, Vec<Damage>)> {
    level.cap("group", "bytes", payload.len() as u64, level.bytes)?;
    decode(&unit::scan(payload)?, level)
}

/// Decodes units whose checksums were verified, or are of no interest (fuzzing).
pub fn decode_units(units: &[Unit], level: &Level) -> Result<Group> {
    Ok(decode(units, level)?.0)
}

fn decode(units: &[Unit], level: &Level) -> Result<(Group, Vec<Damage>)> {
    let Some(first) = units.first() else {
        return Err(Error::bitstream(0, "unit 0", "a group header"));
    };
    let mut header = Header::read(first.payload).map_err(|e| e.at(first.payload_offset, &first.label(0)))?;
    let known = header.check(level)?;
    let damage = inventory::check(units, &header)?;
    if header.nodes.count > 0 && inventory::find(units, UnitType::NodePositions, None).is_none() {
        header.nodes = NodeHeader::default();
    }
    let decoder = GroupDecoder {
        header: &header,
        units,
        level,
        symbols: AtomicU64::new(known),
    };
    let points = |kind, count| decoder.points(kind, count);
    let (positions, node_positions) = rayon::join(
        || points(UnitType::Positions, header.count),
        || {
            if header.nodes.count > 0 {
                points(UnitType::NodePositions, header.nodes.count)
            } else {
                Ok(Vec::new())
            }
        },
    );
    let (positions, node_positions) = (positions?, node_positions?);
    let near = neighbors::nearest(&positions);
    let near_nodes = neighbors::nearest(&node_positions);
    let decode = |(i, u): (usize, &Unit)| decoder.part(i, u, &near, &near_nodes).map(|p| p.map(|p| (i, p)));
    let parts = units
        .par_iter()
        .enumerate()
        .filter(|(_, u)| u.damage.is_none())
        .map(decode)
        .collect::<Result<Vec<_>>>()?;
    let mut group = Group {
        positions,
        node_positions,
        ..Group::default()
    };
    group.channels = vec![Vec::new(); header.attributes().len()];
    group.trajectories = vec![Trajectories::default(); header.trajectories.len()];
    for (i, part) in parts.into_iter().flatten() {
        place(&mut group, &header, units[i].attribute, part);
    }
    group.header = header;
    fill(&mut group);
    Ok((group, damage))
}

/// Stands in for units that are damaged: channels of 0, no trajectories.
fn fill(group: &mut Group) {
    let (h, n) = (&group.header, group.positions.len());
    for (values, scale) in group.channels.iter_mut().zip(&h.scales) {
        values.resize(n * scale.steps.len(), 0);
    }
    for (t, head) in group.trajectories.iter_mut().zip(&h.trajectories) {
        if t.channels == 0 {
            *t = Trajectories::still(head.attribute.channels(h.sh_degree), n);
        }
    }
    let nodes = group.node_positions.len();
    if group.node_trajectories.len() != nodes {
        group.node_trajectories = Trajectories::still(6, nodes);
    }
}

fn place(group: &mut Group, header: &Header, attribute: Option<Attribute>, part: Part) {
    match part {
        Part::Lifetimes(l) => group.lifetimes = Some(l),
        Part::Channels(v) => {
            let mut slots = header.attributes().iter().zip(&mut group.channels);
            if let Some((_, slot)) = slots.find(|(a, _)| Some(**a) == attribute) {
                *slot = v;
            }
        }
        Part::Trajectories(t) if attribute.is_none() => group.node_trajectories = t,
        Part::Trajectories(t) => {
            let mut slots = header.trajectories.iter().zip(&mut group.trajectories);
            if let Some((_, slot)) = slots.find(|(h, _)| Some(h.attribute) == attribute) {
                *slot = t;
            }
        }
    }
}

struct GroupDecoder<'a> {
    header: &'a Header,
    units: &'a [Unit<'a>],
    level: &'a Level,
    symbols: AtomicU64, // taken so far
}

impl GroupDecoder<'_> {
    fn points(&self, kind: UnitType, count: u32) -> Result<Vec<[u32; 3]>> {
        let Some(i) = inventory::find(self.units, kind, None) else {
            return Ok(Vec::new());
        };
        let unit = &self.units[i];
        let mut c = Decoder::new(unit.payload);
        let codes = positions::code(&mut c, &[], count, u32::from(self.header.grid_bits));
        finish(c, true, i, unit)?;
        Ok(codes.into_iter().map(morton::decode).collect())
    }

    fn part(&self, i: usize, unit: &Unit, near: &[Near], near_nodes: &[Near]) -> Result<Option<Part>> {
        let h = self.header;
        let mut c = Decoder::new(unit.payload);
        let (part, sound) = match (unit.kind, unit.attribute) {
            (Some(UnitType::Channels), Some(a)) => {
                let channels = a.channels(h.sh_degree);
                let mut values = vec![0; near.len() * channels];
                let sound = channels::code(&mut c, a, channels, near, &mut values);
                (Part::Channels(values), sound)
            }
            (Some(UnitType::Lifetimes), _) => {
                let mut l = vec![[0; 2]; near.len()];
                let sound = lifetimes::code(&mut c, h.frames, near, &mut l);
                (Part::Lifetimes(l), sound)
            }
            (Some(UnitType::Trajectories), Some(a)) => {
                let k = h
                    .trajectories
                    .iter()
                    .find(|t| t.attribute == a)
                    .map_or(0, |t| t.coefficients);
                let source = Trajectories::new(a.channels(h.sh_degree));
                let t = trajectories::code(&mut c, Kind::Gaussians, usize::from(k), near, &source, self.budget());
                self.count(t, i, unit)?
            }
            (Some(UnitType::NodeTrajectories), _) => {
                let k = usize::from(h.nodes.coefficients);
                let t = trajectories::code(&mut c, Kind::Nodes, k, near_nodes, &Trajectories::new(6), u64::MAX);
                self.count(t, i, unit)?
            }
            _ => return Ok(None),
        };
        finish(c, sound, i, unit)?;
        Ok(Some(part))
    }

    /// Symbols that are left to a unit; several units may take them at the same time, `count` has the last word.
    fn budget(&self) -> u64 {
        self.level.symbols.saturating_sub(self.symbols.load(Ordering::Relaxed))
    }

    fn count(&self, t: std::result::Result<Trajectories, Stop>, i: usize, unit: &Unit) -> Result<(Part, bool)> {
        let symbols = match &t {
            Ok(_) if unit.attribute.is_none() => 0, // nodes are counted from the header
            Ok(t) => t.symbols() as u64,
            Err(Stop::Symbols) => self.level.symbols + 1,
            Err(Stop::Broken) => return Ok((Part::Trajectories(Trajectories::default()), false)),
        };
        let sum = self
            .symbols
            .fetch_add(symbols, Ordering::Relaxed)
            .saturating_add(symbols);
        self.level.cap(&unit.label(i), "symbols", sum, self.level.symbols)?;
        Ok((Part::Trajectories(t.unwrap_or_default()), true))
    }
}

fn finish(c: Decoder, sound: bool, i: usize, unit: &Unit) -> Result<()> {
    let end = unit.payload_offset + unit.payload.len();
    match c.finish() {
        Err(expected) if sound || expected.starts_with("more") => Err(Error::bitstream(end, unit.label(i), expected)),
        _ if !sound => Err(Error::bitstream(
            unit.payload_offset,
            unit.label(i),
            "values within the range of spec 6.5 and 10",
        )),
        _ => Ok(()),
    }
}

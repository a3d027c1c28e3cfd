//! Payload -> group of integers (spec 3 to 12). The mirror of encode.rs.
//!
//! Positions first, since all contexts come from them; then every other unit in parallel, and the nodes beside them. Memory
//! is taken only for what the header announces and the level allows; trajectories grow against the symbols that the level
//! has left. Damage (spec 3) is an error (strict), or the undamaged units are decoded and the damaged ones get the defaults
//! of spec 3.

use crate::assemble::{LayerPoints, Part, Slot, append, assemble};
use crate::attributes::Attribute;
use crate::channels;
use crate::conformance::{self, Damage};
use crate::deaths;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader};
use crate::group::Group;
use crate::header::{Header, LayerHeader, NodeHeader};
use crate::levels::Level;
use crate::lifetimes;
use crate::morton;
use crate::neighbors::{self, Contexts};
use crate::positions;
use crate::range_coder::Decoder;
use crate::trajectories::{self, Kind, Stop, Trajectories};
use crate::unit::{self, ALL_LAYERS, Unit, UnitType};
use crate::values::MAX_VALUE;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Options of decoding.
#[derive(Clone, Copy)]
pub struct Decoding<'a> {
    pub level: &'a Level,
    /// The group that a predicted one refers to.
    pub reference: Option<&'a Group>,
    /// Number of layers to decode; the payload may end behind them.
    pub layers: usize,
}

impl<'a> Decoding<'a> {
    /// All layers of an independent group.
    pub fn at(level: &'a Level) -> Self {
        Decoding {
            level,
            reference: None,
            layers: ALL_LAYERS,
        }
    }
}

/// Decodes a group payload under the caps of `how.level`.
///
/// # Errors
/// `Error::Bitstream` with offsets from the start of the payload; `Error::Limit`.
pub fn decode_group(payload: &[u8], how: &Decoding) -> Result<Group> {
    how.level.cap("group", "bytes", payload.len() as u64, how.level.bytes)?;
    decode_units(&unit::split(payload, how.layers)?, how)
}

/// Decodes the undamaged units. Defaults for damaged ones: no trajectories; channels 0; no nodes, or nodes without motion;
/// all Gaussians shown in all frames; no deaths; no births in a layer with damaged positions.
///
/// # Errors
/// As `decode_group`; damage only of the header, or of the positions of the first layer of an independent group.
pub fn decode_damaged(payload: &[u8], how: &Decoding) -> Result<(Group, Vec<Damage>)> {
    how.level.cap("group", "bytes", payload.len() as u64, how.level.bytes)?;
    decode(&unit::scan(payload, how.layers)?, how)
}

/// Decodes units whose checksums were verified, or do not matter (fuzzing).
pub fn decode_units(units: &[Unit], how: &Decoding) -> Result<Group> {
    Ok(decode(units, how)?.0)
}

/// How many groups back a payload refers; 0: it is independent.
///
/// # Errors
/// `Error::Bitstream`: the header is damaged.
pub fn reference_of(payload: &[u8]) -> Result<u16> {
    let first = unit::first(payload)?;
    let opened = Header::open(first.payload).map_err(|e| e.at(first.payload_offset, &first.label(0)));
    opened.map(|(reference, _)| reference)
}

fn decode(units: &[Unit], how: &Decoding) -> Result<(Group, Vec<Damage>)> {
    let Some(first) = units.first() else {
        return Err(Error::bitstream(0, "unit 0", "a group header"));
    };
    let before = how.reference.map(|g| &g.header);
    let header = Header::read(first.payload, before).map_err(|e| e.at(first.payload_offset, &first.label(0)))?;
    let known = header.check(how.level, before)?;
    let damage = conformance::check(units, &header, before, how.layers)?;
    let decoder = GroupDecoder {
        reference: how.reference.filter(|_| header.reference > 0),
        header: &header,
        units,
        level: how.level,
        symbols: AtomicU64::new(known),
    };
    let known_layers = decoder.reference.map_or(header.layers.len(), |r| r.layers.len()); // a prefix refers to a prefix
    let count = known_layers.min(how.layers);
    let points = |k: usize| decoder.points_of_layer(k);
    let layers = (0..count).into_par_iter().map(points).collect::<Result<Vec<_>>>()?;
    let mut sound: Vec<(usize, &Unit)> = units.iter().enumerate().filter(|(_, u)| u.damage.is_none()).collect();
    sound.sort_by_key(|(_, u)| std::cmp::Reverse(u.payload.len())); // long ones first, so that threads end together
    let part = |(i, u): (usize, &Unit)| decoder.part(i, u, &layers).map(|p| p.map(|p| (i, p)));
    let (parts, nodes) = rayon::join(
        || sound.into_iter().par_bridge().map(part).collect::<Result<Vec<_>>>(),
        || decoder.nodes(),
    );
    let ((node_positions, node_trajectories), parts) = (nodes?, parts?);
    let mut slots: Vec<Slot> = (0..count).map(|_| Slot::new(&header)).collect();
    for (i, part) in parts.into_iter().flatten() {
        if let Some(slot) = slots.get_mut(usize::from(units[i].layer)) {
            slot.place(&header, units[i].attribute, part);
        }
    }
    let mut group = assemble(layers, slots, decoder.reference, &header);
    (group.node_positions, group.node_trajectories) = (node_positions, node_trajectories);
    group.header = header;
    if group.node_positions.is_empty() {
        group.header.nodes = NodeHeader::default();
    }
    if group.node_trajectories.len() != group.node_positions.len() {
        group.node_trajectories = Trajectories::still(6, group.node_positions.len());
    }
    Ok((group, damage))
}

struct GroupDecoder<'a> {
    header: &'a Header,
    reference: Option<&'a Group>,
    units: &'a [Unit<'a>],
    level: &'a Level,
    symbols: AtomicU64, // taken so far
}

impl GroupDecoder<'_> {
    /// Decodes a unit of points; empty if it is damaged or missing.
    fn points(&self, kind: UnitType, layer: u8, count: u32) -> Result<Vec<[u32; 3]>> {
        let Some(i) = conformance::find(self.units, (kind, layer, None)) else {
            return Ok(Vec::new());
        };
        let unit = &self.units[i];
        let shift = match kind {
            UnitType::Positions => self.header.shift(usize::from(layer), Attribute::Means),
            _ => 0,
        };
        let bits = u32::from(self.header.grid_bits) - shift;
        let end = unit.payload_offset + unit.payload.len();
        let codes = positions::decode(unit.payload, count, bits);
        let codes = codes.map_err(|expected| Error::bitstream(end, unit.label(i), expected))?;
        let points = codes.into_iter().map(morton::decode);
        Ok(points.map(|p| p.map(|v| v << shift)).collect())
    }

    /// Positions of layer `k`: survivors, then births. Damaged positions: no births; damaged deaths: all survive.
    fn points_of_layer(&self, k: usize) -> Result<LayerPoints> {
        let told = self.header.layers.get(k).copied().unwrap_or_default();
        let births = self.points(UnitType::Positions, k as u8, told.births)?;
        let survivors = self.survivors(k)?;
        let known = |i: &u32| self.reference.and_then(|r| r.positions.get(*i as usize)).copied();
        let mut positions: Vec<_> = survivors.iter().filter_map(known).collect();
        let births_count = births.len() as u32;
        append(&mut positions, births);
        let header = LayerHeader {
            count: positions.len() as u32,
            births: births_count,
        };
        Ok(LayerPoints {
            whole: header == told,
            header,
            contexts: Contexts::new(&positions, survivors.len()),
            survivors,
            positions,
        })
    }

    /// Indices of the survivors of layer `k` in the reference.
    fn survivors(&self, k: usize) -> Result<Vec<u32>> {
        let Some(r) = self.reference else {
            return Ok(Vec::new());
        };
        let range = r.range(k..k + 1);
        let all = range.start as u32..range.end as u32;
        let unit = conformance::find(self.units, (UnitType::Deaths, k as u8, None)).filter(|_| !range.is_empty());
        let Some((i, unit)) = unit.and_then(|i| Some((i, self.units.get(i)?))) else {
            return Ok(all.collect());
        };
        let mut c = Decoder::new(unit.payload);
        let mut dead = vec![false; range.len()];
        let sound = deaths::code(&mut c, &neighbors::nearest(&r.positions[range]), &mut dead);
        finish(c, sound, i, unit)?;
        let survivors: Vec<u32> = all.zip(&dead).filter(|(_, dead)| !**dead).map(|(i, _)| i).collect();
        let told = self.header.layers.get(k).map_or(0, LayerHeader::survivors);
        if survivors.len() != told as usize {
            let expected = format!("{told} survivors as the header says, found {}", survivors.len());
            return Err(Error::bitstream(unit.payload_offset, unit.label(i), expected));
        }
        Ok(survivors)
    }

    /// Nodes and their trajectories, which do not depend on the Gaussians.
    fn nodes(&self) -> Result<(Vec<[u32; 3]>, Trajectories)> {
        let h = &self.header.nodes;
        let positions = self.points(UnitType::NodePositions, 0, h.count)?;
        let Some(i) = conformance::find(self.units, (UnitType::NodeTrajectories, 0, None)) else {
            return Ok((positions, Trajectories::default()));
        };
        let (unit, near, k) = (
            &self.units[i],
            neighbors::nearest(&positions),
            usize::from(h.coefficients),
        );
        let mut c = Decoder::new(unit.payload);
        let t = trajectories::code(&mut c, Kind::Node, k, &near, &Trajectories::new(6), u64::MAX); // counted from the header
        finish(c, t.is_ok(), i, unit)?;
        Ok((positions, t.unwrap_or_default()))
    }

    /// Decodes a unit other than points; None: nothing to decode, or its layer is damaged.
    fn part(&self, i: usize, unit: &Unit, layers: &[LayerPoints]) -> Result<Option<Part>> {
        let h = self.header;
        let Some(layer) = layers.get(usize::from(unit.layer)) else {
            return Ok(None);
        };
        let mut c = Decoder::new(unit.payload);
        let (part, sound) = match (unit.kind, unit.attribute) {
            (Some(UnitType::Channels), Some(a)) => {
                let (channels, near) = (a.channels(h.sh_degree), layer.contexts.births());
                let mut values = vec![0; near.len() * channels];
                let read = channels::code(&mut c, a, channels, near, &mut values);
                let shift = h.shift(usize::from(unit.layer), a);
                let fit = values.iter().all(|v| v.abs() <= MAX_VALUE >> shift);
                values.iter_mut().for_each(|v| *v <<= shift);
                (Part::Channels(values), read && fit)
            }
            (Some(UnitType::Lifetimes | UnitType::Trajectories), _) if !layer.whole => return Ok(None),
            (Some(UnitType::Lifetimes), _) => {
                let mut l = vec![[0; 2]; layer.positions.len()];
                let sound = lifetimes::code(&mut c, h.frames, &layer.contexts.all, &mut l);
                (Part::Lifetimes(l), sound)
            }
            (Some(UnitType::Trajectories), Some(a)) => {
                let head = h.trajectories.iter().find(|t| t.attribute == a);
                let k = usize::from(head.map_or(0, |t| t.coefficients));
                let source = Trajectories::new(a.channels(h.sh_degree));
                let near = &layer.contexts.all;
                let t = trajectories::code(&mut c, Kind::Gaussians, k, near, &source, self.budget());
                self.count(t, i, unit)?
            }
            (Some(UnitType::LayerCorrection), _) => return correction(i, unit).map(Some),
            _ => return Ok(None),
        };
        finish(c, sound, i, unit)?;
        Ok(Some(part))
    }

    /// Symbols left for a unit. Several units may see the same number; `count` is what enforces the cap.
    fn budget(&self) -> u64 {
        self.level.symbols.saturating_sub(self.symbols.load(Ordering::Relaxed))
    }

    /// Adds the symbols of decoded trajectories to the total and checks the cap.
    fn count(&self, t: std::result::Result<Trajectories, Stop>, i: usize, unit: &Unit) -> Result<(Part, bool)> {
        let symbols = match &t {
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

/// Layer correction (spec 10.2).
fn correction(i: usize, unit: &Unit) -> Result<Part> {
    let mut r = Reader::new(unit.payload);
    let mut value = 0.0;
    let read = r
        .f32(&mut value, "a correction")
        .and_then(|()| r.must(r.rest() == 0, || "one number".into()));
    read.map_err(|e| e.at(unit.payload_offset, &unit.label(i)))?;
    Ok(Part::Correction(value))
}

/// Checks that the payload is used up and that no forbidden value was read (`sound`).
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

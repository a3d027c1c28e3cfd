//! Payload -> group of integers (spec 3 to 12). The mirror of encode.rs.
//!
//! Of each layer the tiles from whose models the others start, then all others in parallel; the nodes beside them. Memory is
//! taken only for what the header announces and the level allows; trajectories grow against the symbols that the level has
//! left. Damage (spec 3) is an error (strict), or the undamaged units are decoded.

use crate::assemble::{Tile, assemble};
use crate::attributes::Attribute;
use crate::channels;
use crate::conformance::{self, Damage, Sound};
use crate::deaths;
use crate::dequantize;
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader};
use crate::group::Group;
use crate::header::{Header, NodeHeader, RigHeader};
use crate::levels::Level;
use crate::lifetimes;
use crate::morton;
use crate::neighbors::{self, Near};
use crate::parallel;
use crate::positions::{self, SplitModel};
use crate::range_coder::Decoder;
use crate::rig::{self, Rig};
use crate::tile::{self, Models, Stream, StreamModel};
use crate::trajectories::{self, Kind, Stop, Trajectories, TrajectoryModel};
use crate::unit::{self, ALL_LAYERS, Unit, UnitType};
use crate::values::MAX_VALUE;
use std::sync::atomic::{AtomicU64, Ordering};

/// Options of decoding.
#[derive(Clone, Copy)]
pub struct Decoding<'a> {
    pub level: &'a Level,
    /// The group that a predicted one refers to.
    pub reference: Option<&'a Group>,
    /// Number of layers to decode; the payload may end behind them.
    pub layers: usize,
    /// Of each layer, which tiles are wanted; the bytes of others may be anything, but those from which others start are
    /// decoded anyway. None: all.
    pub tiles: Option<&'a [Vec<bool>]>,
    /// Whether tiles that were decoded for their models only are part of the group (spec 3.4). Where they are not, as in a share
    /// of a group whose other tiles somebody else holds, they are not decoded either in layers of which nothing is wanted.
    pub keep_leading: bool,
    /// Whether the payload has no bytes of the tiles that are not decoded: what is behind them follows at once.
    pub packed: bool,
}

impl<'a> Decoding<'a> {
    /// All of an independent group.
    pub fn at(level: &'a Level) -> Self {
        Decoding {
            level,
            reference: None,
            layers: ALL_LAYERS,
            tiles: None,
            keep_leading: true,
            packed: false,
        }
    }

    fn asks(&self, layer: usize, tile: usize) -> bool {
        let asked = |all: &[Vec<bool>]| all.get(layer).and_then(|own| own.get(tile)).copied().unwrap_or(false);
        self.tiles.is_none_or(asked)
    }

    fn wants(&self, header: &Header, layer: u8, tile: u16) -> bool {
        let (k, t) = (usize::from(layer), usize::from(tile));
        let any = || {
            let own = self.tiles.and_then(|all| all.get(k));
            self.keep_leading || own.is_none_or(|own| own.contains(&true))
        };
        self.asks(k, t) || (header.leading_tiles(k).contains(&Some(t)) && any())
    }
}

/// Decodes a group payload under the caps of `how.level`.
///
/// # Errors
/// `Error::Bitstream` with offsets from the start of the payload; `Error::Limit`.
pub fn decode_group(payload: &[u8], how: &Decoding) -> Result<Group> {
    let (header, mut units) = open(payload, how)?;
    match units.iter_mut().find_map(|u| u.damage.take()) {
        Some(damage) => Err(damage),
        None => Ok(decode(header, &units, how)?.0),
    }
}

/// Decodes the undamaged units. Damaged tiles are missing, and those that start from their models; without nodes, or without
/// their motion, Gaussians stay where they are.
///
/// # Errors
/// As `decode_group`; damage only of the header, or of the first tile of an independent group.
pub fn decode_damaged(payload: &[u8], how: &Decoding) -> Result<(Group, Vec<Damage>)> {
    let (header, units) = open(payload, how)?;
    decode(header, &units, how)
}

/// Decodes units whose checksums were verified, or do not matter (fuzzing).
pub fn decode_units(units: &[Unit], how: &Decoding) -> Result<Group> {
    let Some(first) = units.first() else {
        return Err(Error::bitstream(0, "unit 0", "a group header"));
    };
    Ok(decode(header_of(first, how)?, units, how)?.0)
}

/// How many groups back a payload refers; 0: it is independent.
///
/// # Errors
/// `Error::Bitstream`: the header is damaged.
pub fn reference_of(payload: &[u8]) -> Result<u16> {
    let first = unit::first(payload)?;
    let opened = Header::open(first.payload).map_err(|e| e.at(first.offset, &first.label()));
    opened.map(|(reference, _)| reference)
}

/// The header of a group, from a payload that may end behind it.
///
/// # Errors
/// The header is damaged or breaks a rule.
pub fn read_header(payload: &[u8], how: &Decoding) -> Result<Header> {
    header_of(&unit::first(payload)?, how)
}

fn header_of(first: &Unit, how: &Decoding) -> Result<Header> {
    let before = how.reference.map(|g| &g.header);
    Header::read(first.payload, before).map_err(|e| e.at(first.offset, &first.label()))
}

fn open<'a>(payload: &'a [u8], how: &Decoding) -> Result<(Header, Vec<Unit<'a>>)> {
    how.level.cap("group", "bytes", payload.len() as u64, how.level.bytes)?;
    let header = read_header(payload, how)?;
    let wanted = |layer, tile| how.wants(&header, layer, tile);
    let mut units = unit::scan(payload, how.layers, how.packed, wanted)?;
    for u in units.iter_mut().filter(|u| u.kind == Some(UnitType::Tile)) {
        let unasked = !how.asks(u.layer.into(), u.index.into());
        if let (true, Some(Error::Bitstream { expected, .. })) = (unasked, &mut u.damage) {
            expected.push_str("; the tiles that were asked for start from it");
        }
    }
    Ok((header, units))
}

fn decode(header: Header, units: &[Unit], how: &Decoding) -> Result<(Group, Vec<Damage>)> {
    let known = header.check(how.level, how.reference.map(|g| &g.header))?;
    let wanted = |layer, tile| how.wants(&header, layer, tile);
    let (sound, damage) = conformance::check(units, &header, how.layers, wanted)?;
    let decoder = GroupDecoder {
        reference: how.reference.filter(|_| header.reference > 0),
        header: &header,
        sound,
        how,
        symbols: AtomicU64::new(known),
    };
    let known_layers = decoder.reference.map_or(header.layers.len(), |r| r.layers.len()); // a prefix refers to a prefix
    let count = known_layers.min(how.layers);
    let order: Vec<usize> = (0..count).collect();
    let (layers, nodes) = parallel::join(
        || {
            parallel::map(&order, |k| decoder.layer(*k))
                .into_iter()
                .collect::<Result<Vec<_>>>()
        },
        || decoder.nodes(),
    );
    let corrections = (0..count)
        .map(|k| decoder.correction(k as u8))
        .collect::<Result<Vec<_>>>()?;
    let (nodes, layers) = (nodes?, layers?);
    let mut group = assemble(layers, corrections, decoder.reference, &header);
    (group.node_positions, group.node_trajectories, group.rig) = nodes;
    group.header = header;
    if group.node_positions.is_empty() {
        group.header.nodes = NodeHeader::default();
    }
    if group.rig.is_none() {
        group.header.rig = RigHeader::default();
    }
    if group.node_trajectories.len() != group.node_positions.len() {
        group.node_trajectories = Trajectories::still(6, group.node_positions.len());
    }
    Ok((group, damage))
}

struct GroupDecoder<'a> {
    header: &'a Header,
    reference: Option<&'a Group>,
    sound: Sound<'a>,
    how: &'a Decoding<'a>,
    symbols: AtomicU64, // taken so far
}

/// The bytes of a stream, and where they are, for messages.
struct Source<'a> {
    bytes: &'a [u8],
    offset: usize,
    label: String,
}

impl Source<'_> {
    fn fail<T>(&self, expected: impl Into<String>) -> Result<T> {
        Err(Error::bitstream(self.offset, &*self.label, expected))
    }

    /// Checks that the bytes are used up and that no forbidden value was read (`sound`).
    fn finish(&self, c: Decoder, sound: bool) -> Result<()> {
        let end = self.offset + self.bytes.len();
        match c.finish() {
            Err(expected) if sound || expected.starts_with("more") => {
                Err(Error::bitstream(end, &*self.label, expected))
            }
            _ if !sound => self.fail("values within the range of spec 6.5 and 10"),
            _ => Ok(()),
        }
    }
}

/// What a stream other than positions and deaths holds.
enum Part {
    Channels(usize, Vec<i32>),
    Trajectories(usize, Trajectories),
    Lifetimes(Vec<[u16; 2]>),
}

/// Positions of nodes, their trajectories, and the rig.
type Nodes = (Vec<[u32; 3]>, Trajectories, Option<Rig>);

/// A tile, and what its models have learned.
type Learned = (Tile, Vec<(Stream, StreamModel)>);

impl GroupDecoder<'_> {
    /// The tiles of layer `k`.
    fn layer(&self, k: usize) -> Result<Vec<Tile>> {
        let count = self.header.tiles.get(k).map_or(0, Vec::len);
        let mut tiles: Vec<Tile> = Vec::new();
        tiles.resize_with(count, Tile::default);
        let (mut models, leading) = (Models::default(), self.header.leading_tiles(k));
        for (i, t) in leading.into_iter().enumerate() {
            let Some(t) = t.filter(|_| !leading[..i].contains(&t)) else {
                continue;
            };
            if !self.reference_has(k, t) {
                return Ok(tiles); // lost with the reference, and so are those that start from it
            }
            let (tile, learned) = self.tile(k, t, &models)?;
            if count > 1 {
                learned
                    .into_iter()
                    .for_each(|(stream, model)| models.learn(stream, model));
            }
            let kept = self.how.keep_leading || self.how.asks(k, t);
            tiles[t] = if kept { tile } else { self.blank(k, t) };
        }
        let others: Vec<usize> = (0..count).filter(|t| !leading.contains(&Some(*t))).collect();
        let decoded = parallel::map(&others, |t| self.tile(k, *t, &models));
        for (t, learned) in others.into_iter().zip(decoded) {
            tiles[t] = learned?.0;
        }
        Ok(tiles)
    }

    /// Tile `t` of layer `k`; `models`: what its streams start from.
    fn tile(&self, k: usize, t: usize, models: &Models) -> Result<Learned> {
        let h = self.header;
        let mut tile = self.blank(k, t);
        let candidates = tile.survivors.as_ref().and(self.reference).map(|r| r.tile_range(k, t));
        let Some(unit) = self
            .sound
            .get((UnitType::Tile, k as u8, t as u16))
            .filter(|_| self.reference_has(k, t))
        else {
            return Ok((tile, Vec::new()));
        };
        let streams = Stream::of(h, k, t, self.reference.map(|r| &r.header));
        let parts = tile::split(unit.payload, streams.len());
        let parts = parts.map_err(|(at, expected)| Error::bitstream(unit.offset + at, unit.label(), expected))?;
        let mut sources = streams.iter().zip(parts).map(|(stream, (at, bytes))| {
            let label = format!("{}, {}", unit.label(), stream.name(h));
            let offset = unit.offset + at;
            (*stream, Source { bytes, offset, label })
        });
        let mut learned = Vec::new();
        match candidates {
            None => {
                if let Some((stream, source)) = sources.next() {
                    let mut model = models.of(stream, h);
                    let count = h.tiles[k][t].count;
                    tile.positions = self.points(&source, &mut model, count, h.shift(k, Attribute::Means))?;
                    learned.push((stream, model));
                }
            }
            Some(range) => {
                let first = (h.candidates(k, t, self.reference.map(|r| &r.header)) > 0).then(|| sources.next());
                let survivors =
                    self.survivors(range, first.flatten().map(|(_, source)| source), h.tiles[k][t].count)?;
                let known = self.reference.map_or(&[][..], |r| &r.positions);
                tile.positions = survivors
                    .iter()
                    .filter_map(|i| known.get(*i as usize))
                    .copied()
                    .collect();
                tile.survivors = Some(survivors);
            }
        }
        let near = neighbors::nearest(&tile.positions);
        tile.channels.resize(h.scales.len(), Vec::new());
        let others: Vec<(Stream, Source)> = sources.collect();
        let decoded = parallel::map(&others, |(stream, source)| {
            let mut model = models.of(*stream, h);
            let part = self.part(k, *stream, source, &near, &mut model)?;
            Ok((*stream, model, part))
        });
        for (stream, model, part) in decoded.into_iter().collect::<Result<Vec<_>>>()? {
            learned.push((stream, model));
            match part {
                Some(Part::Channels(i, v)) => tile.channels[i] = v,
                Some(Part::Trajectories(i, v)) => tile.trajectories[i] = v,
                Some(Part::Lifetimes(v)) => tile.lifetimes = v,
                None => {}
            }
        }
        if tile.survivors.is_none() {
            tile.rotations = self.rotations(&tile.channels, &near);
        }
        Ok((tile, learned))
    }

    /// Tile `t` of layer `k` without Gaussians.
    fn blank(&self, k: usize, t: usize) -> Tile {
        let h = self.header;
        let heads = h.trajectories.iter();
        Tile {
            survivors: (t < h.survivor_tiles(k)).then(Vec::new),
            trajectories: heads
                .map(|t| Trajectories::new(t.attribute.channels(h.sh_degree)))
                .collect(),
            ..Tile::default()
        }
    }

    /// False if tile `t` of layer `k` holds survivors of a tile that the reference lacks.
    fn reference_has(&self, k: usize, t: usize) -> bool {
        let Some(r) = self.reference.filter(|_| t < self.header.survivor_tiles(k)) else {
            return true;
        };
        let told = r
            .header
            .tiles
            .get(k)
            .and_then(|tiles| tiles.get(t))
            .map(|tile| tile.count as usize);
        told == Some(r.tile_range(k, t).len())
    }

    /// Quaternions of births.
    fn rotations(&self, channels: &[Vec<i32>], near: &[Near]) -> Vec<[f32; 4]> {
        let integers = |a| {
            let at = self.header.attributes().iter().position(|b| *b == a);
            at.and_then(|k| channels.get(k)).map_or(&[][..], Vec::as_slice)
        };
        dequantize::rotations(
            self.header,
            integers(Attribute::Quats),
            integers(Attribute::LogScales),
            near,
        )
    }

    /// Decodes points without their lowest `shift` bits.
    fn points(&self, source: &Source, model: &mut StreamModel, count: u32, shift: u32) -> Result<Vec<[u32; 3]>> {
        let StreamModel::Positions(model) = model else {
            return Ok(Vec::new());
        };
        let bits = u32::from(self.header.grid_bits) - shift;
        let codes = match positions::decode(model, source.bytes, count, bits) {
            Ok(codes) => codes,
            Err(expected) => {
                let end = source.offset + source.bytes.len();
                return Err(Error::bitstream(end, &*source.label, expected));
            }
        };
        let points = codes.into_iter().map(morton::decode);
        Ok(points.map(|p| p.map(|v| v << shift)).collect())
    }

    /// Indices of the survivors among those of the reference at `range`; `source`: which have died, None: none has.
    fn survivors(&self, range: std::ops::Range<usize>, source: Option<Source>, told: u32) -> Result<Vec<u32>> {
        let (Some(r), Some(source)) = (self.reference, source) else {
            return Ok((range.start as u32..range.end as u32).collect());
        };
        let positions = r.positions.get(range.clone()).unwrap_or(&[]);
        let mut c = Decoder::new(source.bytes);
        let mut dead = vec![false; positions.len()];
        let sound = deaths::code(&mut c, &neighbors::nearest(positions), &mut dead);
        source.finish(c, sound)?;
        let alive = (range.start as u32..).zip(&dead).filter(|(_, dead)| !**dead);
        let survivors: Vec<u32> = alive.map(|(i, _)| i).collect();
        if survivors.len() != told as usize {
            return source.fail(format!(
                "{told} survivors as the header says, found {}",
                survivors.len()
            ));
        }
        Ok(survivors)
    }

    /// Nodes, their trajectories and the rig, which do not depend on the Gaussians.
    fn nodes(&self) -> Result<Nodes> {
        let h = &self.header.nodes;
        let Some(own) = self.source(UnitType::NodePositions) else {
            return Ok(Default::default());
        };
        let positions = self.points(&own, &mut StreamModel::Positions(SplitModel::default()), h.count, 0)?;
        let near = neighbors::nearest(&positions);
        let (motion, rig) = (self.node_trajectories(&near)?, self.rig(&near)?);
        Ok((positions, motion, rig))
    }

    /// A unit that a group has once.
    fn source(&self, kind: UnitType) -> Option<Source<'_>> {
        let unit = self.sound.get((kind, 0, 0))?;
        let (bytes, offset, label) = (unit.payload, unit.offset, unit.label());
        Some(Source { bytes, offset, label })
    }

    /// `near`: the neighbours of each node.
    fn node_trajectories(&self, near: &[Near]) -> Result<Trajectories> {
        let Some(motion) = self.source(UnitType::NodeTrajectories) else {
            return Ok(Trajectories::default());
        };
        let k = usize::from(self.header.nodes.coefficients);
        let mut c = Decoder::new(motion.bytes);
        let mut model = TrajectoryModel::new(Kind::Node);
        let t = trajectories::code(&mut c, &mut model, k, near, &Trajectories::new(6), u64::MAX); // counted from the header
        motion.finish(c, t.is_ok())?;
        Ok(t.unwrap_or_default())
    }

    /// The rig with the poses of its joints; None if one of the two is missing. `near`: the neighbours of each node.
    fn rig(&self, near: &[Near]) -> Result<Option<Rig>> {
        let (Some(own), Some(poses)) = (self.source(UnitType::Rig), self.source(UnitType::JointPoses)) else {
            return Ok(None);
        };
        let mut c = Decoder::new(own.bytes);
        let rig = rig::code(&mut c, usize::from(self.header.rig.joints), near, &Rig::default());
        own.finish(c, rig.is_some())?;
        let mut rig = rig.unwrap_or_default();
        let (mut c, blank) = (Decoder::new(poses.bytes), Trajectories::new(rig::CHANNELS));
        let t = rig::code_poses(&mut c, &rig.parents, self.header.frames, &blank);
        poses.finish(c, t.is_ok())?;
        rig.poses = t.unwrap_or_default();
        Ok(Some(rig))
    }

    /// Decodes a stream other than positions and deaths.
    fn part(
        &self,
        k: usize,
        stream: Stream,
        source: &Source,
        near: &[Near],
        model: &mut StreamModel,
    ) -> Result<Option<Part>> {
        let h = self.header;
        let mut c = Decoder::new(source.bytes);
        let (part, sound) = match (stream, model) {
            (Stream::Channels(i, a), StreamModel::Channels(model)) => {
                let mut values = vec![0; near.len() * a.channels(h.sh_degree)];
                let read = channels::code(&mut c, model, near, &mut values);
                let shift = h.shift(k, a);
                let fit = values.iter().all(|v| v.abs() <= MAX_VALUE >> shift);
                values.iter_mut().for_each(|v| *v <<= shift);
                (Part::Channels(i, values), read && fit)
            }
            (Stream::Lifetimes, StreamModel::Lifetimes(model)) => {
                let mut l = vec![[0; 2]; near.len()];
                let sound = lifetimes::code(&mut c, model, h.frames, near, &mut l);
                (Part::Lifetimes(l), sound)
            }
            (Stream::Trajectories(i), StreamModel::Trajectories(model)) => {
                let Some(head) = h.trajectories.get(i) else {
                    return Ok(None);
                };
                let blank = Trajectories::new(head.attribute.channels(h.sh_degree));
                let most = usize::from(head.coefficients);
                let t = trajectories::code(&mut c, model, most, near, &blank, self.budget());
                let (t, sound) = self.count(t, &source.label)?;
                (Part::Trajectories(i, t), sound)
            }
            _ => return Ok(None),
        };
        source.finish(c, sound)?;
        Ok(Some(part))
    }

    /// Symbols left for a stream. Several streams may see the same number; `count` is what enforces the cap.
    fn budget(&self) -> u64 {
        self.how
            .level
            .symbols
            .saturating_sub(self.symbols.load(Ordering::Relaxed))
    }

    /// Adds the symbols of decoded trajectories to the total and checks the cap. False: broken.
    fn count(&self, t: std::result::Result<Trajectories, Stop>, label: &str) -> Result<(Trajectories, bool)> {
        let symbols = match &t {
            Ok(t) => t.symbols() as u64,
            Err(Stop::Symbols) => self.how.level.symbols + 1,
            Err(Stop::Broken) => return Ok((Trajectories::default(), false)),
        };
        let before = self.symbols.fetch_add(symbols, Ordering::Relaxed);
        let sum = before.saturating_add(symbols);
        self.how.level.cap(label, "symbols", sum, self.how.level.symbols)?;
        Ok((t.unwrap_or_default(), true))
    }

    /// The corrections of a layer (spec 10.2): 0 where it has none.
    fn correction(&self, layer: u8) -> Result<[f32; 2]> {
        let mut out = [0.0; 2];
        for (value, a) in out.iter_mut().zip([Attribute::LogScales, Attribute::LogitOpacities]) {
            if let Some(unit) = self.sound.get((UnitType::LayerCorrection, layer, a as u16)) {
                let mut r = Reader::new(unit.payload);
                let read = r.f32(value, "a correction");
                let read = read.and_then(|()| r.must(r.rest() == 0, || "one number".into()));
                read.map_err(|e| e.at(unit.offset, &unit.label()))?;
            }
        }
        Ok(out)
    }
}

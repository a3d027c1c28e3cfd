//! Payload -> group of integers (spec 3 to 12). The mirror of encode.rs.
//!
//! Per layer: first the leading tiles, from whose models the others start, then all others in parallel (tiles.rs); the
//! nodes in parallel to the layers (nodes.rs). Both read streams (streams.rs). Memory is taken only for content that
//! the header announces and the level allows; trajectories count against the symbols that the level has left. Damage
//! (spec 3) is an error (strict), or the undamaged units are decoded.

mod nodes;
mod streams;
mod tiles;

use crate::assemble::assemble;
use crate::attributes::Attribute;
use crate::conformance::{self, Damage, Sound};
use crate::error::{Error, Result};
use crate::fields::{Fields, Reader};
use crate::group::Group;
use crate::header::{Header, NodeHeader, RigHeader};
use crate::levels::Level;
use crate::parallel;
use crate::trajectories::Trajectories;
use crate::unit::{self, ALL_LAYERS, Unit, UnitType};
use std::sync::atomic::AtomicU64;

/// Options of decoding.
#[derive(Clone, Copy)]
pub struct Decoding<'a> {
    pub level: &'a Level,
    /// The group that a predicted one refers to.
    pub reference: Option<&'a Group>,
    /// Number of layers to decode; the payload may end behind them.
    pub layers: usize,
    /// Wanted tiles, [layer][tile]; None: all. The bytes of other tiles may be anything, except those of leading tiles,
    /// which are decoded anyway.
    pub tiles: Option<&'a [Vec<bool>]>,
    /// Whether tiles that were decoded only for their models are part of the group (spec 3.4). If not, as for one
    /// worker's share of a group whose other tiles are decoded by other workers, leading tiles are not decoded in
    /// layers without a wanted tile.
    pub keep_leading: bool,
    /// Whether the payload omits the bytes of tiles that are not decoded: the next unit follows at once.
    pub packed: bool,
}

impl<'a> Decoding<'a> {
    /// Decodes all of an independent group.
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

/// Decodes the undamaged units. Damaged tiles are missing, and so are tiles that start from their models. Without node
/// positions no nodes move Gaussians; without node trajectories nodes move only as the rig predicts.
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

/// State that the stages share.
struct GroupDecoder<'a> {
    header: &'a Header,
    reference: Option<&'a Group>,
    sound: Sound<'a>,
    how: &'a Decoding<'a>,
    symbols: AtomicU64, // counted so far
}

impl GroupDecoder<'_> {
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

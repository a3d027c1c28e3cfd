//! The tiles of a layer (spec 3.3 and 3.4).
//!
//! In: the undamaged units of a group. Out: for each tile its Gaussians as integers, empty where the tile is damaged or
//! was not asked for. Leading tiles, from whose models the others start, come first, then all others in parallel.

use super::GroupDecoder;
use super::streams::{Part, Source};
use crate::assemble::Tile;
use crate::attributes::Attribute;
use crate::dequantize;
use crate::error::{Error, Result};
use crate::neighbors::{self, Near};
use crate::parallel;
use crate::tile::{self, Models, Stream, StreamModel};
use crate::trajectories::Trajectories;
use crate::unit::UnitType;

/// A tile, and the models of its streams after decoding.
type Learned = (Tile, Vec<(Stream, StreamModel)>);

impl GroupDecoder<'_> {
    /// The tiles of layer `k`.
    pub fn layer(&self, k: usize) -> Result<Vec<Tile>> {
        let count = self.header.tiles.get(k).map_or(0, Vec::len);
        let mut tiles: Vec<Tile> = Vec::new();
        tiles.resize_with(count, Tile::default);
        let (mut models, leading) = (Models::default(), self.header.leading_tiles(k));
        for (i, t) in leading.into_iter().enumerate() {
            let Some(t) = t.filter(|_| !leading[..i].contains(&t)) else {
                continue;
            };
            if !self.reference_has(k, t) {
                return Ok(tiles); // lost with the reference, and so are the tiles that start from its models
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

    /// Tile `t` of layer `k`; `models`: the initial models of its streams.
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
}

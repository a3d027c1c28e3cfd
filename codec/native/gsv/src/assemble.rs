//! Decoded tiles of each layer -> one group: the layers in order, in each the tiles in order, survivors before births.

use crate::group::{BIRTH, Group};
use crate::header::{Header, LayerHeader};
use crate::trajectories::Trajectories;

/// A decoded tile; empty if it is damaged or was not asked for.
#[derive(Default)]
pub struct Tile {
    /// Indices in the reference; None in a tile of births.
    pub survivors: Option<Vec<u32>>,
    pub positions: Vec<[u32; 3]>,
    pub channels: Vec<Vec<i32>>, // of births
    pub rotations: Vec<[f32; 4]>,
    pub trajectories: Vec<Trajectories>,
    pub lifetimes: Vec<[u16; 2]>,
}

/// Concatenates the tiles of each layer. `corrections`: those of each layer (spec 10.2).
pub fn assemble(layers: Vec<Vec<Tile>>, corrections: Vec<[f32; 2]>, reference: Option<&Group>, h: &Header) -> Group {
    let mut group = Group {
        channels: vec![Vec::new(); h.scales.len()],
        trajectories: h
            .trajectories
            .iter()
            .map(|t| Trajectories::new(t.attribute.channels(h.sh_degree)))
            .collect(),
        parents: reference.map(|_| Vec::new()),
        lifetimes: h.lifetimes.then(Vec::new),
        corrections,
        ..Group::default()
    };
    for tiles in layers {
        let mut header = LayerHeader::default();
        let mut counts = Vec::with_capacity(tiles.len());
        for tile in tiles {
            let count = tile.positions.len() as u32;
            header.count += count;
            header.births += if tile.survivors.is_some() { 0 } else { count };
            counts.push(count);
            append_tile(&mut group, tile, reference);
        }
        group.layers.push(header);
        group.tiles.push(counts);
    }
    group
}

fn append_tile(group: &mut Group, mut tile: Tile, reference: Option<&Group>) {
    if let (Some(parents), Some(r)) = (&tile.survivors, reference) {
        tile.channels = group.channels.iter().map(|_| Vec::new()).collect();
        for (own, before) in tile.channels.iter_mut().zip(&r.channels) {
            let c = before.len() / r.positions.len().max(1);
            let rows = parents.iter().map(|p| *p as usize);
            own.extend(rows.flat_map(|p| before.get(p * c..(p + 1) * c).unwrap_or(&[])));
        }
        let known = parents.iter().filter_map(|p| r.rotations.get(*p as usize));
        tile.rotations = known.copied().collect();
    }
    if let Some(all) = &mut group.parents {
        match tile.survivors {
            Some(parents) => all.extend(parents),
            None => all.extend(tile.positions.iter().map(|_| BIRTH)),
        }
    }
    group
        .channels
        .iter_mut()
        .zip(tile.channels)
        .for_each(|(to, more)| append(to, more));
    append(&mut group.rotations, tile.rotations);
    append(&mut group.positions, tile.positions);
    group
        .trajectories
        .iter_mut()
        .zip(tile.trajectories)
        .for_each(|(to, more)| to.append(more));
    if let Some(lifetimes) = &mut group.lifetimes {
        append(lifetimes, tile.lifetimes);
    }
}

/// Appends `more` to `to`, without a copy where `to` is empty.
fn append<T>(to: &mut Vec<T>, more: Vec<T>) {
    if to.is_empty() { *to = more } else { to.extend(more) }
}

//! Group of integers -> payload (spec 3 to 12): makes the units of all layers, entropy-codes them in parallel, writes
//! them in order.
//!
//! The mirror of decode.rs.

use crate::attributes::Attribute;
use crate::channels;
use crate::deaths;
use crate::error::{Error, Result};
use crate::fields::Writer;
use crate::group::Group;
use crate::lifetimes;
use crate::morton;
use crate::neighbors;
use crate::positions::{self, SplitModel};
use crate::range_coder::Encoder;
use crate::rig::{self, Rig};
use crate::tile::{self, Models, Stream, StreamModel};
use crate::trajectories::{self, Kind, Trajectories, TrajectoryModel};
use crate::unit::{self, Entry, UnitKey, UnitType};
use rayon::prelude::*;
use std::ops::Range;

/// A unit to be written.
type Coded = (UnitKey, Vec<u8>);

/// The payload of a group (one MP4 sample). `reference`: the group that a predicted one refers to.
///
/// # Errors
/// `Error::Input`: the group breaks an invariant; nothing is written.
pub fn encode_group(group: &Group, reference: Option<&Group>) -> Result<Vec<u8>> {
    group.validate(reference)?;
    let h = &group.header;
    let tiles: Vec<Vec<u32>> = h.tiles.iter().map(|t| t.iter().map(|t| t.count).collect()).collect();
    if group.layers != h.layers || group.tiles != tiles {
        return Err(Error::Input(
            "expected the layers and tiles that the header announces".into(),
        ));
    }
    let encoder = GroupEncoder { group, reference };
    let (layers, nodes) = rayon::join(
        || {
            (0..h.layers.len())
                .into_par_iter()
                .map(|k| encoder.layer(k))
                .collect::<Vec<_>>()
        },
        || encoder.nodes(),
    );
    let mut units: Vec<Coded> = Vec::new();
    for (k, layer) in layers.into_iter().enumerate() {
        units.extend(layer);
        if k == 0 {
            units.extend(nodes.iter().cloned());
        }
        let corrected = [Attribute::LogScales, Attribute::LogitOpacities]
            .into_iter()
            .zip(group.corrections[k]);
        let named = corrected.filter(|(_, v)| *v != 0.0);
        units.extend(named.map(|(a, v)| ((UnitType::LayerCorrection, k as u8, a as u16), v.to_be_bytes().to_vec())));
    }
    if units.len() > usize::from(u16::MAX) {
        return Err(Error::Input(format!(
            "{} units, at most 65535 fit a group",
            units.len()
        )));
    }
    let mut directory = Vec::with_capacity(units.len());
    for (key, payload) in &units {
        directory.push(Entry::new(*key, payload)?);
    }
    let mut header = Writer::default();
    h.clone()
        .fields(&mut header, &mut directory, reference.map(|r| &r.header))?;
    let payloads: Vec<Vec<u8>> = units.into_iter().map(|(_, payload)| payload).collect();
    unit::write(&header.0, &payloads)
}

struct GroupEncoder<'a> {
    group: &'a Group,
    reference: Option<&'a Group>,
}

impl GroupEncoder<'_> {
    /// The tiles of layer `k`.
    fn layer(&self, k: usize) -> Vec<Coded> {
        let h = &self.group.header;
        let (mut models, leading) = (Models::default(), h.leading_tiles(k));
        let mut coded = Vec::new();
        for (i, t) in leading.into_iter().enumerate() {
            if let Some(t) = t.filter(|_| !leading[..i].contains(&t)) {
                let (payload, learned) = self.tile(k, t, &models);
                if h.tiles[k].len() > 1 {
                    learned
                        .into_iter()
                        .for_each(|(stream, model)| models.learn(stream, model));
                }
                coded.push((t, payload));
            }
        }
        let wanted = |t: &usize| h.tiles[k][*t].count > 0 && !leading.contains(&Some(*t));
        let others = (0..h.tiles[k].len()).into_par_iter().filter(wanted);
        coded.par_extend(others.map(|t| (t, self.tile(k, t, &models).0)));
        coded.sort_by_key(|(t, _)| *t);
        let key = |t| (UnitType::Tile, k as u8, t as u16);
        coded.into_iter().map(|(t, payload)| (key(t), payload)).collect()
    }

    /// The payload of tile `t` of layer `k`, and the models of its streams after encoding.
    fn tile(&self, k: usize, t: usize, models: &Models) -> (Vec<u8>, Vec<(Stream, StreamModel)>) {
        let h = &self.group.header;
        let range = self.group.tile_range(k, t);
        let near = neighbors::nearest(&self.group.positions[range.clone()]);
        let streams = Stream::of(h, k, t, self.reference.map(|r| &r.header));
        let coded: Vec<_> = streams
            .into_par_iter()
            .map(|stream| {
                let mut model = models.of(stream, h);
                let bytes = self.stream((k, t), range.clone(), stream, &near, &mut model);
                (bytes, (stream, model))
            })
            .collect();
        let (bytes, learned): (Vec<_>, _) = coded.into_iter().unzip();
        (tile::join(&bytes), learned)
    }

    fn stream(
        &self,
        (k, t): (usize, usize),
        range: Range<usize>,
        stream: Stream,
        near: &[neighbors::Near],
        model: &mut StreamModel,
    ) -> Vec<u8> {
        let (g, h) = (self.group, &self.group.header);
        let mut e = Encoder::default();
        match (stream, model) {
            (Stream::Positions, StreamModel::Positions(model)) => {
                return points(
                    model,
                    &g.positions[range],
                    u32::from(h.grid_bits),
                    h.shift(k, Attribute::Means),
                );
            }
            (Stream::Deaths, _) => self.deaths(&mut e, k, t, range),
            (Stream::Channels(i, a), StreamModel::Channels(model)) => {
                let (c, shift) = (a.channels(h.sh_degree), h.shift(k, a));
                let own = &g.channels[i][range.start * c..range.end * c];
                let mut coarse: Vec<i32> = own.iter().map(|v| v >> shift).collect();
                channels::code(&mut e, model, near, &mut coarse);
            }
            (Stream::Trajectories(i), StreamModel::Trajectories(model)) => {
                let own = g.trajectories[i].part(range.start, range.len());
                let most = usize::from(h.trajectories[i].coefficients);
                let _ = trajectories::code(&mut e, model, most, near, &own, u64::MAX); // an encoder never stops
            }
            (Stream::Lifetimes, StreamModel::Lifetimes(model)) => {
                let mut own = g.lifetimes.as_ref().map_or(Vec::new(), |l| l[range].to_vec());
                lifetimes::code(&mut e, model, h.frames, near, &mut own);
            }
            _ => {}
        }
        e.finish()
    }

    /// Codes the deaths: the Gaussians of a tile of the reference that have no survivor at `range`.
    fn deaths(&self, e: &mut Encoder, k: usize, t: usize, range: Range<usize>) {
        let (Some(r), Some(parents)) = (self.reference, &self.group.parents) else {
            return;
        };
        let all = r.tile_range(k, t);
        let mut dead = vec![true; all.len()];
        for i in &parents[range] {
            dead[*i as usize - all.start] = false;
        }
        deaths::code(e, &neighbors::nearest(&r.positions[all]), &mut dead);
    }

    /// The units of the nodes.
    fn nodes(&self) -> Vec<Coded> {
        let (g, h) = (self.group, &self.group.header);
        if h.nodes.count == 0 {
            return Vec::new();
        }
        let near = neighbors::nearest(&g.node_positions);
        let places = points(&mut SplitModel::default(), &g.node_positions, u32::from(h.grid_bits), 0);
        let mut e = Encoder::default();
        let (k, mut model) = (usize::from(h.nodes.coefficients), TrajectoryModel::new(Kind::Node));
        let own: &Trajectories = &g.node_trajectories;
        let _ = trajectories::code(&mut e, &mut model, k, &near, own, u64::MAX);
        let mut units = vec![
            ((UnitType::NodePositions, 0, 0), places),
            ((UnitType::NodeTrajectories, 0, 0), e.finish()),
        ];
        if let Some(rig) = &g.rig {
            let mut e = Encoder::default();
            let _ = rig::code(&mut e, rig.joints.len(), &near, rig); // it is valid, and an encoder never stops
            units.push(((UnitType::Rig, 0, 0), e.finish()));
            units.push(((UnitType::JointPoses, 0, 0), joint_poses(rig, h.frames)));
        }
        units
    }
}

/// The unit of the poses of the joints.
pub fn joint_poses(rig: &Rig, frames: u16) -> Vec<u8> {
    let mut e = Encoder::default();
    let _ = rig::code_poses(&mut e, &rig.parents, frames, &rig.poses);
    e.finish()
}

/// `points` without their lowest `shift` bits.
fn points(model: &mut SplitModel, points: &[[u32; 3]], bits: u32, shift: u32) -> Vec<u8> {
    let codes: Vec<u64> = points.iter().map(|p| morton::encode(p.map(|v| v >> shift))).collect();
    positions::encode(model, &codes, bits - shift)
}

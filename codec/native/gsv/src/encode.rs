//! Group in integers -> payload (spec 3 to 12). The mirror of decode.rs.

use crate::channels;
use crate::error::Result;
use crate::fields::Writer;
use crate::group::Group;
use crate::lifetimes;
use crate::morton;
use crate::neighbors::{self, Near};
use crate::positions;
use crate::range_coder::Encoder;
use crate::trajectories::{self, Kind, Trajectories};
use crate::unit::{self, UnitType};
use rayon::prelude::*;

/// A unit to be written; dependencies are indices of units.
struct Pending<'a> {
    kind: UnitType,
    attribute: u8,
    needs: Option<u8>,
    code: Box<dyn Fn(&mut Encoder) + Sync + 'a>,
}

/// The payload of a group (one MP4 sample).
///
/// # Errors
/// `Error::Input`: the group breaks an invariant; nothing was written.
pub fn encode_group(group: &Group) -> Result<Vec<u8>> {
    group.validate()?;
    let near = neighbors::nearest(&group.positions);
    let near_nodes = neighbors::nearest(&group.node_positions);
    let units = units(group, &near, &near_nodes);
    let payloads: Vec<Vec<u8>> = units
        .par_iter()
        .map(|u| {
            let mut c = Encoder::default();
            (u.code)(&mut c);
            c.finish()
        })
        .collect();
    let mut header = Writer::default();
    group.header.clone().fields(&mut header)?;
    let mut out = Vec::new();
    unit::write(&mut out, [UnitType::GroupHeader as u8, 0, 0], &[], &header.0)?;
    for (u, payload) in units.iter().zip(&payloads) {
        unit::write(&mut out, [u.kind as u8, 0, u.attribute], u.needs.as_slice(), payload)?;
    }
    Ok(out)
}

/// All units but the header, in the order of the stream: positions is unit 1, node_positions unit 2 if there are nodes.
fn units<'a>(group: &'a Group, near: &'a [Near], near_nodes: &'a [Near]) -> Vec<Pending<'a>> {
    let h = &group.header;
    let bits = u32::from(h.grid_bits);
    let mut units = vec![points(UnitType::Positions, &group.positions, bits)];
    if h.nodes.count > 0 {
        units.push(points(UnitType::NodePositions, &group.node_positions, bits));
        let k = usize::from(h.nodes.coefficients);
        let t = &group.node_trajectories;
        units.push(trajectory(
            UnitType::NodeTrajectories,
            0,
            2,
            Kind::Nodes,
            k,
            near_nodes,
            t,
        ));
    }
    for (a, values) in h.attributes().iter().zip(&group.channels) {
        let code = move |c: &mut Encoder| {
            channels::code(c, *a, a.channels(h.sh_degree), near, &mut values.clone());
        };
        units.push(Pending {
            kind: UnitType::Channels,
            attribute: *a as u8,
            needs: Some(1),
            code: Box::new(code),
        });
    }
    for (head, t) in h.trajectories.iter().zip(&group.trajectories) {
        let k = usize::from(head.coefficients);
        units.push(trajectory(
            UnitType::Trajectories,
            head.attribute as u8,
            1,
            Kind::Gaussians,
            k,
            near,
            t,
        ));
    }
    if let Some(l) = &group.lifetimes {
        let code = move |c: &mut Encoder| {
            lifetimes::code(c, h.frames, near, &mut l.clone());
        };
        units.push(Pending {
            kind: UnitType::Lifetimes,
            attribute: 0,
            needs: Some(1),
            code: Box::new(code),
        });
    }
    units
}

fn points(kind: UnitType, points: &[[u32; 3]], bits: u32) -> Pending<'_> {
    let code = move |c: &mut Encoder| {
        let codes: Vec<u64> = points.iter().map(|p| morton::encode(*p)).collect();
        positions::code(c, &codes, codes.len() as u32, bits);
    };
    Pending {
        kind,
        attribute: 0,
        needs: None,
        code: Box::new(code),
    }
}

fn trajectory<'a>(
    kind: UnitType,
    attribute: u8,
    needs: u8,
    model: Kind,
    k: usize,
    near: &'a [Near],
    t: &'a Trajectories,
) -> Pending<'a> {
    let code = move |c: &mut Encoder| {
        let _ = trajectories::code(c, model, k, near, t, u64::MAX); // an encoder never stops
    };
    Pending {
        kind,
        attribute,
        needs: Some(needs),
        code: Box::new(code),
    }
}

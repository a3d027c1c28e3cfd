//! Group of integers -> payload (spec 3 to 12): makes the units of all layers, entropy-codes them in parallel, writes them
//! in order.
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
use crate::neighbors::{self, Contexts, Near};
use crate::positions;
use crate::range_coder::Encoder;
use crate::trajectories::{self, Kind, Trajectories};
use crate::unit::{self, UnitType};
use rayon::prelude::*;

/// Entropy-codes the payload of a unit.
type Code<'a> = Box<dyn Fn() -> Vec<u8> + Sync + 'a>;

/// A unit to be written.
struct Pending<'a> {
    kind: UnitType,
    layer: usize,
    attribute: Option<Attribute>,
    code: Code<'a>,
}

/// The payload of a group (one MP4 sample). `reference`: the group that a predicted one refers to.
///
/// # Errors
/// `Error::Input`: the group breaks an invariant; nothing is written.
pub fn encode_group(group: &Group, reference: Option<&Group>) -> Result<Vec<u8>> {
    group.validate(reference)?;
    let h = &group.header;
    if group.layers != h.layers {
        return Err(Error::Input("expected the layers that the header announces".into()));
    }
    let contexts: Vec<Contexts> = (0..group.layers.len())
        .into_par_iter()
        .map(|k| {
            let survivors = group.layers[k].survivors() as usize;
            Contexts::new(&group.positions[group.range(k..k + 1)], survivors)
        })
        .collect();
    let near_nodes = neighbors::nearest(&group.node_positions);
    let mut units = Vec::new();
    for (k, contexts) in contexts.iter().enumerate() {
        layer(&mut units, group, reference, k, contexts);
        if k == 0 && h.nodes.count > 0 {
            nodes(&mut units, group, &near_nodes);
        }
    }
    let payloads: Vec<Vec<u8>> = units.par_iter().map(|u| (u.code)()).collect();
    let (mut body, mut sizes) = (Vec::new(), Vec::new());
    for (u, payload) in units.iter().zip(&payloads) {
        let attribute = u.attribute.map_or(0, |a| a as u8);
        let start = body.len();
        unit::write(
            &mut body,
            [u.kind as u8, u.layer as u8, attribute],
            &dependencies(u, &units),
            payload,
        )?;
        sizes.push((body.len() - start) as u32);
    }
    let mut header = Writer::default();
    h.clone()
        .fields(&mut header, &mut sizes, reference.map(|r| &r.header))?;
    let mut out = Vec::new();
    unit::write(&mut out, [UnitType::GroupHeader as u8, 0, 0], &[], &header.0)?;
    out.extend(body);
    Ok(out)
}

/// Indices of the units that `u` depends on. Unit 0 is the header, so the first of `units` has index 1.
fn dependencies(u: &Pending, units: &[Pending]) -> Vec<u8> {
    let needs = u.kind.needs(u.attribute);
    let needed = |d: &Pending| d.layer == u.layer && needs.contains(&(d.kind, d.attribute));
    let found = units.iter().zip(1..).filter(|(d, _)| needed(d));
    found.map(|(_, i)| i).collect()
}

/// Appends the units of layer `k`, without nodes; positions come first, since the other units depend on them.
fn layer<'a>(
    units: &mut Vec<Pending<'a>>,
    group: &'a Group,
    reference: Option<&'a Group>,
    k: usize,
    contexts: &'a Contexts,
) {
    let h = &group.header;
    let (range, births) = (group.range(k..k + 1), group.layers[k].births as usize);
    let mut push = |kind, attribute, code| {
        units.push(Pending {
            kind,
            layer: k,
            attribute,
            code,
        });
    };
    if let (Some(r), Some(parents)) = (reference, &group.parents)
        && h.candidates(k, Some(&r.header)) > 0
    {
        let survivors = &parents[range.start..range.end - births];
        push(UnitType::Deaths, None, deaths_of(r, k, survivors));
    }
    if h.reference == 0 || births > 0 {
        let own = &group.positions[range.end - births..range.end];
        let shift = h.shift(k, Attribute::Means);
        push(UnitType::Positions, None, points(own, u32::from(h.grid_bits), shift));
        for (a, values) in h.attributes().iter().zip(&group.channels) {
            let c = a.channels(h.sh_degree);
            let own = &values[(range.end - births) * c..range.end * c];
            let code = channels_of(*a, c, own, contexts.births(), h.shift(k, *a));
            push(UnitType::Channels, Some(*a), code);
        }
    }
    for (head, t) in h.trajectories.iter().zip(&group.trajectories) {
        let own = t.part(range.start, range.len());
        let code = trajectory(Kind::Gaussians, usize::from(head.coefficients), &contexts.all, own);
        push(UnitType::Trajectories, Some(head.attribute), code);
    }
    if let Some(l) = &group.lifetimes {
        let own = &l[range];
        let code = coded(move |e| _ = lifetimes::code(e, h.frames, &contexts.all, &mut own.to_vec()));
        push(UnitType::Lifetimes, None, code);
    }
    let corrected = [Attribute::LogScales, Attribute::LogitOpacities];
    for (a, v) in corrected
        .into_iter()
        .zip(group.corrections[k])
        .filter(|(_, v)| *v != 0.0)
    {
        push(
            UnitType::LayerCorrection,
            Some(a),
            Box::new(move || v.to_be_bytes().to_vec()),
        );
    }
}

/// Appends the units of the nodes.
fn nodes<'a>(units: &mut Vec<Pending<'a>>, group: &'a Group, near: &'a [Near]) {
    let h = &group.header;
    let k = usize::from(h.nodes.coefficients);
    let motion = trajectory(Kind::Node, k, near, group.node_trajectories.clone());
    let coded = [
        (
            UnitType::NodePositions,
            points(&group.node_positions, u32::from(h.grid_bits), 0),
        ),
        (UnitType::NodeTrajectories, motion),
    ];
    units.extend(coded.map(|(kind, code)| Pending {
        kind,
        layer: 0,
        attribute: None,
        code,
    }));
}

/// A unit whose payload is one range coder stream.
fn coded<'a>(f: impl Fn(&mut Encoder) + Sync + 'a) -> Code<'a> {
    Box::new(move || {
        let mut c = Encoder::default();
        f(&mut c);
        c.finish()
    })
}

/// The `c` channels of attribute `a` without their lowest `shift` bits.
fn channels_of<'a>(a: Attribute, c: usize, values: &'a [i32], near: &'a [Near], shift: u32) -> Code<'a> {
    coded(move |e| {
        let mut coarse: Vec<i32> = values.iter().map(|v| v >> shift).collect();
        channels::code(e, a, c, near, &mut coarse);
    })
}

/// `points` without their lowest `shift` bits.
fn points(points: &[[u32; 3]], bits: u32, shift: u32) -> Code<'_> {
    Box::new(move || {
        let codes: Vec<u64> = points.iter().map(|p| morton::encode(p.map(|v| v >> shift))).collect();
        positions::encode(&codes, bits - shift)
    })
}

fn deaths_of<'a>(reference: &'a Group, k: usize, survivors: &'a [u32]) -> Code<'a> {
    coded(move |c| {
        let range = reference.range(k..k + 1);
        let mut dead = vec![true; range.len()];
        for i in survivors {
            dead[*i as usize - range.start] = false;
        }
        deaths::code(c, &neighbors::nearest(&reference.positions[range]), &mut dead);
    })
}

fn trajectory(model: Kind, k: usize, near: &[Near], t: Trajectories) -> Code<'_> {
    coded(move |c| {
        let _ = trajectories::code(c, model, k, near, &t, u64::MAX); // an encoder never stops
    })
}

//! Conformance of a group to its header (spec 3.1): every announced unit is present, no other unit is, or it is reported as
//! damaged.

use crate::attributes::Attribute;
use crate::error::{Error, Result};
use crate::header::Header;
use crate::unit::{Unit, UnitType};

/// A unit that is damaged or missing, and so is not decoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// Index of the unit; None: missing, in a group where other units are damaged.
    pub unit: Option<usize>,
    /// Its type, as its bytes claim or as the header announces; None: a type that this version skips.
    pub kind: Option<UnitType>,
    pub layer: u8,
    pub attribute: Option<Attribute>,
    pub message: String,
}

/// What identifies a unit in a group: type, layer, attribute.
pub type UnitKey = (UnitType, u8, Option<Attribute>);

/// Index of the undamaged unit of a type, layer and attribute.
pub fn find(units: &[Unit], (kind, layer, attribute): UnitKey) -> Option<usize> {
    let sought = |u: &Unit| (u.kind, u.layer, u.attribute) == (Some(kind), layer, attribute) && u.damage.is_none();
    units.iter().position(sought)
}

/// Compares the units with the header; returns the units that are damaged or missing. `reference`: the header of the group
/// that a predicted one refers to; `layers`: number of layers to decode.
///
/// # Errors
/// An undamaged unit that the header does not announce, or that lacks a dependency; a missing unit, although nothing is
/// damaged; no undamaged positions of the first layer of an independent group.
pub fn check(units: &[Unit], header: &Header, reference: Option<&Header>, layers: usize) -> Result<Vec<Damage>> {
    let mut damage: Vec<Damage> = units.iter().enumerate().filter_map(claimed).collect();
    let (mut announced, optional) = announced(header, reference, layers);
    let end = units.last().map_or(0, |u| u.payload_offset + u.payload.len());
    let any = !damage.is_empty();
    for &key in announced.iter().filter(|key| find(units, **key).is_none()) {
        let (kind, layer, attribute) = key;
        let vital = layer == 0 && kind == UnitType::Positions && header.reference == 0;
        if !any || vital {
            let own = units
                .iter()
                .find(|u| u.kind == Some(kind))
                .and_then(|u| u.damage.clone());
            return Err(own.unwrap_or_else(|| Error::bitstream(end, "group", missing(key))));
        }
        if !damage
            .iter()
            .any(|d| (d.kind, d.layer, d.attribute) == (Some(kind), layer, attribute))
        {
            damage.push(Damage {
                unit: None,
                kind: Some(kind),
                layer,
                attribute,
                message: format!("expected {}", missing(key)),
            });
        }
    }
    announced.extend(optional);
    for (i, u) in units.iter().enumerate().filter(|(_, u)| u.damage.is_none()) {
        let Some(kind) = u.kind else { continue };
        let fail = |expected: String| Err(Error::bitstream(u.offset, u.label(i), expected));
        if !announced.contains(&(kind, u.layer, u.attribute)) {
            return fail("only units that the header announces".into());
        }
        for (need, attribute) in kind.needs(u.attribute) {
            let key = (*need, u.layer, *attribute);
            let met = |d: &u8| {
                units
                    .get(usize::from(*d))
                    .is_some_and(|d| (d.kind, d.layer, d.attribute) == (Some(*need), u.layer, *attribute))
            };
            if announced.contains(&key) && !u.dependencies.iter().any(met) {
                let of = attribute.map_or(String::new(), |a| format!(" of {}", a.name()));
                return fail(format!("a dependency on the {} unit{of}", need.name()));
            }
        }
    }
    Ok(damage)
}

fn missing((kind, layer, attribute): UnitKey) -> String {
    let attribute = attribute.map_or(String::new(), |a| format!(" {}", a.name()));
    let of = if layer > 0 {
        format!(" of layer {layer}")
    } else {
        String::new()
    };
    format!("a {} unit{attribute}{of}, found none", kind.name())
}

fn claimed((i, u): (usize, &Unit)) -> Option<Damage> {
    Some(Damage {
        unit: Some(i),
        kind: u.kind,
        layer: u.layer,
        attribute: u.attribute,
        message: u.damage.as_ref()?.to_string(),
    })
}

/// Units that are required, and units that are optional.
fn announced(h: &Header, reference: Option<&Header>, layers: usize) -> (Vec<UnitKey>, Vec<UnitKey>) {
    let mut required = vec![(UnitType::GroupHeader, 0, None)];
    let mut optional = Vec::new();
    if h.nodes.count > 0 {
        required.extend([
            (UnitType::NodePositions, 0, None),
            (UnitType::NodeTrajectories, 0, None),
        ]);
    }
    for (k, layer) in h.layers.iter().enumerate().take(layers) {
        let n = k as u8;
        if h.candidates(k, reference) > 0 {
            required.push((UnitType::Deaths, n, None));
        }
        if h.reference == 0 || layer.births > 0 {
            required.push((UnitType::Positions, n, None));
            required.extend(h.attributes().iter().map(|a| (UnitType::Channels, n, Some(*a))));
        }
        let moving = |t: &crate::header::TrajectoryHeader| (UnitType::Trajectories, n, Some(t.attribute));
        required.extend(h.trajectories.iter().map(moving));
        optional.push((UnitType::Lifetimes, n, None));
        optional
            .extend([Attribute::LogScales, Attribute::LogitOpacities].map(|a| (UnitType::LayerCorrection, n, Some(a))));
    }
    (required, optional)
}

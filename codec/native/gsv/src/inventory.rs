//! What a group has against what its header announces (spec 3.1): every unit is there, and no other, or it is damaged.

use crate::attributes::Attribute;
use crate::error::{Error, Result};
use crate::header::Header;
use crate::unit::{Unit, UnitType};

/// A unit that is not decoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// Index of the unit; None if it is missing where others are damaged.
    pub unit: Option<usize>,
    /// What the unit claims to be, or what is missing; None: a type that this version skips.
    pub kind: Option<UnitType>,
    pub attribute: Option<Attribute>,
    pub message: String,
}

/// The sound unit of a type and attribute.
pub fn find(units: &[Unit], kind: UnitType, attribute: Option<Attribute>) -> Option<usize> {
    let sought = |u: &Unit| u.kind == Some(kind) && u.attribute == attribute && u.damage.is_none();
    units.iter().position(sought)
}

/// Compares units and header; what is damaged or missing.
///
/// # Errors
/// A sound unit that the header does not announce; one that is missing although nothing is damaged; no sound positions.
pub fn check(units: &[Unit], header: &Header) -> Result<Vec<Damage>> {
    let mut damage: Vec<Damage> = units.iter().enumerate().filter_map(claimed).collect();
    let mut announced = required(header);
    let end = units.last().map_or(0, |u| u.payload_offset + u.payload.len());
    let any = !damage.is_empty();
    for &(kind, attribute) in announced.iter().filter(|(k, a)| find(units, *k, *a).is_none()) {
        let name = attribute.map_or("", Attribute::name);
        let message = format!("a {} unit {name}, found none", kind.name());
        if !any || kind == UnitType::Positions {
            let own = units
                .iter()
                .find(|u| u.kind == Some(kind))
                .and_then(|u| u.damage.clone());
            return Err(own.unwrap_or_else(|| Error::bitstream(end, "group", message)));
        }
        if !damage.iter().any(|d| (d.kind, d.attribute) == (Some(kind), attribute)) {
            damage.push(Damage {
                unit: None,
                kind: Some(kind),
                attribute,
                message: format!("expected {message}"),
            });
        }
    }
    announced.push((UnitType::Lifetimes, None));
    for (i, u) in units.iter().enumerate().filter(|(_, u)| u.damage.is_none()) {
        if u.kind.is_some_and(|k| !announced.contains(&(k, u.attribute))) {
            let expected = "only units that the header announces";
            return Err(Error::bitstream(u.offset, u.label(i), expected));
        }
    }
    Ok(damage)
}

fn claimed((i, u): (usize, &Unit)) -> Option<Damage> {
    Some(Damage {
        unit: Some(i),
        kind: u.kind,
        attribute: u.attribute,
        message: u.damage.as_ref()?.to_string(),
    })
}

fn required(h: &Header) -> Vec<(UnitType, Option<Attribute>)> {
    let mut required = vec![(UnitType::GroupHeader, None), (UnitType::Positions, None)];
    if h.nodes.count > 0 {
        required.extend([(UnitType::NodePositions, None), (UnitType::NodeTrajectories, None)]);
    }
    let channels = h.attributes().iter().map(|a| (UnitType::Channels, Some(*a)));
    let moving = h
        .trajectories
        .iter()
        .map(|t| (UnitType::Trajectories, Some(t.attribute)));
    required.extend(channels.chain(moving));
    required
}

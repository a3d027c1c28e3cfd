//! Decoding the undamaged units of a damaged group (spec 3).

mod common;

use common::{Random, small};
use gsv::attributes::Attribute;
use gsv::conformance::Damage;
use gsv::decode::{Decoding, decode_damaged, decode_group};
use gsv::encode::encode_group;
use gsv::error::Error;
use gsv::evaluate::Evaluator;
use gsv::group::Group;
use gsv::levels::LEVELS;
use gsv::parametric::Frame;
use gsv::trajectories::Trajectories;
use gsv::unit::{self, ALL_LAYERS, Unit, UnitType};
use std::ops::Range;

fn how() -> Decoding<'static> {
    Decoding::at(&LEVELS[0])
}

/// The small group with the last byte of a unit's payload flipped.
fn damaged(kind: UnitType, attribute: Option<Attribute>) -> (Vec<u8>, usize) {
    let mut payload = encode_group(&small(), None).unwrap();
    let units = unit::split(&payload, ALL_LAYERS).unwrap();
    let i = units
        .iter()
        .position(|u| (u.kind, u.attribute) == (Some(kind), attribute));
    let i = i.unwrap();
    let at = units[i].payload_offset + units[i].payload.len() - 1;
    payload[at] ^= 0x10;
    (payload, i)
}

/// The integers of a group, without the quaternions that follow from them.
fn integers(mut group: Group) -> Group {
    group.rotations = small().rotations;
    group
}

fn named(damage: &[Damage]) -> Vec<(Option<usize>, Option<UnitType>, Option<Attribute>)> {
    damage.iter().map(|d| (d.unit, d.kind, d.attribute)).collect()
}

#[test]
fn a_sound_group_has_no_damage() {
    let (group, damage) = decode_damaged(&encode_group(&small(), None).unwrap(), &how()).unwrap();
    assert_eq!(integers(group), small());
    assert!(damage.is_empty());
}

#[test]
fn a_damaged_attribute_costs_only_itself() {
    for (k, a) in Attribute::canonical(1).iter().enumerate() {
        let (payload, i) = damaged(UnitType::Channels, Some(*a));
        let (group, damage) = decode_damaged(&payload, &how()).unwrap();
        let mut lost = vec![(Some(i), Some(UnitType::Channels), Some(*a))];
        let mut want = small();
        want.channels[k].fill(0);
        if *a == Attribute::LogScales {
            lost.push((Some(i + 1), Some(UnitType::Channels), Some(Attribute::Quats))); // their steps are lost
            want.channels[k + 1].fill(0);
        }
        assert_eq!(named(&damage), lost);
        assert!(damage[0].message.contains("CRC"), "{}", damage[0].message);
        assert_eq!(integers(group), want);
        assert!(matches!(decode_group(&payload, &how()), Err(Error::Bitstream { .. })));
    }
    for (k, a) in Attribute::ALL.iter().enumerate() {
        let (payload, i) = damaged(UnitType::Trajectories, Some(*a));
        let (group, damage) = decode_damaged(&payload, &how()).unwrap();
        assert_eq!(named(&damage), [(Some(i), Some(UnitType::Trajectories), Some(*a))]);
        assert!((0..12).all(|i| group.trajectories[k].get(i).is_empty()));
        let mut want = small();
        want.trajectories[k] = group.trajectories[k].clone();
        assert_eq!(integers(group), want);
    }
    let (group, damage) = decode_damaged(&damaged(UnitType::Lifetimes, None).0, &how()).unwrap();
    assert_eq!((group.lifetimes, damage.len()), (None, 1));
}

#[test]
fn without_their_nodes_gaussians_stay_where_they_are() {
    let rest = |payload: &[u8]| {
        let (mut group, damage) = decode_damaged(payload, &how()).unwrap();
        (group.trajectories, group.header.trajectories) = (Vec::new(), Vec::new());
        let mut frame = Frame::default();
        Evaluator::new(group).frame(3, &mut frame);
        (frame.means, damage)
    };
    let (motion, i) = damaged(UnitType::NodeTrajectories, None);
    let (nodes, j) = damaged(UnitType::NodePositions, None);
    let g = small();
    let origin: Vec<[f32; 3]> = g
        .positions
        .iter()
        .map(|p| std::array::from_fn(|a| g.header.origin[a] + g.header.grid_step * p[a] as f32))
        .collect();
    let (means, damage) = rest(&motion);
    assert!(
        means
            .iter()
            .flatten()
            .zip(origin.iter().flatten())
            .all(|(a, b)| (a - b).abs() <= 1e-4 * b.abs())
    );
    assert_eq!(named(&damage), [(Some(i), Some(UnitType::NodeTrajectories), None)]);
    let (means, damage) = rest(&nodes);
    assert_eq!(means, origin);
    let both = [(Some(j), Some(UnitType::NodePositions), None), named(&damage)[1]];
    assert_eq!(named(&damage), both);
    assert!(damage[1].message.contains(&format!("unit {j} is damaged")));
}

#[test]
fn positions_and_header_cannot_be_missed() {
    for kind in [UnitType::Positions, UnitType::GroupHeader] {
        let (payload, _) = damaged(kind, None);
        let message = decode_damaged(&payload, &how()).unwrap_err().to_string();
        assert!(message.contains("CRC"), "{message}");
    }
}

#[test]
fn what_is_cut_off_is_missing() {
    let payload = encode_group(&small(), None).unwrap();
    let units = unit::split(&payload, ALL_LAYERS).unwrap();
    let (group, damage) = decode_damaged(&payload[..units[5].offset + 3], &how()).unwrap();
    assert_eq!(damage[0].unit, Some(5));
    assert!(
        damage[1..]
            .iter()
            .all(|d| d.unit.is_none() && d.message.contains("found none"))
    );
    let lost = damage.iter().filter(|d| d.kind == Some(UnitType::Trajectories)).count();
    assert_eq!(lost, 6);
    group.validate(None).unwrap();
    // whole units that are missing, with nothing damaged, are a broken rule
    assert!(decode_damaged(&payload[..units[5].offset], &how()).is_err());
}

#[test]
fn damage_where_there_are_no_gaussians() {
    let shape = common::Shape {
        counts: vec![0],
        frames: 3,
        bits: 5,
        sh_degree: 0,
        nodes: 2,
        magnitude: 3,
        lifetimes: false,
        moving: 0b10,
        seed: 1,
    };
    let mut payload = encode_group(&common::group(&shape), None).unwrap();
    let units = unit::split(&payload, ALL_LAYERS).unwrap();
    let at = units
        .iter()
        .find(|u| u.kind == Some(UnitType::Trajectories))
        .unwrap()
        .offset
        + 4;
    payload[at] ^= 1;
    let (group, damage) = decode_damaged(&payload, &how()).unwrap();
    assert_eq!(damage.len(), 1);
    group.validate(None).unwrap();
}

/// An undamaged unit that breaks a rule is an error, not damage.
#[test]
fn broken_rules_stay_errors() {
    let mut payload = encode_group(&small(), None).unwrap();
    unit::write(&mut payload, [8, 0, 0], &[], b"").unwrap();
    let message = decode_damaged(&payload, &how()).unwrap_err().to_string();
    assert!(message.contains("announces"), "{message}");
}

/// The content of a unit in the decoded group.
fn content(g: &Group, u: &Unit) -> Option<Vec<i32>> {
    let k = usize::from(u.layer);
    if u.kind == Some(UnitType::LayerCorrection) {
        let at = usize::from(u.attribute == Some(Attribute::LogitOpacities));
        return Some(vec![g.corrections[k][at].to_bits() as i32]);
    }
    let range = g.range(k..k + 1);
    let births = range.end - g.layers[k].births as usize..range.end;
    let moving = |t: &Trajectories, range: Range<usize>| range.flat_map(|i| [&[-7], t.get(i)].concat()).collect();
    Some(match (u.kind?, u.attribute) {
        (UnitType::Positions, _) => g.positions[births].as_flattened().iter().map(|v| *v as i32).collect(),
        (UnitType::Channels, Some(a)) => {
            let c = a.channels(g.header.sh_degree);
            g.channels_of(a)?[births.start * c..births.end * c].to_vec()
        }
        (UnitType::Trajectories, Some(a)) => {
            let at = g.header.trajectories.iter().position(|t| t.attribute == a)?;
            moving(&g.trajectories[at], range)
        }
        (UnitType::Deaths, _) => g.parents.as_ref()?[range.start..births.start]
            .iter()
            .map(|p| *p as i32)
            .collect(),
        (UnitType::NodeTrajectories, _) => moving(&g.node_trajectories, 0..g.node_positions.len()),
        (UnitType::NodePositions, _) => g.node_positions.as_flattened().iter().map(|v| *v as i32).collect(),
        (UnitType::Lifetimes, _) => {
            let l = g.lifetimes.as_ref()?;
            l[range].as_flattened().iter().map(|v| i32::from(*v)).collect()
        }
        _ => vec![],
    })
}

/// Every byte damaged in turn: only that unit and those that depend on it are replaced, and the damage is reported.
#[test]
fn a_damaged_byte_costs_its_unit_and_those_that_name_it() {
    let reference = common::group(&common::layered());
    let later = common::predicted(&reference, &common::layered());
    for (sound, before) in [(&small(), None), (&reference, None), (&later, Some(&reference))] {
        let how = Decoding {
            reference: before,
            ..how()
        };
        let payload = encode_group(sound, before).unwrap();
        let units = unit::split(&payload, ALL_LAYERS).unwrap();
        let mut lost = 0;
        for at in 0..payload.len() {
            let mut bad = payload.clone();
            bad[at] ^= 0x41;
            let hit = units.iter().rposition(|u| u.offset <= at).unwrap();
            let Ok((group, damage)) = decode_damaged(&bad, &how) else {
                lost += 1;
                let vital = hit == 0 || (units[hit].kind == Some(UnitType::Positions) && units[hit].layer == 0);
                assert!(vital, "byte {at} of unit {hit}");
                continue;
            };
            group.validate(before).unwrap();
            assert_eq!(damage[0].unit, Some(hit), "byte {at}");
            let names = |u: &Unit| u.dependencies.contains(&(hit as u8));
            for (i, u) in units.iter().enumerate().filter(|(i, u)| *i != hit && !names(u)) {
                assert_eq!(
                    content(&group, u),
                    content(sound, u),
                    "byte {at} of unit {hit}, unit {i}"
                );
            }
        }
        assert!(lost < payload.len() / 3);
    }
}

/// Damage of a reference also affects the groups that refer to it, which are decoded.
#[test]
fn damage_of_the_reference_is_that_of_its_followers() {
    let reference = common::group(&common::layered());
    let later = common::predicted(&reference, &common::layered());
    let payload = encode_group(&later, Some(&reference)).unwrap();
    let sound = encode_group(&reference, None).unwrap();
    for u in unit::split(&sound, ALL_LAYERS).unwrap().iter().skip(1) {
        let mut bad = sound.clone();
        bad[u.payload_offset] ^= 8;
        if let Ok((reference, damage)) = decode_damaged(&bad, &how()) {
            assert_eq!(damage[0].kind, u.kind);
            let how = Decoding {
                reference: Some(&reference),
                ..how()
            };
            let (group, own) = decode_damaged(&payload, &how).unwrap();
            assert!(own.is_empty());
            group.validate(Some(&reference)).unwrap();
            Evaluator::new(group).frame(1, &mut Frame::default());
        }
    }
}

/// Every result is a valid group.
#[test]
fn random_damage() {
    let sound = encode_group(&small(), None).unwrap();
    let mut r = Random(5);
    let mut decoded = 0;
    for _ in 0..1000 {
        let mut payload = sound.clone();
        for _ in 0..1 + r.below(3) {
            let at = r.below(payload.len() as u64) as usize;
            payload[at] = r.next() as u8;
        }
        if let Ok((group, damage)) = decode_damaged(&payload, &how()) {
            group.validate(None).unwrap();
            assert!(!damage.is_empty() || payload == sound);
            decoded += 1;
        }
    }
    assert!(decoded > 150, "{decoded}");
}

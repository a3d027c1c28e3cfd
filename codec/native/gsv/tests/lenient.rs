//! Decoding what is left of a damaged group (spec 3).

mod common;

use common::{Random, small};
use gsv::attributes::Attribute;
use gsv::decode::{Decoding, decode_damaged, decode_group};
use gsv::encode::encode_group;
use gsv::error::Error;
use gsv::evaluate::{Evaluator, Frame};
use gsv::inventory::Damage;
use gsv::levels::LEVELS;
use gsv::unit::{self, ALL_LAYERS, UnitType};

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

fn named(damage: &[Damage]) -> Vec<(Option<usize>, Option<UnitType>, Option<Attribute>)> {
    damage.iter().map(|d| (d.unit, d.kind, d.attribute)).collect()
}

#[test]
fn a_sound_group_has_no_damage() {
    let (group, damage) = decode_damaged(&encode_group(&small(), None).unwrap(), &how()).unwrap();
    assert_eq!(group, small());
    assert!(damage.is_empty());
}

#[test]
fn a_damaged_attribute_costs_only_itself() {
    for (k, a) in Attribute::canonical(1).iter().enumerate() {
        let (payload, i) = damaged(UnitType::Channels, Some(*a));
        let (group, damage) = decode_damaged(&payload, &how()).unwrap();
        assert_eq!(named(&damage), [(Some(i), Some(UnitType::Channels), Some(*a))]);
        assert!(damage[0].message.contains("CRC"), "{}", damage[0].message);
        let mut want = small();
        want.channels[k].fill(0);
        assert_eq!(group, want);
        assert!(matches!(decode_group(&payload, &how()), Err(Error::Bitstream { .. })));
    }
    for (k, a) in Attribute::ALL.iter().enumerate() {
        let (payload, i) = damaged(UnitType::Trajectories, Some(*a));
        let (group, damage) = decode_damaged(&payload, &how()).unwrap();
        assert_eq!(named(&damage), [(Some(i), Some(UnitType::Trajectories), Some(*a))]);
        assert!((0..12).all(|i| group.trajectories[k].get(i).is_empty()));
        let mut want = small();
        want.trajectories[k] = group.trajectories[k].clone();
        assert_eq!(group, want);
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

/// A sound unit that breaks a rule is not damage.
#[test]
fn broken_rules_stay_errors() {
    let mut payload = encode_group(&small(), None).unwrap();
    unit::write(&mut payload, [7, 0, 2], &[1], b"").unwrap();
    let message = decode_damaged(&payload, &how()).unwrap_err().to_string();
    assert!(message.contains("not yet supported"), "{message}");
}

/// Whatever comes out is a group.
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

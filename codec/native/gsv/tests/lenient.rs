//! Decoding the undamaged units of a damaged group (spec 3).

mod common;

use common::{Random, group, predicted, small, tiled};
use gsv::conformance::Damage;
use gsv::decode::{Decoding, decode_damaged, decode_group};
use gsv::encode::encode_group;
use gsv::error::Error;
use gsv::evaluate::Evaluator;
use gsv::group::Group;
use gsv::levels::LEVELS;
use gsv::parametric::Frame;
use gsv::unit::{self, ALL_LAYERS, UnitKey, UnitType};

fn how() -> Decoding<'static> {
    Decoding::at(&LEVELS[0])
}

/// A payload with the last byte of a unit flipped.
fn damaged(payload: &[u8], key: UnitKey) -> Vec<u8> {
    let mut bad = payload.to_vec();
    let units = unit::split(payload, ALL_LAYERS).unwrap();
    let u = units.iter().find(|u| u.key() == Some(key)).unwrap();
    bad[u.offset + u.size - 1] ^= 0x10;
    bad
}

fn named(damage: &[Damage]) -> Vec<UnitKey> {
    damage.iter().map(|d| (d.kind.unwrap(), d.layer, d.index)).collect()
}

/// The Gaussians of tile `t` of layer `k`.
fn content(g: &Group, k: usize, t: usize) -> (Vec<[u32; 3]>, Vec<i32>, Vec<Vec<i32>>) {
    let range = g.tile_range(k, t);
    let c = g.header.scales[0].steps.len();
    let moves = range.clone().map(|i| g.trajectories[0].get(i).to_vec());
    (
        g.positions[range.clone()].to_vec(),
        g.channels[0][range.start * c..range.end * c].to_vec(),
        moves.collect(),
    )
}

#[test]
fn a_sound_group_has_no_damage() {
    let (group, damage) = decode_damaged(&encode_group(&small(), None).unwrap(), &how()).unwrap();
    let rotations = small().rotations;
    assert_eq!(Group { rotations, ..group }, small());
    assert!(damage.is_empty());
}

/// Damage ends at the tile, unless others start from its models; later groups lack the same tile.
#[test]
fn a_damaged_tile_costs_only_itself() {
    let g = group(&tiled());
    let later = predicted(&g, &tiled());
    let payload = encode_group(&g, None).unwrap();
    let second = encode_group(&later, Some(&g)).unwrap();
    for u in unit::split(&payload, ALL_LAYERS).unwrap() {
        let Some((UnitType::Tile, layer, index)) = u.key() else {
            continue;
        };
        let bad = damaged(&payload, (UnitType::Tile, layer, index));
        assert!(
            matches!(decode_group(&bad, &how()), Err(Error::Bitstream { offset, .. }) if offset == u.offset as u64)
        );
        if (layer, index) == (0, 0) {
            assert!(decode_damaged(&bad, &how()).unwrap_err().to_string().contains("CRC"));
            continue;
        }
        let (part, damage) = decode_damaged(&bad, &how()).unwrap();
        part.validate(None).unwrap();
        let lost = |k: u8, t: u16| k == layer && (t == index || index == 0);
        let tiles = (0u8..)
            .zip(&g.tiles)
            .flat_map(|(k, own)| (0..own.len() as u16).map(move |t| (k, t)));
        let all: Vec<(u8, u16)> = tiles.collect();
        let want: Vec<UnitKey> = all
            .iter()
            .filter(|(k, t)| lost(*k, *t))
            .map(|(k, t)| (UnitType::Tile, *k, *t))
            .collect();
        assert_eq!(named(&damage), want);
        assert!(damage[0].message.contains("CRC"), "{}", damage[0].message);
        assert!(damage[1..].iter().all(|d| d.message.contains("is damaged")));
        for (k, t) in all {
            let (k, t, gone) = (usize::from(k), usize::from(t), lost(k, t));
            assert_eq!(
                part.tile_range(k, t).len(),
                if gone { 0 } else { g.tile_range(k, t).len() }
            );
            assert!(gone || content(&part, k, t) == content(&g, k, t));
        }
        let how = Decoding {
            reference: Some(&part),
            ..how()
        };
        let (group, own) = decode_damaged(&second, &how).unwrap();
        assert!(own.is_empty());
        group.validate(Some(&part)).unwrap();
        Evaluator::new(group).frame(1, &mut Frame::default());
    }
}

#[test]
fn a_damaged_tile_of_a_predicted_group() {
    let g = group(&tiled());
    let later = predicted(&g, &tiled());
    let payload = encode_group(&later, Some(&g)).unwrap();
    let how = Decoding {
        reference: Some(&g),
        ..how()
    };
    for u in unit::split(&payload, ALL_LAYERS).unwrap().iter().skip(1) {
        let (group, damage) = decode_damaged(&damaged(&payload, u.key().unwrap()), &how).unwrap();
        assert_eq!(damage[0].unit, u.number);
        group.validate(Some(&g)).unwrap();
    }
}

#[test]
fn without_their_nodes_gaussians_stay_where_they_are() {
    let mut g = small();
    (g.rig, g.header.rig) = Default::default();
    let payload = encode_group(&g, None).unwrap();
    let rest = |key: UnitKey| {
        let (mut group, damage) = decode_damaged(&damaged(&payload, key), &how()).unwrap();
        (group.trajectories, group.header.trajectories) = (Vec::new(), Vec::new());
        let mut frame = Frame::default();
        Evaluator::new(group).frame(3, &mut frame);
        (frame.means, damage)
    };
    let origin: Vec<[f32; 3]> = g
        .positions
        .iter()
        .map(|p| std::array::from_fn(|a| g.header.origin[a] + g.header.grid_step * p[a] as f32))
        .collect();
    let near = |a: &f32, b: &f32| (a - b).abs() <= 1e-4 * b.abs();
    let (means, damage) = rest((UnitType::NodeTrajectories, 0, 0));
    assert!(
        means
            .iter()
            .flatten()
            .zip(origin.iter().flatten())
            .all(|(a, b)| near(a, b))
    );
    assert_eq!(named(&damage), [(UnitType::NodeTrajectories, 0, 0)]);
    let (means, damage) = rest((UnitType::NodePositions, 0, 0));
    assert_eq!(means, origin);
    let both = [(UnitType::NodePositions, 0, 0), (UnitType::NodeTrajectories, 0, 0)];
    assert_eq!(named(&damage), both);
}

#[test]
fn without_its_rig_or_its_poses_nothing_is_predicted() {
    let payload = encode_group(&small(), None).unwrap();
    let whole = decode_damaged(&payload, &how()).unwrap().0;
    for kind in [UnitType::Rig, UnitType::JointPoses] {
        let (group, damage) = decode_damaged(&damaged(&payload, (kind, 0, 0)), &how()).unwrap();
        assert_eq!(damage[0].kind, Some(kind));
        assert_eq!(group.rig, None);
        assert_eq!(group.node_trajectories, whole.node_trajectories);
        group.validate(None).unwrap();
        Evaluator::new(group).frame(3, &mut Frame::default());
    }
    let (group, damage) = decode_damaged(&damaged(&payload, (UnitType::NodePositions, 0, 0)), &how()).unwrap();
    assert_eq!(damage.len(), 4);
    assert_eq!(group.rig, None);
}

#[test]
fn what_is_cut_off_is_missing() {
    let payload = encode_group(&group(&tiled()), None).unwrap();
    let units = unit::split(&payload, ALL_LAYERS).unwrap();
    let (group, damage) = decode_damaged(&payload[..units[3].offset + 3], &how()).unwrap();
    assert_eq!(
        damage.iter().map(|d| d.unit).collect::<Vec<_>>(),
        (3..units.len()).collect::<Vec<_>>()
    );
    assert!(
        damage
            .iter()
            .all(|d| d.message.contains("more bytes") || d.message.contains("is damaged"))
    );
    group.validate(None).unwrap();
    assert_eq!(group.tiles, [vec![256, 256, 0, 0], vec![0, 0]]);
}

/// Any result is a valid group.
#[test]
fn random_damage() {
    let sound = encode_group(&group(&tiled()), None).unwrap();
    let mut r = Random(5);
    let mut decoded = 0;
    for _ in 0..300 {
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
    assert!(decoded > 100, "{decoded}");
}

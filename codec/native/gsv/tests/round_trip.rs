//! decode(encode(x)) = x for every valid group; an invalid one is refused with a message that names the error.

mod common;

use common::{Random, Shape, group, layered, predicted, shape, small, tiled, with};
use gsv::decode::{Decoding, decode_group};
use gsv::encode::encode_group;
use gsv::error::Error;
use gsv::evaluate::Evaluator;
use gsv::group::Group;
use gsv::levels::{LEVELS, Level};
use gsv::parametric::Frame;
use gsv::unit::{self, ALL_LAYERS};
use proptest::prelude::*;

fn decoded(g: &Group) -> Group {
    let payload = encode_group(g, None).unwrap();
    let out = decode_group(&payload, &Decoding::at(&Level::get(4).unwrap())).unwrap();
    assert_eq!(
        encode_group(g, None).unwrap(),
        payload,
        "encoding must not depend on threads"
    );
    out
}

/// Trajectories keep their number of channels even when empty.
fn same(a: &Group, b: &Group) {
    assert_eq!(a.header, b.header);
    assert_eq!(
        (&a.layers, &a.tiles, &a.parents, &a.corrections),
        (&b.layers, &b.tiles, &b.parents, &b.corrections)
    );
    assert_eq!(a.positions, b.positions);
    assert_eq!(a.channels, b.channels);
    assert_eq!(a.lifetimes, b.lifetimes);
    assert_eq!(a.node_positions, b.node_positions);
    assert_eq!(a.trajectories, b.trajectories);
    assert_eq!(a.node_trajectories.len(), b.node_trajectories.len());
    (0..a.node_trajectories.len()).for_each(|i| assert_eq!(a.node_trajectories.get(i), b.node_trajectories.get(i)));
    assert_eq!(a.rig, b.rig);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn groups_come_back(s in shape()) {
        let g = group(&s);
        same(&g, &decoded(&g));
    }

    #[test]
    fn layers_leave_out_low_bits(s in shape(), shift in 1..6u32) {
        let (mut g, plain) = (group(&s), group(&s));
        let kinds = g.header.attributes().len();
        let own = [0, 1, 2, 3, 4, 5].map(|i| if (1..=kinds).contains(&i) { shift as u8 } else { 0 });
        g.header.shifts = vec![own; g.layers.len()];
        g.channels.iter_mut().flatten().for_each(|v| *v = *v >> shift << shift);
        same(&g, &decoded(&g));
        if plain.channels != g.channels {
            g.channels = plain.channels;
            prop_assert!(matches!(encode_group(&g, None), Err(Error::Input(m)) if m.contains("multiples")));
        }
    }

    #[test]
    fn predicted_groups_come_back(s in shape(), seed: u64) {
        let reference = group(&s);
        let g = predicted(&reference, &Shape { seed, ..s });
        let payload = encode_group(&g, Some(&reference)).unwrap();
        same(&g, &decode_group(&payload, &with(&reference)).unwrap());
        prop_assert!(decode_group(&payload, &Decoding::at(&Level::get(1).unwrap())).is_err());
    }

    #[test]
    fn a_prefix_is_the_first_layers(s in shape()) {
        let g = group(&s);
        let payload = encode_group(&g, None).unwrap();
        let units = unit::split(&payload, ALL_LAYERS).unwrap();
        let level = Level::get(1).unwrap();
        for layers in 1..=g.layers.len() {
            let how = Decoding { layers, ..Decoding::at(&level) };
            let end = units.iter().find(|u| usize::from(u.layer) >= layers).map_or(payload.len(), |u| u.offset);
            let prefix = decode_group(&payload, &how).unwrap();
            prop_assert_eq!(&prefix, &decode_group(&payload[..end], &how).unwrap());
            let mut cut = payload.clone();
            if end < cut.len() {
                cut[end] ^= 1; // damage behind the prefix does not matter
                prop_assert_eq!(&prefix, &decode_group(&cut, &how).unwrap());
                cut.truncate(end + 1);
                prop_assert_eq!(&prefix, &decode_group(&cut, &how).unwrap());
            }
            let range = g.range(0..layers);
            prop_assert_eq!(&prefix.positions, &g.positions[range.clone()]);
            for (t, whole) in prefix.trajectories.iter().zip(&g.trajectories) {
                prop_assert!(range.clone().all(|i| t.get(i) == whole.get(i)));
            }
            let mut frame = Frame::default();
            Evaluator::new(prefix).frame(0, &mut frame);
            prop_assert_eq!(frame.means.len(), range.len());
        }
    }

    #[test]
    fn frames_are_finite(s in shape()) {
        let g = decoded(&group(&s));
        let frames = g.header.frames;
        let e = Evaluator::new(g);
        let mut f = Frame::default();
        for t in [0, frames / 2, frames - 1] {
            e.frame(t, &mut f);
            prop_assert!(f.means.iter().flatten().all(|v| v.is_finite()));
            for q in &f.quats {
                prop_assert!((q.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-3);
            }
        }
    }
}

/// Any tiles decoded alone equal those of the whole group, also where the other bytes are zero or left out; so do tiles
/// of a group that is predicted from a part.
#[test]
fn tiles_come_alone() {
    let g = group(&tiled());
    let later = predicted(&g, &tiled());
    let payload = encode_group(&g, None).unwrap();
    let second = encode_group(&later, Some(&g)).unwrap();
    let whole = decode_group(&payload, &Decoding::at(&Level::get(1).unwrap())).unwrap();
    let mut r = Random(3);
    for _ in 0..30 {
        let wanted: Vec<Vec<bool>> = g
            .tiles
            .iter()
            .map(|t| t.iter().map(|_| r.below(3) == 0).collect())
            .collect();
        let how = Decoding {
            tiles: Some(&wanted),
            ..Decoding::at(&LEVELS[0])
        };
        let (mut holes, mut packed) = (payload.clone(), Vec::new());
        let lead = |u: &unit::Unit| u.index == 0 || wanted[usize::from(u.layer)][usize::from(u.index)];
        for u in unit::split(&payload, ALL_LAYERS).unwrap() {
            let own = if packed.is_empty() { 0 } else { u.offset }..u.offset + u.size;
            if u.kind == Some(unit::UnitType::Tile) && !lead(&u) {
                holes[own].fill(0);
            } else {
                packed.extend_from_slice(&payload[own]);
            }
        }
        let part = decode_group(&holes, &how).unwrap();
        let alone = Decoding { packed: true, ..how };
        same(&decode_group(&packed, &alone).unwrap(), &part);
        assert!(packed.len() == payload.len() || decode_group(&packed, &how).is_err());
        part.validate(None).unwrap();
        for (k, own) in wanted.iter().enumerate() {
            for (t, asked) in own.iter().enumerate() {
                let (mine, all) = (part.tile_range(k, t), whole.tile_range(k, t));
                assert_eq!(mine.len(), if t == 0 || *asked { all.len() } else { 0 });
                if !mine.is_empty() {
                    assert_eq!(part.positions[mine.clone()], whole.positions[all.clone()]);
                    assert_eq!(part.rotations[mine.clone()], whole.rotations[all.clone()]);
                    assert_eq!(
                        part.channels[1][3 * mine.start..3 * mine.end],
                        whole.channels[1][3 * all.start..3 * all.end]
                    );
                    assert!(
                        mine.clone()
                            .zip(all)
                            .all(|(i, j)| part.trajectories[0].get(i) == whole.trajectories[0].get(j))
                    );
                }
            }
        }
        let from_part = decode_group(&second, &with(&part)).unwrap();
        from_part.validate(Some(&part)).unwrap();
        assert!(from_part.positions.len() < later.positions.len() || part.positions.len() == whole.positions.len());
    }
}

/// Shares of a group, and of one that is predicted from the same share, make up the whole: each tile is in exactly one
/// share.
#[test]
fn shares_make_up_the_whole() {
    let g = group(&tiled());
    let later = predicted(&g, &tiled());
    let payload = encode_group(&g, None).unwrap();
    let second = encode_group(&later, Some(&g)).unwrap();
    let whole = decode_group(&payload, &Decoding::at(&LEVELS[0])).unwrap();
    let all = decode_group(&second, &with(&whole)).unwrap();
    for n in 2..5 {
        let mut found = vec![0; 2];
        for share in 0..n {
            let wanted = |g: &Group| -> Vec<Vec<bool>> {
                let own = |k: usize| (0..g.tiles[k].len()).map(move |t| (k + t) % n == share);
                (0..g.tiles.len()).map(|k| own(k).collect()).collect()
            };
            let (first, next) = (wanted(&whole), wanted(&all));
            let mut how = Decoding {
                tiles: Some(&first),
                ..Decoding::at(&LEVELS[0])
            };
            let reference = decode_group(&payload, &how).unwrap();
            how.keep_leading = false;
            let shown = decode_group(&payload, &how).unwrap();
            (how.tiles, how.reference) = (Some(&next[..]), Some(&reference));
            let then = decode_group(&second, &how).unwrap();
            for (i, (part, all, wanted)) in [(shown, &whole, &first), (then, &all, &next)].into_iter().enumerate() {
                found[i] += part.positions.len();
                for (k, t) in wanted
                    .iter()
                    .enumerate()
                    .flat_map(|(k, own)| (0..own.len()).map(move |t| (k, t)))
                {
                    let (mine, theirs) = (part.tile_range(k, t), all.tile_range(k, t));
                    assert_eq!(mine.len(), if wanted[k][t] { theirs.len() } else { 0 });
                    if !mine.is_empty() {
                        assert_eq!(part.positions[mine.clone()], all.positions[theirs.clone()]);
                        assert_eq!(part.rotations[mine], all.rotations[theirs]);
                    }
                }
            }
        }
        assert_eq!(found, [whole.positions.len(), all.positions.len()]);
    }
}

#[test]
fn all_points_in_one_place() {
    let mut g = group(&Shape {
        counts: vec![5000],
        nodes: 0,
        joints: 0,
        moving: 0,
        lifetimes: false,
        ..tiny()
    });
    g.header.tile_side_log2 = 6;
    g.divide(None);
    for corner in [0, 63] {
        g.positions.fill([corner; 3]);
        same(&g, &decoded(&g));
    }
}

#[test]
fn many_points_and_longest_trajectories() {
    let s = Shape {
        counts: vec![20_000],
        frames: 256,
        moving: 0b10,
        magnitude: 2,
        bits: 11,
        ..tiny()
    };
    let mut g = group(&s);
    g.header.trajectories[0].coefficients = 256;
    let mut r = Random(1);
    let mut t = gsv::trajectories::Trajectories::new(3);
    for i in 0..20_000 {
        let own: Vec<i32> = (0..if i % 997 == 0 { 768 } else { 0 }).map(|_| r.value(24)).collect();
        t.push(&own);
    }
    g.trajectories[0] = t;
    same(&g, &decoded(&g));
}

fn tiny() -> Shape {
    Shape {
        counts: vec![1],
        frames: 1,
        bits: 6,
        sh_degree: 0,
        nodes: 0,
        joints: 0,
        magnitude: 3,
        lifetimes: false,
        moving: 0,
        seed: 3,
    }
}

/// Every input error has a message that names the error.
#[test]
fn impossible_groups_are_refused() {
    let refused = |change: fn(&mut Group), part: &str| {
        let mut g = small();
        change(&mut g);
        match encode_group(&g, None) {
            Err(Error::Input(m)) => assert!(m.contains(part), "{m}"),
            other => panic!("{part}: {other:?}"),
        }
    };
    refused(|g| g.positions.reverse(), "Morton order");
    refused(|g| g.positions[11] = [64, 0, 0], "below 2^6");
    refused(|g| g.header.frames = 0, "frames");
    refused(|g| g.header.grid_bits = 22, "grid_bits");
    refused(|g| g.header.grid_step = f32::NAN, "grid_step");
    refused(|g| g.positions.truncate(11), "positions");
    refused(|g| g.header.layers[0].count += 1, "layers and tiles that the header");
    refused(|g| g.header.tile_side_log2 = 3, "tile_side_log2");
    refused(|g| g.header.tiles[0][0].bounds[0] = u16::MAX, "bounds");
    refused(|g| g.tiles[0][0] -= 1, "make up the layers");
    refused(|g| g.header.layers.clear(), "1 to 16 layers");
    refused(|g| g.channels[1][0] = (1 << 24) + 1, "quats");
    refused(|g| g.header.trajectories[0].coefficients = 6, "coefficients");
    refused(|g| g.header.nodes.neighbors = 9, "neighbors");
    refused(|g| g.header.rig.joints = 0, "a rig as the header");
    refused(|g| g.header.rig.rotation_step = 0.0, "rotation_step");
    refused(|g| g.rig.as_mut().unwrap().weights.truncate(1), "weights for each");
    refused(|g| g.rig.as_mut().unwrap().weights[0] = 65, "weights of 0 to 64");
    refused(|g| g.rig.as_mut().unwrap().parents[0] = 1, "parent");
    refused(|g| g.rig.as_mut().unwrap().bind[0][5] = (1 << 24) + 1, "rig");
    refused(|g| g.rig.as_mut().unwrap().poses = Default::default(), "joints");
    refused(|g| g.lifetimes = Some(vec![[3, 3]; 12]), "lifetime of Gaussian 0");
    refused(|g| g.lifetimes = None, "lifetimes as the header");
    refused(|g| g.header.frames = 300, "frames, level 4");
}

/// The properties that a predicted group must share with its reference.
#[test]
fn impossible_predictions_are_refused() {
    let reference = group(&layered());
    let refused = |change: fn(&mut Group), part: &str| {
        let mut g = predicted(&reference, &layered());
        change(&mut g);
        match encode_group(&g, Some(&reference)) {
            Err(Error::Input(m)) => assert!(m.contains(part), "{m}"),
            other => panic!("{part}: {other:?}"),
        }
    };
    refused(|g| g.parents.as_mut().unwrap().swap(0, 1), "increasing indices");
    refused(|g| g.parents.as_mut().unwrap()[0] = 99, "increasing indices");
    refused(|g| g.parents = None, "parents");
    refused(|g| g.positions[0][0] ^= 1, "integers of the reference");
    refused(|g| g.channels[1][0] += 1, "integers of the reference");
    let g = predicted(&reference, &layered());
    assert!(encode_group(&g, None).unwrap_err().to_string().contains("refers to"));
    assert!(
        encode_group(&g, Some(&g))
            .unwrap_err()
            .to_string()
            .contains("independent group")
    );
}

//! Reposing of a group with a rig: only the poses and the bounds of tiles change.

mod common;

use common::{group, layered, predicted, small, with};
use gsv::decode::{Decoding, decode_group};
use gsv::encode::encode_group;
use gsv::error::Error;
use gsv::evaluate::Evaluator;
use gsv::group::Group;
use gsv::levels::LEVELS;
use gsv::parametric::Frame;
use gsv::reposing::repose;
use gsv::rig::CHANNELS;
use gsv::trajectories::Trajectories;
use gsv::unit::{ALL_LAYERS, UnitType, split};

/// Poses of two joints: the first one turns and moves.
fn poses() -> Trajectories {
    let mut out = Trajectories::new(CHANNELS);
    out.push(&[9, 0, 0, 100, 0, 0, 3, 0, 0, 0, -7, 0]);
    out.push(&[]);
    out
}

fn check(g: &Group, reference: Option<&Group>, how: &Decoding) {
    let payload = encode_group(g, reference).unwrap();
    let other = repose(&payload, how, poses()).unwrap();
    let (before, after) = (split(&payload, ALL_LAYERS).unwrap(), split(&other, ALL_LAYERS).unwrap());
    assert_eq!(before.len(), after.len());
    for (a, b) in before.iter().zip(&after).skip(1) {
        assert_eq!(a.key(), b.key());
        assert_eq!(a.payload != b.payload, a.kind == Some(UnitType::JointPoses));
    }
    let (old, new) = (decode_group(&payload, how).unwrap(), decode_group(&other, how).unwrap());
    let mut expected = old.clone();
    expected.rig.as_mut().unwrap().poses = poses();
    expected.header.tiles = new.header.tiles.clone();
    assert_eq!(expected, new);
    let (mut a, mut b) = (Frame::default(), Frame::default());
    Evaluator::new(old).frame(1, &mut a);
    Evaluator::new(new).frame(1, &mut b);
    assert_ne!(a.means, b.means);
    assert_eq!(a.log_scales, b.log_scales);
}

#[test]
fn only_the_poses_change() {
    let how = Decoding::at(&LEVELS[0]);
    check(&small(), None, &how);
    let reference = group(&layered());
    check(&reference, None, &how);
    check(&predicted(&reference, &layered()), Some(&reference), &with(&reference));
}

#[test]
fn what_does_not_fit_is_refused() {
    let how = Decoding::at(&LEVELS[0]);
    let payload = encode_group(&small(), None).unwrap();
    let refused = |payload: &[u8], poses: Trajectories, part: &str| match repose(payload, &how, poses) {
        Err(Error::Input(m)) => assert!(m.contains(part), "{m}"),
        other => panic!("{part}: {other:?}"),
    };
    refused(&payload, Trajectories::still(CHANNELS, 3), "expected 2 of 6 channels");
    let mut long = Trajectories::new(CHANNELS);
    long.push(&[1; 6 * CHANNELS]); // of 5 frames
    long.push(&[]);
    refused(&payload, long, "at most 5 coefficients");
    let mut plain = small();
    (plain.rig, plain.header.rig) = Default::default();
    refused(&encode_group(&plain, None).unwrap(), poses(), "a group with a rig");
}

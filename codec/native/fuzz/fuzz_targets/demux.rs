//! The demuxer, for any of the tracks: no panic; a placement that is a valid transform at any time; the same result
//! whole, in pieces and with media data skipped; and recovery of a damaged file.
#![no_main]

use gsv::container::demux::Demuxer;
use gsv::container::whole;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: (u8, u8, &[u8])| {
    let (piece, track, data) = (usize::from(input.0) + 1, usize::from(input.1 & 3), input.2);
    let mut whole = Demuxer::of_track(track);
    let mut pieces = Demuxer::of_track(track);
    let ok = whole.push(data).is_ok();
    assert_eq!(ok, data.chunks(piece).try_for_each(|d| pieces.push(d)).is_ok());
    assert_eq!(whole.groups(), pieces.groups());
    for u in [-1e9, 0.0, 0.5, f64::from(piece as u32)] {
        let pose = whole.config().map_or(Default::default(), |c| c.placement.pose(u));
        assert!(pose.rotation.iter().all(|v| v.is_finite()) && pose.scale > 0.0);
    }
    let mut skipping = Demuxer::of_track(track);
    let mut rest = data;
    while !rest.is_empty() {
        let skip = usize::try_from(skipping.skippable())
            .unwrap_or(usize::MAX)
            .min(rest.len());
        let n = if skip > 0 { skip } else { 1 };
        if skip > 0 {
            skipping.skip(skip as u64);
        } else if skipping.push(&rest[..1]).is_err() {
            break;
        }
        rest = &rest[n..];
    }
    assert_eq!(whole.groups(), skipping.groups());
    let strict = whole::read(data, true, track).map(|(d, _)| d.groups().len());
    if let Ok((saved, damage)) = whole::read(data, false, track) {
        assert!(strict.is_ok_and(|n| n <= saved.groups().len()) || !damage.is_empty() || !saved.index().is_empty());
    }
});

//! The demuxer: no panic, and the same result whole, in pieces and with media data skipped; and what is saved of a damaged file.
#![no_main]

use gsv::container::demux::Demuxer;
use gsv::container::whole;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: (u8, &[u8])| {
    let (piece, data) = (usize::from(input.0) + 1, input.1);
    let mut whole = Demuxer::default();
    let mut pieces = Demuxer::default();
    let ok = whole.push(data).is_ok();
    assert_eq!(ok, data.chunks(piece).try_for_each(|d| pieces.push(d)).is_ok());
    assert_eq!(whole.groups(), pieces.groups());
    let mut skipping = Demuxer::default();
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
    let strict = whole::read(data, true).map(|(d, _)| d.groups().len());
    if let Ok((saved, damage)) = whole::read(data, false) {
        assert!(strict.is_ok_and(|n| n <= saved.groups().len()) || !damage.is_empty() || !saved.index().is_empty());
    }
});

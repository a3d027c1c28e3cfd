//! The header and unit parsers: any bytes as a group payload, alone or with a reference, all of its tiles or some.
//! Every other input is a header that gets its checksum, and the bytes behind it. Damaged or not, a decoded group is
//! valid.
#![no_main]

use gsv::decode::{Decoding, decode_damaged, decode_group, reference_of};
use gsv::group::Group;
use gsv::levels::LEVELS;
use gsv::unit;
use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;

static REFERENCE: LazyLock<Group> = LazyLock::new(|| {
    decode_group(include_bytes!("../layered.bin"), &Decoding::at(&LEVELS[0])).expect("the seed is sound")
});

fuzz_target!(init: fuzz::one_thread(), |input: (u8, bool, Vec<u8>, &[u8])| {
    let (how, sealed, header, rest) = input;
    let payload = if sealed { unit::write(&header, &[rest.to_vec()]).expect("it is short") } else { rest.to_vec() };
    let data = &payload[..];
    let wanted: Vec<Vec<bool>> = (0..3).map(|k| (0..8).map(|t| how >> 5 & 1 << (t + k) % 3 != 0).collect()).collect();
    let how = Decoding {
        reference: (how & 1 != 0).then(|| &*REFERENCE),
        layers: 1 + usize::from(how >> 1 & 7),
        tiles: (how & 16 != 0).then_some(&wanted[..]),
        ..Decoding::at(&LEVELS[0])
    };
    let _ = reference_of(data);
    let strict = decode_group(data, &how);
    match decode_damaged(data, &how) {
        Ok((group, damage)) => {
            group.validate(how.reference).expect("a group");
            assert_eq!(damage.is_empty(), strict.is_ok());
        }
        Err(_) => assert!(strict.is_err()),
    }
});

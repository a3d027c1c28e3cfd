//! The unit parser: any bytes as a group payload. Damaged or not, what is decoded is a group.
#![no_main]

use gsv::decode::{decode_damaged, decode_group};
use gsv::levels::LEVELS;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let strict = decode_group(data, &LEVELS[0]);
    match decode_damaged(data, &LEVELS[0]) {
        Ok((group, damage)) => {
            group.validate().expect("a group");
            assert_eq!(damage.is_empty(), strict.is_ok());
        }
        Err(_) => assert!(strict.is_err()),
    }
});

//! The unit parser: any bytes as a group payload.
#![no_main]

use gsv::decode::decode_group;
use gsv::levels::LEVELS;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let _ = decode_group(data, &LEVELS[0]);
});

//! CRC-32 of units (spec 3): ISO-HDLC, eight bytes a step.

use std::sync::LazyLock;

/// Table k advances a byte by k more bytes. Made at first use: stored tables would be a twentieth of the page's
/// decoder.
static TABLES: LazyLock<[[u32; 256]; 8]> = LazyLock::new(|| {
    let mut t = [[0; 256]; 8];
    for (i, c) in t[0].iter_mut().enumerate() {
        *c = (0..8).fold(i as u32, |c, _| if c & 1 != 0 { c >> 1 ^ 0xEDB8_8320 } else { c >> 1 });
    }
    for k in 1..8 {
        t[k] = t[k - 1].map(|c| c >> 8 ^ t[0][(c & 255) as usize]);
    }
    t
});

/// CRC-32 of the concatenation of `parts`.
pub fn crc32(parts: &[&[u8]]) -> u32 {
    !parts.iter().fold(u32::MAX, |crc, part| update(crc, part))
}

fn update(mut crc: u32, data: &[u8]) -> u32 {
    let tables = &*TABLES;
    let (words, tail) = data.as_chunks::<8>();
    for w in words {
        let v = u64::from_le_bytes(*w) ^ u64::from(crc);
        crc = (0..8).fold(0, |c, k| c ^ tables[7 - k][(v >> (8 * k) & 255) as usize]);
    }
    tail.iter()
        .fold(crc, |c, b| c >> 8 ^ tables[0][((c ^ u32::from(*b)) & 255) as usize])
}

#[cfg(test)]
mod tests {
    #[test]
    fn check_value_of_the_standard() {
        assert_eq!(super::crc32(&[b"123456789"]), 0xCBF4_3926);
        assert_eq!(super::crc32(&[b"1234", b"", b"56789"]), 0xCBF4_3926);
    }
}

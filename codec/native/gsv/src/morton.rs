//! Morton order (spec 7.1): grid points -> the order in which Gaussians and nodes are indexed.

use rayon::prelude::*;

/// Moves bit j of `v` to bit 3j.
#[inline]
fn spread(v: u32) -> u64 {
    let mut x = u64::from(v & 0x1F_FFFF);
    x = (x | x << 32) & 0x001F_0000_0000_FFFF;
    x = (x | x << 16) & 0x001F_0000_FF00_00FF;
    x = (x | x << 8) & 0x100F_00F0_0F00_F00F;
    x = (x | x << 4) & 0x10C3_0C30_C30C_30C3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

/// The inverse of `spread`.
#[inline]
fn gather(code: u64) -> u32 {
    let mut x = code & 0x1249_2492_4924_9249;
    x = (x | x >> 2) & 0x10C3_0C30_C30C_30C3;
    x = (x | x >> 4) & 0x100F_00F0_0F00_F00F;
    x = (x | x >> 8) & 0x001F_0000_FF00_00FF;
    x = (x | x >> 16) & 0x001F_0000_0000_FFFF;
    (x | x >> 32) as u32 & 0x1F_FFFF
}

/// The Morton code of a grid point of up to 21 bits an axis; x holds the highest bit of each triple.
#[inline]
pub fn encode(p: [u32; 3]) -> u64 {
    spread(p[0]) << 2 | spread(p[1]) << 1 | spread(p[2])
}

/// The grid point of a Morton code.
#[inline]
pub fn decode(code: u64) -> [u32; 3] {
    [gather(code >> 2), gather(code >> 1), gather(code)]
}

/// Stable permutation that puts `positions` into Morton order.
pub fn order(positions: &[[u32; 3]]) -> Vec<u32> {
    let mut keys: Vec<(u64, u32)> = positions
        .iter()
        .enumerate()
        .map(|(i, p)| (encode(*p), i as u32))
        .collect();
    keys.par_sort_unstable();
    keys.into_iter().map(|(_, i)| i).collect()
}

/// True if `positions` are in Morton order.
pub fn is_sorted(positions: &[[u32; 3]]) -> bool {
    positions.iter().map(|p| encode(*p)).is_sorted()
}

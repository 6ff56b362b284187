//! Morton keys: three coordinates interleaved bit by bit, so that what is near in space is near in the order of keys.

/// Bits per axis of a key.
pub(crate) const BITS: u32 = 21;

/// Interleaves three coordinates of [`BITS`] bits.
pub(crate) fn morton(x: u32, y: u32, z: u32) -> u64 {
    spread_bits(x) | spread_bits(y) << 1 | spread_bits(z) << 2
}

/// The coordinates again.
pub(crate) fn unmorton(key: u64) -> (u32, u32, u32) {
    (gather_bits(key), gather_bits(key >> 1), gather_bits(key >> 2))
}

fn spread_bits(v: u32) -> u64 {
    let mut x = u64::from(v) & 0x1f_ffff;
    x = (x | x << 32) & 0x1f_0000_0000_ffff;
    x = (x | x << 16) & 0x1f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

fn gather_bits(v: u64) -> u32 {
    let mut x = v & 0x1249_2492_4924_9249;
    x = (x | x >> 2) & 0x10c3_0c30_c30c_30c3;
    x = (x | x >> 4) & 0x100f_00f0_0f00_f00f;
    x = (x | x >> 8) & 0x1f_0000_ff00_00ff;
    x = (x | x >> 16) & 0x1f_0000_0000_ffff;
    ((x | x >> 32) & 0x1f_ffff) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn morton_keys_invert() {
        for (x, y, z) in [(0, 0, 0), (1, 2, 3), (0x1f_ffff, 0, 0x1f_ffff), (1_234_567, 987_654, 2_000_000)] {
            assert_eq!(unmorton(morton(x, y, z)), (x, y, z));
        }
    }
}

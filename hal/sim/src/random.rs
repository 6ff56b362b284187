//! Decisions that depend on what they are about and not on what happened before: the n-th message of a kind meets the
//! same fate in every run of a seed, whatever else is on the line.

/// What is being decided; each kind has its own sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum About {
    /// A frame on the line.
    Frame = 1,
    /// A byte of a frame lost.
    ByteLoss,
    /// A byte of a frame damaged, and which bit.
    BitFlip,
    /// A false attitude.
    Spike,
    /// A field that is not a number.
    Nan,
    /// An announcement of an exposure.
    Trigger,
    /// A picture lost.
    PictureLoss,
    /// A picture delivered twice.
    PictureTwice,
    /// A picture delivered late.
    PictureLate,
    /// A black picture.
    PictureBlack,
    /// An overexposed picture.
    PictureOver,
    /// A truncated picture file.
    PictureCut,
}

/// 64 well-mixed bits for event `n` of a kind in stream `stream` (SplitMix64's finaliser).
pub fn bits(seed: u64, about: About, stream: u32, n: u64) -> u64 {
    let mut z = seed
        .wrapping_add((about as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15))
        .wrapping_add(u64::from(stream).wrapping_mul(0xD1B5_4A32_D192_ED03))
        .wrapping_add(n.wrapping_mul(0xBF58_476D_1CE4_E5B9));
    for _ in 0..2 {
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^= z >> 31;
    }
    z
}

/// True for `percent` of the events.
pub fn strikes(percent: f32, seed: u64, about: About, stream: u32, n: u64) -> bool {
    percent > 0.0 && (bits(seed, about, stream, n) >> 40) as f32 * (100.0 / (1u64 << 24) as f32) < percent
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_percentage_is_met_and_repeats() {
        let count = |seed| (0..100_000).filter(|n| strikes(7.0, seed, About::Frame, 33, *n)).count();
        assert!((6_700..7_300).contains(&count(1)) && count(1) == count(1) && count(1) != count(2));
        assert_eq!((0..1000).filter(|n| strikes(0.0, 1, About::Frame, 0, *n)).count(), 0);
        assert_eq!((0..1000).filter(|n| strikes(100.0, 1, About::Frame, 0, *n)).count(), 1000);
    }
}

//! The state word of a Gaussian: its SH degree and the steps it was last moved in (`shaders/deferred.glsl`).

use models::cloud::sh_coefficients;

const DEGREE_SHIFT: u32 = 26;
const ORDINARY: u32 = 1 << 29;
/// Bits of the steps that the geometry was last moved in; those of SH lie above them.
const STATE_STEPS: u32 = 0x1FFF;

/// The state word, as the float it travels as, of a Gaussian of `degree` that was never stepped.
pub(super) fn state(degree: u8) -> f32 {
    f32::from_bits(ORDINARY | u32::from(degree & 3) << DEGREE_SHIFT)
}

pub(super) fn degree_of(state: f32) -> u8 {
    (state.to_bits() >> DEGREE_SHIFT & 3) as u8
}

pub(super) fn with_degree(state: f32, degree: u8) -> f32 {
    f32::from_bits(state.to_bits() & !(3 << DEGREE_SHIFT) | u32::from(degree & 3) << DEGREE_SHIFT)
}

/// The state word of a Gaussian that missed nothing up to step `step`.
pub(super) fn up_to(state: f32, step: u32) -> f32 {
    let step = step & STATE_STEPS;
    f32::from_bits(state.to_bits() & !(STATE_STEPS | STATE_STEPS << 13) | step | step << 13)
}

/// Degree of the highest coefficient (r, g, b each) that is not zero.
pub(super) fn degree_in_use(coefficients: &[f32]) -> u8 {
    let used = coefficients.iter().rposition(|c| *c != 0.0).map_or(0, |i| i / 3 + 1);
    (0..3).find(|d| sh_coefficients(*d) >= used).unwrap_or(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_word_is_an_ordinary_float_whatever_it_holds() {
        for degree in 0..=3 {
            for steps in [0u32, 1, 0x0FFF_FFFF & !(3 << DEGREE_SHIFT)] {
                let word = f32::from_bits(state(degree).to_bits() | steps);
                assert!(word.is_normal());
                assert_eq!(degree_of(word), degree);
                assert_eq!(degree_of(with_degree(word, 1)), 1);
                assert_eq!(with_degree(word, 2).to_bits() & steps, steps);
                let renewed = up_to(word, 0x2003);
                assert_eq!((renewed.to_bits() & 0x03FF_FFFF, degree_of(renewed)), (3 | 3 << 13, degree));
                assert!(renewed.is_normal());
            }
        }
    }

    #[test]
    fn the_degree_in_use_is_that_of_the_last_coefficient_that_is_not_zero() {
        let with = |i: usize| {
            let mut c = [0.0; 48];
            c[i] = -0.1;
            degree_in_use(&c)
        };
        assert_eq!(degree_in_use(&[0.0; 48]), 0);
        assert_eq!(
            [with(0), with(2), with(3), with(11), with(12), with(26), with(27), with(47)],
            [0, 0, 1, 1, 2, 2, 3, 3]
        );
        assert_eq!(degree_in_use(&[f32::NAN; 3]), 0);
    }
}

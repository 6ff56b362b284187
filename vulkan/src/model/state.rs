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

/// The state word with the steps missed up to `step` instead of those it was last moved in, or the other way round.
pub(super) fn turned(state: f32, step: u32) -> f32 {
    let word = state.to_bits();
    let missed = |last: u32| step.wrapping_sub(last) & STATE_STEPS;
    let fields = missed(word) | missed(word >> 13) << 13;
    f32::from_bits(word & !(STATE_STEPS | STATE_STEPS << 13) | fields)
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
    fn what_is_away_keeps_what_it_missed_and_misses_no_more() {
        let word = with_degree(up_to(state(0), 0), 2);
        // Moved in step 8,190 and, its SH, in 8,187; paged out after 8,200, paged in after 20,000.
        let word = f32::from_bits(word.to_bits() | 8190 | 8187 << 13);
        let away = turned(word, 8200);
        assert!(away.is_normal());
        assert_eq!((away.to_bits() & STATE_STEPS, away.to_bits() >> 13 & STATE_STEPS, degree_of(away)), (10, 13, 2));
        let back = turned(away, 20_000).to_bits();
        assert_eq!((back & STATE_STEPS, back >> 13 & STATE_STEPS), (19_990 & STATE_STEPS, 19_987 & STATE_STEPS));
        assert_eq!(turned(turned(word, 777), 777).to_bits(), word.to_bits());
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

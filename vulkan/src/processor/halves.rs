//! Numbers of 16 bits, without branches, so that a compiler makes vectors of them. Nothing here is infinite or not a number.

/// As f32, exactly.
#[inline(always)]
pub(super) fn widen(half: u16) -> f32 {
    // The exponent's bias is changed by a product, which is right for numbers below the least normal one, too.
    let size = f32::from_bits(u32::from(half & 0x7FFF) << 13) * f32::from_bits((254 - 15) << 23);
    f32::from_bits(size.to_bits() | u32::from(half & 0x8000) << 16)
}

/// The nearest number of 16 bits, of two the even one; the argument is at most 65,504.
#[inline(always)]
pub(super) fn narrow(v: f32) -> u16 {
    let bits = v.to_bits();
    let (sign, size) = (bits >> 16 & 0x8000, bits & 0x7FFF_FFFF);
    // Below the least normal number (2⁻¹⁴) a sum with 2⁻¹ rounds to whole units of 2⁻²⁴.
    let few = (f32::from_bits(size) + 0.5).to_bits().wrapping_sub(0.5f32.to_bits());
    let many =
        size.wrapping_add((15u32.wrapping_sub(127) << 23).wrapping_add(0xFFF)).wrapping_add(size >> 13 & 1) >> 13;
    (sign | if size < (113 << 23) { few } else { many }) as u16
}

#[cfg(test)]
mod tests {
    use super::*;
    use half::f16;

    #[test]
    fn every_half_is_widened_exactly_and_comes_back() {
        for bits in (0..=u16::MAX).filter(|b| f16::from_bits(*b).is_finite()) {
            let wide = widen(bits);
            assert_eq!(wide.to_bits(), f16::from_bits(bits).to_f32().to_bits());
            assert_eq!(narrow(wide), bits);
        }
    }

    #[test]
    fn what_lies_between_two_halves_becomes_the_nearest_of_two_the_even_one() {
        let mut bits = 0u32;
        // Steps that no power of two divides, from zero to the largest half.
        while f32::from_bits(bits) <= 65504.0 {
            for v in [f32::from_bits(bits), -f32::from_bits(bits)] {
                assert_eq!(narrow(v), f16::from_f32(v).to_bits(), "{v:e}");
            }
            bits += 0x1001 - (bits & 1);
        }
    }
}

//! Integer hashing and value noise: the only source of randomness in the world, so that a seed means the same
//! picture on every machine and for every order of evaluation (rayon may visit pixels in any order).

/// A well-mixed 32-bit hash of three integers (the finaliser of MurmurHash3 over a linear combination).
#[inline]
pub fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h =
        (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77) ^ seed.wrapping_mul(0xC2B2_AE3D);
    h ^= h >> 16;
    h = h.wrapping_mul(0x85EB_CA6B);
    h ^= h >> 13;
    h = h.wrapping_mul(0xC2B2_AE35);
    h ^ (h >> 16)
}

/// The hash as a number in 0..1.
#[inline]
pub fn unit(h: u32) -> f32 {
    (h >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// A second, independent number in 0..1 out of the same hash.
#[inline]
pub fn unit2(h: u32) -> f32 {
    unit(h.wrapping_mul(0x2C1B_3C6D) ^ 0x5BD1_E995)
}

/// Floor as an integer. `f64::floor` is a library call on x86-64's base instruction set; this is two instructions.
#[inline]
pub fn floor(x: f64) -> i32 {
    let i = x as i32;
    i - i32::from(x < f64::from(i))
}

/// A smooth wave of period 1 between −1 and 1: a parabola per half period, a fraction of the cost of a sine.
#[inline]
pub fn wave(x: f64) -> f64 {
    let h = 2.0 * (x - f64::from(floor(x)));
    if h < 1.0 { 4.0 * h * (1.0 - h) } else { -4.0 * (h - 1.0) * (2.0 - h) }
}

/// Value noise of wavelength 1, in −1..1, with a continuous first derivative.
#[inline]
pub fn noise(x: f64, y: f64, seed: u32) -> f32 {
    let (ix, iy) = (floor(x), floor(y));
    let (u, v) = ((x - f64::from(ix)) as f32, (y - f64::from(iy)) as f32);
    let (u, v) = (u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v));
    let at = |dx: i32, dy: i32| unit(hash(ix.wrapping_add(dx), iy.wrapping_add(dy), seed));
    let low = at(0, 0) * (1.0 - u) + at(1, 0) * u;
    let high = at(0, 1) * (1.0 - u) + at(1, 1) * u;
    2.0 * (low * (1.0 - v) + high * v) - 1.0
}

/// A sum of noises, each octave faded out before its wavelength falls below two samples of `footprint_m`
/// (Nyquist), so that a distant surface becomes smooth instead of noisy.
///
/// `octaves`: wavelength in metres and amplitude.
#[inline]
pub fn octaves(x: f64, y: f64, footprint_m: f32, octaves: &[(f32, f32)], seed: u32) -> f32 {
    let mut sum = 0.0;
    for (i, &(wavelength, amplitude)) in octaves.iter().enumerate() {
        let fade = fade(wavelength, footprint_m);
        if fade > 0.0 {
            let s = 1.0 / f64::from(wavelength);
            sum += amplitude * fade * noise(x * s, y * s, seed.wrapping_add((i as u32).wrapping_mul(0x68E3_1DA4)));
        }
    }
    sum
}

/// 1 while a feature of `size_m` is well resolved by samples `footprint_m` apart, 0 once it is below them.
#[inline]
pub fn fade(size_m: f32, footprint_m: f32) -> f32 {
    (size_m / footprint_m.max(1e-6) - 1.0).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_bounded_and_balanced() {
        let (mut sum, mut last) = (0.0f64, noise(0.0, 0.3, 7));
        for i in 1..20_000 {
            let n = noise(f64::from(i) * 0.01, 0.3 + f64::from(i) * 0.003, 7);
            assert!((-1.0..=1.0).contains(&n) && (n - last).abs() < 0.06, "{i}: {n} after {last}");
            (sum, last) = (sum + f64::from(n), n);
        }
        assert!((sum / 20_000.0).abs() < 0.1, "{sum}");
    }

    #[test]
    fn unresolved_octaves_vanish() {
        assert_eq!(octaves(3.3, 4.4, 0.2, &[(0.2, 1.0)], 1), 0.0);
        assert_ne!(octaves(3.3, 4.4, 0.05, &[(0.2, 1.0)], 1), 0.0);
    }
}

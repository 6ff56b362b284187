//! Eight lanes of f32: as many as a tile is wide. A level without registers of that size computes them in parts, with the same bits:
//! sums of products are always fused, and no result depends on how many lanes the processor has.

use fearless_simd::prelude::*;
use fearless_simd::{f32x8, i32x8, u32x8};

/// Lanes of [`F8`].
pub(super) const LANES: usize = 8;

/// Eight numbers.
pub(super) type F8<S> = f32x8<S>;

/// One number in all lanes.
#[inline(always)]
pub(super) fn splat<S: Simd>(s: S, v: f32) -> F8<S> {
    F8::splat(s, v)
}

/// a b + c, rounded once.
#[inline(always)]
pub(super) fn fma<S: Simd>(a: F8<S>, b: F8<S>, c: F8<S>) -> F8<S> {
    a.mul_add_precise(b, c)
}

/// 0, 1, … 7.
#[inline(always)]
pub(super) fn ramp<S: Simd>(s: S) -> F8<S> {
    F8::from_slice(s, &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
}

/// Up to eight numbers from the beginning of `from`, zeros beyond.
#[inline(always)]
pub(super) fn load<S: Simd>(s: S, from: &[f32]) -> F8<S> {
    match from.first_chunk::<LANES>() {
        Some(whole) => F8::from_slice(s, whole),
        None => {
            let mut some = [0.0; LANES];
            some[..from.len()].copy_from_slice(from);
            F8::from_slice(s, &some)
        }
    }
}

/// As many of eight numbers as `to` has room for.
#[inline(always)]
pub(super) fn store<S: Simd>(v: F8<S>, to: &mut [f32]) {
    match to.first_chunk_mut::<LANES>() {
        Some(whole) => v.store_slice(whole),
        None => {
            let mut all = [0.0; LANES];
            v.store_slice(&mut all);
            to.copy_from_slice(&all[..to.len()]);
        }
    }
}

/// The sum in the order of the lanes.
#[inline(always)]
pub(super) fn sum<S: Simd>(v: F8<S>) -> f32 {
    let mut all = [0.0; LANES];
    v.store_slice(&mut all);
    all.iter().sum()
}

/// Least and greatest exponent of [`exp2`]; the result is a normal number.
pub(super) const EXPONENTS: [f32; 2] = [-126.0, 127.0];

/// 2ˣ for x in [-126, 127], of the nearest bound beyond; within two units in the last place (a test). The polynomial is Cephes' `exp2f`
/// (Moshier 1989), on [-½, ½].
#[inline(always)]
pub(super) fn exp2<S: Simd>(x: F8<S>) -> F8<S> {
    let s = x.token();
    let x = x.max(splat(s, EXPONENTS[0])).min(splat(s, EXPONENTS[1]));
    let whole = x.round_ties_even();
    let rest = x - whole;
    let mut p = splat(s, 1.535_336_2e-4);
    for c in [1.339_887_4e-3, 9.618_437e-3, 5.550_332_5e-2, 2.402_264_7e-1, 6.931_472e-1, 1.0] {
        p = fma(p, rest, splat(s, c));
    }
    let exponent: i32x8<S> = whole.to_int();
    let bits: u32x8<S> = ((exponent + 127) << 23).bitcast();
    p * F8::from_bits(bits)
}

/// eˣ, by [`exp2`].
#[inline(always)]
pub(super) fn exp<S: Simd>(x: F8<S>) -> F8<S> {
    exp2(x * std::f32::consts::LOG2_E)
}

/// The logistic function.
#[inline(always)]
pub(super) fn sigmoid<S: Simd>(x: F8<S>) -> F8<S> {
    let one = splat(x.token(), 1.0);
    one / (one + exp(-x))
}

/// log₂ x for normal x > 0, within 1e-6 of 1 + |log₂ x| (a test); of others any number. The polynomial is Cephes' `logf` (Moshier 1989),
/// on [√½, √2].
#[inline(always)]
pub(super) fn log2<S: Simd>(x: F8<S>) -> F8<S> {
    const ONE: i32 = 127 << 23;
    let s = x.token();
    let (one, root) = (splat(s, 1.0), splat(s, std::f32::consts::SQRT_2));
    let bits: i32x8<S> = x.bitcast();
    let high: F8<S> = ((bits & 0x7F_FFFF) | ONE).bitcast();
    let exponent: F8<S> = ((bits >> 23) - 127).to_float();
    let above = high.simd_gt(root);
    let m = above.select(high * 0.5, high) - one;
    let exponent = exponent + above.select(one, splat(s, 0.0));
    let mut p = splat(s, 7.037_683_6e-2);
    for c in [
        -1.151_461e-1,
        1.167_699_9e-1,
        -1.242_014_1e-1,
        1.424_932_3e-1,
        -1.666_805_7e-1,
        2.000_071_5e-1,
        -2.499_999_4e-1,
        3.333_333e-1,
    ] {
        p = fma(p, m, splat(s, c));
    }
    let square = m * m;
    let natural = fma(p * m, square, fma(splat(s, -0.5), square, m));
    fma(natural, splat(s, std::f32::consts::LOG2_E), exponent)
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::{Level, dispatch};

    #[inline(always)]
    fn exp2_of<S: Simd>(s: S, x: f32) -> f32 {
        let mut all = [0.0; LANES];
        exp2(splat(s, x)).store_slice(&mut all);
        all[0]
    }

    #[test]
    fn a_power_of_two_is_within_two_units_in_the_last_place_and_bounded_beyond() {
        let level = Level::new();
        let mut worst = 0.0f64;
        for i in -126_000..127_000 {
            let x = i as f32 / 1000.0;
            let (found, exact) = (dispatch!(level, s => exp2_of(s, x)), f64::from(x).exp2());
            worst = worst.max(((f64::from(found) - exact) / exact).abs());
        }
        assert!(worst < 2.0 * f64::from(f32::EPSILON), "{worst:e}");
        for (x, bound) in [(-1.0e30, -126.0f32), (f32::NEG_INFINITY, -126.0), (1.0e30, 127.0), (f32::INFINITY, 127.0)] {
            assert_eq!(dispatch!(level, s => exp2_of(s, x)), bound.exp2(), "{x}");
        }
    }

    #[test]
    fn a_logarithm_is_within_a_millionth_over_all_normal_numbers() {
        #[inline(always)]
        fn log2_of<S: Simd>(s: S, x: f32) -> f32 {
            let mut all = [0.0; LANES];
            log2(splat(s, x)).store_slice(&mut all);
            all[0]
        }
        let level = Level::new();
        for i in -126_000..127_000 {
            let x = (i as f32 / 1000.0).exp2();
            let (found, exact) = (f64::from(dispatch!(level, s => log2_of(s, x))), f64::from(x).log2());
            assert!((found - exact).abs() < 1e-6 * (1.0 + exact.abs()), "{x}: {found} instead of {exact}");
        }
    }

    #[test]
    fn what_does_not_fill_a_vector_is_loaded_with_zeros_and_stored_without_them() {
        #[inline(always)]
        fn there_and_back<S: Simd>(s: S, from: &[f32], to: &mut [f32]) -> f32 {
            let v = load(s, from);
            store(v, to);
            sum(v)
        }
        for n in 0..=9 {
            let from: Vec<f32> = (1..=n).map(|i| i as f32).collect();
            let mut to = vec![0.0; n];
            let sum = dispatch!(Level::new(), s => there_and_back(s, &from, &mut to));
            let held = n.min(LANES);
            assert_eq!((&to[..held], sum), (&from[..held], from[..held].iter().sum()));
        }
    }
}

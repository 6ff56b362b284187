//! Pearson's correlation of rendered and estimated depth under a confidence mask; and its gradient.
//!
//! ρ = Cov(D, E) / √(Var D · Var E) over the pixels whose confidence reaches the threshold. Insensitive to any positive
//! affine change of either map, which is why an uncalibrated prior may be used (paper, L_reg).

use crate::constants::PEARSON_EPSILON;
use crate::reference::real::Real;

/// ρ and its gradient to `depth`; `prior` is scaled to 0…1. With fewer than three usable pixels or a constant map
/// (variance below 1e-6 of the mean's square, or of 1 for the prior) ρ is 0 and so is the gradient.
pub fn pearson<R: Real>(depth: &[R], prior: &[R], confidence: &[R], threshold: R) -> (R, Vec<R>) {
    let usable = |i: &usize| confidence[*i] > R::ZERO && confidence[*i] >= threshold && prior[*i].is_finite();
    let used: Vec<usize> = (0..depth.len()).filter(usable).collect();
    let none = (R::ZERO, vec![R::ZERO; depth.len()]);
    if used.len() < 3 {
        return none;
    }
    let n = R::of(used.len() as f64);
    let mean = |v: &[R]| -> R { used.iter().map(|i| v[*i]).sum::<R>() / n };
    let (md, me) = (mean(depth), mean(prior));
    let moment = |a: &[R], ma: R, b: &[R], mb: R| -> R { used.iter().map(|i| (a[*i] - ma) * (b[*i] - mb)).sum() };
    let (dd, ee, de) = (moment(depth, md, depth, md), moment(prior, me, prior, me), moment(depth, md, prior, me));
    let epsilon = R::of(PEARSON_EPSILON.into());
    // Written so that NaN is not useful.
    if !(dd > epsilon * (n * md * md + R::of(1e-12)) && ee > epsilon * n && dd.is_finite() && ee.is_finite()) {
        return none;
    }
    let both = R::ONE / (dd.sqrt() * ee.sqrt());
    let rho = de * both;
    let mut gradient = none.1;
    for i in used {
        // dρ/dDᵢ = (Eᵢ − Ē)/√(ΣdΣe) − ρ (Dᵢ − D̄)/Σd
        gradient[i] = both * (prior[i] - me) - rho * (depth[i] - md) / dd;
    }
    (rho, gradient)
}

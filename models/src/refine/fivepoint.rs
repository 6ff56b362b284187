//! Relative poses of two calibrated views from five matches, with no idea of either beforehand (Nistér 2004; solved by the action
//! matrix of Stewénius, Engels, Nistér 2006).

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{DMatrix, SMatrix, SVector};

use super::twoview::{RayPair, RelativePose};

/// Coefficients of a polynomial in x, y, z up to degree three, in the order of [`EXPONENTS`].
type Poly = [f64; 20];

/// Monomials: ten of degree three, then those that span the quotient ring.
const EXPONENTS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [2, 1, 0],
    [1, 2, 0],
    [0, 3, 0],
    [2, 0, 1],
    [1, 1, 1],
    [0, 2, 1],
    [1, 0, 2],
    [0, 1, 2],
    [0, 0, 3],
    [2, 0, 0],
    [1, 1, 0],
    [0, 2, 0],
    [1, 0, 1],
    [0, 1, 1],
    [0, 0, 2],
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
    [0, 0, 0],
];
/// Of x times the monomials 10 to 19: the place of the product.
const TIMES_X: [usize; 10] = [0, 1, 2, 4, 5, 7, 10, 11, 13, 16];
/// Imaginary parts of an eigenvalue below this are rounding.
const REAL: f64 = 1e-6;

/// Where the product of two monomials stands; `None` beyond degree three.
const fn place(a: [u8; 3], b: [u8; 3]) -> Option<usize> {
    let mut k = 0;
    while k < 20 {
        let e = EXPONENTS[k];
        if e[0] == a[0] + b[0] && e[1] == a[1] + b[1] && e[2] == a[2] + b[2] {
            return Some(k);
        }
        k += 1;
    }
    None
}

/// [`place`] of all pairs; 20 stands for none.
const PRODUCTS: [[u8; 20]; 20] = {
    let mut table = [[20u8; 20]; 20];
    let mut a = 0;
    while a < 20 {
        let mut b = 0;
        while b < 20 {
            if let Some(k) = place(EXPONENTS[a], EXPONENTS[b]) {
                table[a][b] = k as u8;
            }
            b += 1;
        }
        a += 1;
    }
    table
};

fn times(a: &Poly, b: &Poly) -> Poly {
    let mut out = [0.0; 20];
    for (i, x) in a.iter().enumerate().filter(|(_, x)| **x != 0.0) {
        for (j, y) in b.iter().enumerate().filter(|(_, y)| **y != 0.0) {
            if let Some(o) = out.get_mut(usize::from(PRODUCTS[i][j])) {
                *o += x * y;
            }
        }
    }
    out
}

fn plus(a: &Poly, b: &Poly, factor: f64) -> Poly {
    std::array::from_fn(|k| a[k] + factor * b[k])
}

/// All relative poses that explain five matches exactly: for each essential matrix the one that has most of the five in front of both
/// cameras. None of matches in a degenerate position.
pub(crate) fn solve(sample: &[RayPair; 5]) -> Vec<RelativePose> {
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for m in sample {
        let (a, b) = (m.a.to_array(), m.b.to_array());
        // bᵀ E a = 0, E row-major.
        let row = SVector::<f64, 9>::from_fn(|k, _| b[k / 3] * a[k % 3]);
        normal += row * row.transpose();
    }
    let eigen = normal.symmetric_eigen();
    let mut order: [usize; 9] = std::array::from_fn(|k| k);
    order.sort_by(|x, y| eigen.eigenvalues[*x].total_cmp(&eigen.eigenvalues[*y]));
    // E = x·X + y·Y + z·Z + W.
    let entry = |k: usize| -> Poly {
        let mut p = [0.0; 20];
        for (monomial, vector) in [16, 17, 18, 19].into_iter().zip(order) {
            p[monomial] = eigen.eigenvectors[(k, vector)];
        }
        p
    };
    let e: [Poly; 9] = std::array::from_fn(entry);
    // E·Eᵀ, and half its trace.
    let mut square = [[0.0; 20]; 9];
    for i in 0..3 {
        for j in 0..3 {
            for k in 0..3 {
                square[3 * i + j] = plus(&square[3 * i + j], &times(&e[3 * i + k], &e[3 * j + k]), 1.0);
            }
        }
    }
    let half: Poly = std::array::from_fn(|k| 0.5 * (square[0][k] + square[4][k] + square[8][k]));
    for i in [0, 4, 8] {
        square[i] = plus(&square[i], &half, -1.0);
    }
    let mut rows: Vec<Poly> = Vec::with_capacity(10);
    for i in 0..3 {
        for j in 0..3 {
            let mut row = [0.0; 20];
            for k in 0..3 {
                row = plus(&row, &times(&square[3 * i + k], &e[3 * k + j]), 1.0);
            }
            rows.push(row);
        }
    }
    let minor = |a: usize, b: usize, c: usize, d: usize| plus(&times(&e[a], &e[d]), &times(&e[b], &e[c]), -1.0);
    let mut determinant = times(&e[0], &minor(4, 5, 7, 8));
    determinant = plus(&determinant, &times(&e[1], &minor(3, 5, 6, 8)), -1.0);
    rows.push(plus(&determinant, &times(&e[2], &minor(3, 4, 6, 7)), 1.0));
    let left = SMatrix::<f64, 10, 10>::from_fn(|r, c| rows[r][c]);
    let right = SMatrix::<f64, 10, 10>::from_fn(|r, c| rows[r][10 + c]);
    let Some(reduced) = left.lu().solve(&right) else { return Vec::new() };
    let action = SMatrix::<f64, 10, 10>::from_fn(|r, c| match TIMES_X[r] {
        cubic @ 0..10 => -reduced[(cubic, c)],
        lower => f64::from(u8::from(lower - 10 == c)),
    });
    if !action.iter().all(|x| x.is_finite()) {
        return Vec::new();
    }
    let dynamic = DMatrix::from_iterator(10, 10, action.iter().copied());
    let Some(schur) = nalgebra::linalg::Schur::try_new(dynamic, 1e-12, 200) else { return Vec::new() };
    let mut found = Vec::new();
    for value in schur.complex_eigenvalues().iter() {
        if value.im.abs() > REAL * (1.0 + value.re.abs()) {
            continue;
        }
        // Inverse iteration from a little beside the eigenvalue.
        let shifted = action - SMatrix::<f64, 10, 10>::identity() * (value.re + 1e-9 * (1.0 + value.re.abs()));
        let lu = shifted.lu();
        let mut v = SVector::<f64, 10>::repeat(1.0);
        let mut good = true;
        for _ in 0..2 {
            match lu.solve(&v) {
                Some(next) if next.norm().is_finite() && next.norm() > 0.0 => v = next / next.norm(),
                _ => good = false,
            }
        }
        if !good || v[9].abs() < 1e-12 {
            continue;
        }
        let (x, y, z) = (v[6] / v[9], v[7] / v[9], v[8] / v[9]);
        let at: [f64; 9] = std::array::from_fn(|k| x * e[k][16] + y * e[k][17] + z * e[k][18] + e[k][19]);
        found.extend(pose_of(&at, sample));
    }
    found
}

/// Of the four poses of an essential matrix (row-major) the one that has most of the matches in front.
fn pose_of(essential: &[f64; 9], sample: &[RayPair; 5]) -> Option<RelativePose> {
    let svd = SMatrix::<f64, 3, 3>::from_row_slice(essential).svd(true, true);
    let (u, vt) = (svd.u?, svd.v_t?);
    let turn = SMatrix::<f64, 3, 3>::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let least = svd.singular_values.imin();
    // The null direction must be the last column.
    let order = match least {
        0 => [1, 2, 0],
        1 => [0, 2, 1],
        _ => [0, 1, 2],
    };
    let u = SMatrix::<f64, 3, 3>::from_fn(|r, c| u[(r, order[c])]);
    let vt = SMatrix::<f64, 3, 3>::from_fn(|r, c| vt[(order[r], c)]);
    let translation = DVec3::new(u[(0, 2)], u[(1, 2)], u[(2, 2)]);
    let mut best: Option<(usize, RelativePose)> = None;
    for w in [turn, turn.transpose()] {
        let mut r = u * w * vt;
        if r.determinant() < 0.0 {
            r = -r;
        }
        let rotation = DQuat::from_mat3(&DMat3::from_cols_slice(r.as_slice())).normalize();
        for translation in [translation, -translation] {
            let pose = RelativePose { rotation, translation };
            let front = sample.iter().filter(|m| pose.in_front(m)).count();
            if pose.rotation.is_finite() && best.as_ref().is_none_or(|(most, _)| front > *most) {
                best = Some((front, pose));
            }
        }
    }
    best.map(|(_, pose)| pose)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use rand::{Rng, SeedableRng};

    use super::*;

    #[test]
    fn five_exact_matches_give_the_pose_they_were_made_with_however_far_the_views_are_turned() {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(3);
        let mut at = |size: f64| DVec3::from_array(std::array::from_fn(|_| rng.random_range(-size..size)));
        let mut found = 0;
        for k in 0..100 {
            let truth = RelativePose { rotation: DQuat::from_scaled_axis(at(1.0)), translation: at(1.0).normalize() };
            // Every other scene is flat.
            let sample: [RayPair; 5] = std::array::from_fn(|_| {
                loop {
                    let p = at(2.0) * DVec3::new(1.0, 1.0, if k % 2 == 0 { 1.0 } else { 0.0 }) + DVec3::Z * 6.0;
                    let q = truth.rotation * p + truth.translation;
                    if q.z > 0.5 {
                        break RayPair { a: p / p.z, b: q / q.z };
                    }
                }
            });
            let near = |p: &RelativePose| {
                p.rotation.angle_between(truth.rotation) < 1e-4 && p.translation.distance(truth.translation) < 1e-3
            };
            found += usize::from(solve(&sample).iter().any(near));
        }
        assert!(found >= 97, "{found} of 100");
    }
}

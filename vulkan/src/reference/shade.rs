//! Stage *shade*: real spherical harmonics up to degree 3 with 3DGS's signs and order, and their gradient to the direction.

use super::real::{Real, Vec3, dot};
use crate::constants::COLOUR_MAX;

const C0: f64 = 0.282_094_791_773_878_14;
const C1: f64 = 0.488_602_511_902_919_9;
const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_7,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_7,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// Value of the 16 basis functions at the unit vector `d`; those above `degree` are 0.
pub fn basis<R: Real>(degree: u8, d: Vec3<R>) -> [R; 16] {
    let [x, y, z] = d;
    let c = R::of;
    let mut b = [R::ZERO; 16];
    b[0] = c(C0);
    if degree >= 1 {
        b[1] = -c(C1) * y;
        b[2] = c(C1) * z;
        b[3] = -c(C1) * x;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        b[4] = c(C2[0]) * x * y;
        b[5] = c(C2[1]) * y * z;
        b[6] = c(C2[2]) * (zz + zz - xx - yy);
        b[7] = c(C2[3]) * x * z;
        b[8] = c(C2[4]) * (xx - yy);
    }
    if degree >= 3 {
        let (three, four) = (c(3.0), c(4.0));
        b[9] = c(C3[0]) * y * (three * xx - yy);
        b[10] = c(C3[1]) * x * y * z;
        b[11] = c(C3[2]) * y * (four * zz - xx - yy);
        b[12] = c(C3[3]) * z * (zz + zz - three * xx - three * yy);
        b[13] = c(C3[4]) * x * (four * zz - xx - yy);
        b[14] = c(C3[5]) * z * (xx - yy);
        b[15] = c(C3[6]) * x * (xx - three * yy);
    }
    b
}

/// Σ wₖ ∇bₖ: gradient to the (unit) direction when basis function k weighs `w[k]`.
pub fn basis_gradient<R: Real>(degree: u8, d: Vec3<R>, w: &[R; 16]) -> Vec3<R> {
    let [x, y, z] = d;
    let c = R::of;
    let mut g = [R::ZERO; 3];
    if degree >= 1 {
        g[0] -= c(C1) * w[3];
        g[1] -= c(C1) * w[1];
        g[2] += c(C1) * w[2];
    }
    if degree >= 2 {
        let two = c(2.0);
        g[0] += c(C2[0]) * y * w[4] - two * c(C2[2]) * x * w[6] + c(C2[3]) * z * w[7] + two * c(C2[4]) * x * w[8];
        g[1] += c(C2[0]) * x * w[4] + c(C2[1]) * z * w[5] - two * c(C2[2]) * y * w[6] - two * c(C2[4]) * y * w[8];
        g[2] += c(C2[1]) * y * w[5] + c(4.0) * c(C2[2]) * z * w[6] + c(C2[3]) * x * w[7];
    }
    if degree >= 3 {
        let (two, three, four, six, eight) = (c(2.0), c(3.0), c(4.0), c(6.0), c(8.0));
        let (xx, yy, zz) = (x * x, y * y, z * z);
        g[0] += c(C3[0]) * six * x * y * w[9] + c(C3[1]) * y * z * w[10]
            - c(C3[2]) * two * x * y * w[11]
            - c(C3[3]) * six * x * z * w[12]
            + c(C3[4]) * (four * zz - three * xx - yy) * w[13]
            + c(C3[5]) * two * x * z * w[14]
            + c(C3[6]) * three * (xx - yy) * w[15];
        g[1] += c(C3[0]) * three * (xx - yy) * w[9]
            + c(C3[1]) * x * z * w[10]
            + c(C3[2]) * (four * zz - xx - three * yy) * w[11]
            - c(C3[3]) * six * y * z * w[12]
            - c(C3[4]) * two * x * y * w[13]
            - c(C3[5]) * two * y * z * w[14]
            - c(C3[6]) * six * x * y * w[15];
        g[2] += c(C3[1]) * x * y * w[10]
            + c(C3[2]) * eight * y * z * w[11]
            + c(C3[3]) * (six * zz - three * xx - three * yy) * w[12]
            + c(C3[4]) * eight * x * z * w[13]
            + c(C3[5]) * (xx - yy) * w[14];
    }
    g
}

/// Colour `0.5 + Σ shₖ bₖ`, cut off below zero (3DGS) and above [`COLOUR_MAX`].
pub fn shade<R: Real>(degree: u8, d: Vec3<R>, sh: &[[R; 3]; 16]) -> Vec3<R> {
    let b = basis(degree, d);
    std::array::from_fn(|c| {
        let sum: R = (0..16).map(|k| b[k] * sh[k][c]).sum();
        (sum + R::of(0.5)).max(R::ZERO).min(R::of(COLOUR_MAX.into()))
    })
}

/// Gradients of [`shade`] to the coefficients and to the *unnormalised* direction `v` of which `d = v/‖v‖`.
pub fn shade_backward<R: Real>(degree: u8, v: Vec3<R>, sh: &[[R; 3]; 16], g: Vec3<R>) -> ([[R; 3]; 16], Vec3<R>) {
    let norm = dot(v, v).sqrt();
    let d = v.map(|k| k / norm);
    let lit = shade(degree, d, sh);
    // The cut-offs pass no gradient.
    let inside = |v: R| v > R::ZERO && v < R::of(COLOUR_MAX.into());
    let g: Vec3<R> = std::array::from_fn(|c| if inside(lit[c]) { g[c] } else { R::ZERO });
    let b = basis(degree, d);
    let to_sh = std::array::from_fn(|k| std::array::from_fn(|c| b[k] * g[c]));
    let w = std::array::from_fn(|k| dot(sh[k], g));
    let to_d = basis_gradient(degree, d, &w);
    let along = dot(to_d, d);
    (to_sh, std::array::from_fn(|k| (to_d[k] - along * d[k]) / norm))
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_basis_is_the_one_that_models_are_stored_in() {
        for at in [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [-0.48, 0.64, 0.6], [0.36, -0.48, -0.8]] {
            let (reference, stored) = (super::basis::<f64>(3, at), models::cloud::sh_basis(at));
            assert!(reference[1..].iter().zip(stored).all(|(a, b)| (a - b).abs() < 1e-12), "{reference:?} {stored:?}");
        }
    }
}

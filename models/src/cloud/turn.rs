//! What a rotation of the world does to spherical harmonics: the colour a Gaussian shows in a direction goes with it.

use glam::{DQuat, DVec3};

use super::{sh_basis, sh_coefficients};

/// Directions and weights of Lebedev's rule of 26 points, exact for products of two functions up to degree 3
/// (Lebedev 1975: 6 axes, 12 edges and 8 corners of a cube, degree 7).
const AXIS: f64 = 1.0 / 21.0;
const EDGE: f64 = 4.0 / 105.0;
const CORNER: f64 = 9.0 / 280.0;

/// A rotation, as it acts on the coefficients above degree 0. Bands do not mix.
#[derive(Clone, Debug)]
pub struct ShTurn {
    /// `[new][old]`, degree 1 to 3 one after the other; zero between bands.
    matrix: Box<[[f64; 15]; 15]>,
}

/// First and one past the last coefficient of the band that holds coefficient `i` (0 = the first of degree 1).
fn band(i: usize) -> (usize, usize) {
    match i {
        0..3 => (0, 3),
        3..8 => (3, 8),
        _ => (8, 15),
    }
}

impl ShTurn {
    /// Of a world that is turned by `rotation`.
    pub fn new(rotation: DQuat) -> Self {
        let back = rotation.conjugate();
        let mut matrix = Box::new([[0.0; 15]; 15]);
        for v in 0..27 {
            let d = DVec3::new(f64::from(v % 3 - 1), f64::from(v / 3 % 3 - 1), f64::from(v / 9 - 1));
            let weight = match d.length_squared() as u8 {
                1 => AXIS,
                2 => EDGE,
                3 => CORNER,
                _ => continue,
            };
            let d = d.normalize();
            // The turned function shows towards d what it showed towards R⁻¹d; the basis is orthonormal.
            let (new, old) = (sh_basis(d.to_array()), sh_basis((back * d).to_array()));
            for (i, row) in matrix.iter_mut().enumerate() {
                let (from, to) = band(i);
                for j in from..to {
                    row[j] += 4.0 * std::f64::consts::PI * weight * new[i] * old[j];
                }
            }
        }
        Self { matrix }
    }

    /// Turns the coefficients of one Gaussian: D × 3 floats, as [`super::GaussianCloud::sh`] has them.
    pub fn apply(&self, degree: u8, sh: &mut [f32]) {
        let n = sh_coefficients(degree) - 1;
        let mut old = [[0.0f64; 3]; 15];
        for (to, from) in old.iter_mut().zip(sh[3..].as_chunks::<3>().0) {
            *to = from.map(f64::from);
        }
        for i in 0..n {
            let (from, to) = band(i);
            for channel in 0..3 {
                let turned: f64 = (from..to).map(|j| self.matrix[i][j] * old[j][channel]).sum();
                sh[3 * (i + 1) + channel] = turned as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(sh: &[f32], d: DVec3) -> f64 {
        sh_basis(d.to_array()).iter().enumerate().map(|(i, y)| y * f64::from(sh[3 * (i + 1)])).sum()
    }

    #[test]
    fn a_turned_gaussian_shows_the_same_colours_in_turned_directions() {
        for (k, rotation) in
            [DQuat::IDENTITY, DQuat::from_rotation_z(0.9), DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -1.0, 2.0)]
                .into_iter()
                .enumerate()
        {
            let sh: Vec<f32> = (0..48).map(|i| ((i * 7 + k) as f32 * 0.37).sin()).collect();
            let mut turned = sh.clone();
            ShTurn::new(rotation).apply(3, &mut turned);
            assert_eq!(sh[..3], turned[..3], "the constant part stays");
            for v in 0..40 {
                let t = f64::from(v);
                let d = DVec3::new((t * 1.3).sin(), (t * 0.7).cos(), (t * 2.1).sin() + 0.1).normalize();
                let (before, after) = (shown(&sh, d), shown(&turned, rotation * d));
                assert!((before - after).abs() < 1e-5, "{rotation}: {before} {after}");
            }
        }
    }

    #[test]
    fn lower_degrees_turn_without_the_bands_they_do_not_have() {
        let mut constant = [0.4f32, 0.5, 0.6];
        ShTurn::new(DQuat::from_rotation_x(1.0)).apply(0, &mut constant);
        assert_eq!(constant, [0.4, 0.5, 0.6]);
        let (mut one, mut three) = (vec![0.0f32; 12], vec![0.0f32; 48]);
        one.iter_mut().zip(&mut three).enumerate().for_each(|(i, (a, b))| {
            *a = i as f32;
            *b = i as f32;
        });
        let turn = ShTurn::new(DQuat::from_rotation_y(0.4));
        turn.apply(1, &mut one);
        turn.apply(3, &mut three);
        assert_eq!(one[..], three[..12]);
    }
}

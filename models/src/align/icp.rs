//! Iterative closest point with scale, from the original Gaussians to the aligned ones: its scale is sᵍ, by which the
//! covariances grow. Point-to-point: the originals are the aligned points' own, so that every point has its counterpart.

use glam::{DQuat, DVec3, Vec3};

use super::nearest::KdTree;
use super::similarity::{Similarity, Undetermined, umeyama};

/// What ICP found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IcpResult {
    /// From source to target.
    pub similarity: Similarity,
    /// Root mean square distance of the pairs within the gate.
    pub rms: f64,
    /// Iterations used.
    pub steps: usize,
}

/// Most iterations.
const STEPS: usize = 60;
/// Converged when scale and shift change by less than this share.
const TOLERANCE: f64 = 1e-7;
/// Pairs further apart than this many medians are outliers.
const GATE: f64 = 3.0;
/// Aligns `source` to `target`, starting from equal centres and spreads.
///
/// # Errors
/// The points do not determine a similarity; see [`Undetermined`].
pub fn icp(source: &[Vec3], target: &[Vec3]) -> Result<IcpResult, Undetermined> {
    let source: Vec<DVec3> = source.iter().filter(|p| p.is_finite()).map(|p| p.as_dvec3()).collect();
    let target: Vec<Vec3> = target.iter().copied().filter(|p| p.is_finite()).collect();
    if source.len().min(target.len()) < 3 {
        return Err(Undetermined::TooFew(source.len().min(target.len())));
    }
    let tree = KdTree::new(&target);
    let mut s = same_spread(&source, &target)?;
    let mut rms = f64::INFINITY;
    for step in 1..=STEPS {
        let mut pairs: Vec<(usize, usize, f64)> = Vec::with_capacity(source.len());
        for (i, p) in source.iter().enumerate() {
            let mut near = [(0.0f32, 0u32)];
            if tree.nearest(s.apply(*p).as_vec3(), None, &mut near) == 1 {
                pairs.push((i, near[0].1 as usize, f64::from(near[0].0).sqrt()));
            }
        }
        let mut distances: Vec<f64> = pairs.iter().map(|p| p.2).collect();
        if distances.len() < 3 {
            return Err(Undetermined::Diverged);
        }
        let middle = distances.len() / 2;
        let median = *distances.select_nth_unstable_by(middle, f64::total_cmp).1;
        let gate = (GATE * median).max(1e-9);
        pairs.retain(|p| p.2 <= gate);
        let from: Vec<DVec3> = pairs.iter().map(|p| s.apply(source[p.0])).collect();
        let to: Vec<DVec3> = pairs.iter().map(|p| target[p.1].as_dvec3()).collect();
        let change = umeyama(&from, &to, None)?;
        s = s.then(&change);
        rms = (pairs.iter().map(|p| p.2 * p.2).sum::<f64>() / pairs.len() as f64).sqrt();
        let size = from.iter().map(|p| p.distance(from[0])).fold(1e-12, f64::max);
        let moved = (change.apply(from[0]) - from[0]).length() / size;
        if (change.scale - 1.0).abs() < TOLERANCE && moved < TOLERANCE {
            return Ok(IcpResult { similarity: s, rms, steps: step });
        }
        if !(s.scale.is_finite() && s.scale > 0.0) {
            return Err(Undetermined::Diverged);
        }
    }
    Ok(IcpResult { similarity: s, rms, steps: STEPS })
}

/// Equal centres and equal root mean square spread.
fn same_spread(source: &[DVec3], target: &[Vec3]) -> Result<Similarity, Undetermined> {
    let spread = |points: &mut dyn Iterator<Item = DVec3>| {
        let all: Vec<DVec3> = points.collect();
        let mean = all.iter().sum::<DVec3>() / all.len() as f64;
        let rms = (all.iter().map(|p| (*p - mean).length_squared()).sum::<f64>() / all.len() as f64).sqrt();
        (mean, rms)
    };
    let (a, sa) = spread(&mut source.iter().copied());
    let (b, sb) = spread(&mut target.iter().map(|p| p.as_dvec3()));
    if !(sa > 0.0 && sb > 0.0) {
        return Err(Undetermined::Degenerate);
    }
    let scale = sb / sa;
    Ok(Similarity { scale, rotation: DQuat::IDENTITY, translation: b - a * scale })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bumpy terrain.
    fn terrain(n: usize) -> Vec<Vec3> {
        (0..n * n)
            .map(|k| {
                let (x, y) = ((k % n) as f32 / n as f32 * 10.0, (k / n) as f32 / n as f32 * 8.0);
                Vec3::new(x, y, (x * 1.3).sin() * 1.5 + (y * 0.9).cos() * 1.2 + 0.3 * x)
            })
            .collect()
    }

    #[test]
    fn the_scale_of_a_terrain_is_found() {
        let source = terrain(40);
        let truth = Similarity {
            scale: 3.0,
            rotation: DQuat::from_rotation_z(0.05) * DQuat::from_rotation_x(0.03),
            translation: DVec3::new(4.0, 1.0, -2.0),
        };
        let target: Vec<Vec3> = source.iter().map(|p| truth.apply(p.as_dvec3()).as_vec3()).collect();
        let found = icp(&source, &target).unwrap();
        assert!((found.similarity.scale / 3.0 - 1.0).abs() < 5e-3, "{found:?}");
    }

    #[test]
    fn lines_spots_and_nan_are_refused_and_a_plane_is_not() {
        let plane: Vec<Vec3> = (0..100).map(|k| Vec3::new((k % 10) as f32, (k / 10) as f32, 0.0)).collect();
        assert!(icp(&plane, &plane).is_ok());
        let line: Vec<Vec3> = (0..50).map(|k| Vec3::new(k as f32, 0.0, 0.0)).collect();
        assert_eq!(icp(&line, &line), Err(Undetermined::Degenerate));
        assert_eq!(icp(&[Vec3::ONE; 9], &[Vec3::ONE; 9]), Err(Undetermined::Degenerate));
        assert_eq!(icp(&[Vec3::NAN; 9], &plane), Err(Undetermined::TooFew(0)));
    }
}

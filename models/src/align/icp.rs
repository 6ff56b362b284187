//! Iterative closest point with scale, from the original Gaussians to the aligned ones: its scale is sᵍ, by which the
//! covariances grow. Point-to-point (Umeyama) and point-to-plane (linearised, scale as seventh unknown).

use glam::{DQuat, DVec3, Vec3};
use nalgebra::{SMatrix, SVector};

use super::nearest::KdTree;
use super::similarity::{Similarity, Undetermined, umeyama};

/// What is minimised.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Metric {
    /// Distance to the nearest point.
    PointToPoint,
    /// Distance along the nearest point's normal.
    PointToPlane,
}

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
/// Smallest eigenvalue of the point-to-plane system, as a share of the largest, that still determines all unknowns.
const SLIDING: f64 = 1e-7;
/// Neighbours that define a normal.
const NORMAL_NEIGHBOURS: usize = 8;

/// Aligns `source` to `target`, starting from `start` (or from equal centres and spreads).
///
/// # Errors
/// The points do not determine a similarity; see [`Undetermined`].
pub fn icp(
    source: &[Vec3],
    target: &[Vec3],
    metric: Metric,
    start: Option<Similarity>,
) -> Result<IcpResult, Undetermined> {
    let source: Vec<DVec3> = source.iter().filter(|p| p.is_finite()).map(|p| p.as_dvec3()).collect();
    let sound: Vec<Vec3> = target.iter().copied().filter(|p| p.is_finite()).collect();
    if source.len().min(sound.len()) < 3 {
        return Err(Undetermined::TooFew(source.len().min(sound.len())));
    }
    let tree = KdTree::new(&sound);
    let normals = match metric {
        Metric::PointToPoint => Vec::new(),
        Metric::PointToPlane => normals(&sound, &tree),
    };
    let mut s = match start {
        Some(s) => s,
        None => same_spread(&source, &sound)?,
    };
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
        let to: Vec<DVec3> = pairs.iter().map(|p| sound[p.1].as_dvec3()).collect();
        let change = match metric {
            Metric::PointToPoint => umeyama(&from, &to, None)?,
            Metric::PointToPlane => {
                let n: Vec<DVec3> = pairs.iter().map(|p| normals[p.1]).collect();
                plane_step(&from, &to, &n)?
            }
        };
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

/// Normal of each point: the direction in which its neighbours spread least.
fn normals(points: &[Vec3], tree: &KdTree<'_>) -> Vec<DVec3> {
    points
        .iter()
        .map(|p| {
            let mut near = [(0.0, 0); NORMAL_NEIGHBOURS];
            let n = tree.nearest(*p, None, &mut near);
            let mean = near[..n].iter().map(|k| points[k.1 as usize].as_dvec3()).sum::<DVec3>() / n.max(1) as f64;
            let mut m = SMatrix::<f64, 3, 3>::zeros();
            for k in &near[..n] {
                let d = points[k.1 as usize].as_dvec3() - mean;
                let d = SVector::<f64, 3>::from(d.to_array());
                m += d * d.transpose();
            }
            let eigen = m.symmetric_eigen();
            let least = (0..3).min_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b])).unwrap_or(2);
            let v = eigen.eigenvectors.column(least);
            DVec3::new(v[0], v[1], v[2])
        })
        .collect()
}

/// One linearised step about the centre of the points: rotation vector, translation, relative scale.
fn plane_step(from: &[DVec3], to: &[DVec3], normals: &[DVec3]) -> Result<Similarity, Undetermined> {
    let center = from.iter().sum::<DVec3>() / from.len() as f64;
    let size = (from.iter().map(|p| (*p - center).length_squared()).sum::<f64>() / from.len() as f64).sqrt();
    if size.is_nan() || size <= 0.0 {
        return Err(Undetermined::Degenerate);
    }
    let mut a = SMatrix::<f64, 7, 7>::zeros();
    let mut b = SVector::<f64, 7>::zeros();
    for ((p, q), n) in from.iter().zip(to).zip(normals) {
        // In units of the cloud's size, so that the seven unknowns compare.
        let x = (*p - center) / size;
        let c = x.cross(*n);
        let row = SVector::<f64, 7>::from([c.x, c.y, c.z, n.x, n.y, n.z, n.dot(x)]);
        a += row * row.transpose();
        b += row * (n.dot(*q - *p) / size);
    }
    let eigen = a.symmetric_eigenvalues();
    if eigen.min().is_nan() || eigen.min() <= SLIDING * eigen.max() {
        return Err(Undetermined::Sliding);
    }
    let x = a.cholesky().ok_or(Undetermined::Sliding)?.solve(&b);
    let rotation = DQuat::from_scaled_axis(DVec3::new(x[0], x[1], x[2]));
    let scale = 1.0 + x[6].clamp(-0.5, 0.5);
    Ok(Similarity {
        scale,
        rotation,
        translation: center + DVec3::new(x[3], x[4], x[5]) * size - rotation * center * scale,
    })
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
    fn both_metrics_find_the_scale() {
        let source = terrain(40);
        let truth = Similarity {
            scale: 3.0,
            rotation: DQuat::from_rotation_z(0.05) * DQuat::from_rotation_x(0.03),
            translation: DVec3::new(4.0, 1.0, -2.0),
        };
        let target: Vec<Vec3> = source.iter().map(|p| truth.apply(p.as_dvec3()).as_vec3()).collect();
        for metric in [Metric::PointToPoint, Metric::PointToPlane] {
            let found = icp(&source, &target, metric, None).unwrap();
            assert!((found.similarity.scale / 3.0 - 1.0).abs() < 5e-3, "{metric:?} {found:?}");
        }
    }

    #[test]
    fn planes_lines_and_spots_are_refused_where_they_leave_freedom() {
        let plane: Vec<Vec3> = (0..100).map(|k| Vec3::new((k % 10) as f32, (k / 10) as f32, 0.0)).collect();
        assert_eq!(icp(&plane, &plane, Metric::PointToPlane, None), Err(Undetermined::Sliding));
        assert!(icp(&plane, &plane, Metric::PointToPoint, None).is_ok());
        let line: Vec<Vec3> = (0..50).map(|k| Vec3::new(k as f32, 0.0, 0.0)).collect();
        assert_eq!(icp(&line, &line, Metric::PointToPoint, None), Err(Undetermined::Degenerate));
        assert_eq!(icp(&[Vec3::ONE; 9], &[Vec3::ONE; 9], Metric::PointToPoint, None), Err(Undetermined::Degenerate));
        assert_eq!(icp(&[Vec3::NAN; 9], &plane, Metric::PointToPoint, None), Err(Undetermined::TooFew(0)));
    }
}

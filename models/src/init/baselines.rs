//! The two baselines an initialisation is compared with: sparse points of an SfM model, and points at random.

use glam::Vec3;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::align::nearest::KdTree;
use crate::camera::View;
use crate::cloud::{GaussianCloud, SH_C0};

use super::InitError;

/// Opacity at the start. 3DGS begins at 0.1 and needs hundreds of steps to fill the holes; 0.5 with the opacity rate of the
/// recipe was 2.6 dB ahead after 150 steps on fox.
const OPACITY: f32 = 0.5;
/// Smallest squared distance to neighbours (3DGS: `clamp_min(dist2, 1e-7)`); duplicates would have log 0.
const MIN_DISTANCE2: f32 = 1e-7;
/// Extent of a point that has no neighbour at all, metres.
const LONELY: f32 = 1.0;

/// Sparse points → isotropic Gaussians whose extent is the root mean square distance to the three nearest neighbours,
/// as in 3DGS. When there are more than `max_gaussians`, every k-th is taken. Points that are not finite are
/// dropped.
///
/// # Errors
/// No usable point.
pub fn from_sfm(points: &[[f32; 3]], colors: &[[u8; 3]], max_gaussians: usize) -> Result<GaussianCloud, InitError> {
    let usable: Vec<usize> =
        (0..points.len().min(colors.len())).filter(|&i| points[i].iter().all(|v| v.is_finite())).collect();
    if usable.is_empty() || max_gaussians == 0 {
        return Err(InitError::NoPoints { given: points.len() });
    }
    let step = usable.len().div_ceil(max_gaussians);
    let chosen: Vec<usize> = usable.into_iter().step_by(step).collect();
    let positions: Vec<Vec3> = chosen.iter().map(|&i| Vec3::from(points[i])).collect();
    let colors: Vec<[f32; 3]> = chosen.iter().map(|&i| colors[i].map(|v| f32::from(v) / 255.0)).collect();
    Ok(isotropic(&positions, &colors))
}

/// `count` Gaussians of random colour inside what the views see between two depths (metres).
///
/// # Errors
/// No views, no Gaussians asked for, or an empty depth range.
pub fn random(views: &[View], depth_m: [f32; 2], count: usize, seed: u64) -> Result<GaussianCloud, InitError> {
    let [near, far] = depth_m;
    if views.is_empty() || count == 0 || !(near > 0.0 && far > near && far.is_finite()) {
        return Err(InitError::NoPoints { given: 0 });
    }
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut positions = Vec::with_capacity(count);
    let mut colors = Vec::with_capacity(count);
    for _ in 0..count {
        let view = &views[rng.random_range(0..views.len())];
        let k = &view.intrinsics;
        let depth = rng.random_range(near..far);
        let u = rng.random_range(0.0..k.width as f32);
        let v = rng.random_range(0.0..k.height as f32);
        let ray = Vec3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0) * depth;
        positions.push((view.pose.rotation * ray.as_dvec3() + view.pose.center).as_vec3());
        colors.push(rng.random::<[f32; 3]>());
    }
    Ok(isotropic(&positions, &colors))
}

fn isotropic(positions: &[Vec3], colors: &[[f32; 3]]) -> GaussianCloud {
    let tree = KdTree::new(positions);
    let mut cloud = GaussianCloud::with_capacity(0, positions.len());
    let logit = (OPACITY / (1.0 - OPACITY)).ln();
    for (i, (p, c)) in positions.iter().zip(colors).enumerate() {
        let mut near = [(0.0f32, 0u32); 3];
        let n = tree.nearest(*p, Some(i as u32), &mut near);
        let extent = match n {
            0 => LONELY,
            _ => (near[..n].iter().map(|d| d.0).sum::<f32>() / n as f32).max(MIN_DISTANCE2).sqrt(),
        };
        cloud.push(p.to_array(), [extent.ln(); 3], [1.0, 0.0, 0.0, 0.0], logit, &c.map(|v| (v - 0.5) / SH_C0));
    }
    cloud
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::{DQuat, DVec3};

    #[test]
    fn extent_is_the_distance_to_the_neighbours() {
        let points: Vec<[f32; 3]> = (0..27).map(|i| [(i % 3) as f32, (i / 3 % 3) as f32, (i / 9) as f32]).collect();
        let cloud = from_sfm(&points, &[[255, 0, 128]; 27], 100).unwrap();
        assert_eq!(cloud.len(), 27);
        assert!(cloud.log_scales.iter().flatten().all(|s| s.abs() < 1e-6), "grid of spacing 1 m: log 0");
        assert!((cloud.sh[0] * SH_C0 + 0.5 - 1.0).abs() < 1e-6 && (cloud.sh[1] * SH_C0 + 0.5).abs() < 1e-6);
    }

    #[test]
    fn duplicates_single_points_and_nan_leave_a_valid_cloud() {
        for points in [vec![[1.0; 3]; 5], vec![[1.0; 3]], vec![[f32::NAN; 3], [0.0; 3], [1.0; 3]]] {
            let mut cloud = from_sfm(&points, &vec![[9; 3]; points.len()], 100).unwrap();
            assert_eq!(cloud.drop_invalid(), 0);
        }
        assert!(from_sfm(&[[f32::NAN; 3]], &[[0; 3]], 10).is_err());
    }

    #[test]
    fn the_budget_holds() {
        let points: Vec<[f32; 3]> = (0..1000).map(|i| [i as f32, 0.0, 0.0]).collect();
        assert!(from_sfm(&points, &vec![[0; 3]; 1000], 300).unwrap().len() <= 300);
    }

    #[test]
    fn random_points_lie_in_the_frustum_and_repeat_with_the_seed() {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        let view = View { intrinsics, pose: Pose { rotation: DQuat::from_rotation_x(3.0), center: DVec3::Z * 50.0 } };
        let a = random(&[view], [40.0, 60.0], 500, 7).unwrap();
        assert_eq!(a, random(&[view], [40.0, 60.0], 500, 7).unwrap());
        for p in &a.means {
            let c = view.pose.viewmat().transform_point3(Vec3::from(*p));
            assert!((40.0..=60.0).contains(&c.z) && (c.x / c.z).abs() <= 0.65, "{c}");
        }
    }
}

//! The last half pixel. XFeat's key points are good to about a pixel and, on grass and in trees, a match along its
//! epipolar line is often the neighbour's. The pictures themselves decide: a patch around the one key point, warped
//! by the predicted geometry, is shifted until it fits the other picture, and dropped when it fits nowhere near.

use super::grey::Grey;
use super::overlap::{Ground, predict};
use crate::camera::Pinhole;
use glam::{DMat2, DVec2, DVec3};

/// Side of a patch, pixels.
const SIDE: usize = 11;
const SAMPLES: usize = SIDE * SIDE;
/// Steps at most; most patches come to rest in three.
const STEPS: usize = 6;
/// A patch that wants to go further than this was a wrong match, pixels.
const REACH: f64 = 3.0;
/// Normalised correlation below which two patches do not show the same thing.
const MIN_CORRELATION: f64 = 0.7;
/// Contrast (standard deviation of 8-bit grey) below which there is nothing to fit.
const MIN_CONTRAST: f32 = 2.0;
/// Lanes of a sum.
const LANES: usize = 8;

/// Values on the grid of a patch around `center`, its axes mapped by `warp`.
fn patch(grey: &Grey, center: DVec2, warp: DMat2) -> Option<[f32; SAMPLES]> {
    let mut out = [0.0; SAMPLES];
    grey.square::<SIDE>(center, warp, &mut out)?;
    Some(out)
}

/// A patch and its slopes along x and y, by central differences.
fn template(grey: &Grey, center: DVec2) -> Option<([f32; SAMPLES], [f32; SAMPLES], [f32; SAMPLES])> {
    const WIDE: usize = SIDE + 2;
    let mut wide = [0.0; WIDE * WIDE];
    grey.square::<WIDE>(center, DMat2::IDENTITY, &mut wide)?;
    let place = |k: usize| (k / SIDE + 1) * WIDE + k % SIDE + 1;
    let across = |k: usize, step: usize| 0.5 * (wide[place(k) + step] - wide[place(k) - step]);
    Some((
        std::array::from_fn(|k| wide[place(k)]),
        std::array::from_fn(|k| across(k, 1)),
        std::array::from_fn(|k| across(k, WIDE)),
    ))
}

/// One side of a match.
pub(crate) struct Side<'a> {
    pub grey: &'a Grey,
    pub camera: &'a Pinhole,
    /// Original pixels.
    pub at: [f32; 2],
}

/// Where in `b` the surroundings of `a.at` really are, in original pixels; `None` when they are not within reach of
/// `b.at`, or show nothing to hold on to.
pub(crate) fn align_patch(a: &Side, b: &Side, ground: Ground) -> Option<[f32; 2]> {
    align_warped(a, b, &|pixel| predict(a.camera, b.camera, ground, pixel)).map(|(place, _)| place)
}

/// Aligns a patch of what lies at `world`, be it level or facing the two cameras.
pub(crate) fn align_patch_at(a: &Side, b: &Side, world: DVec3) -> Option<[f32; 2]> {
    let facing = (a.camera.pose.center - world).normalize() + (b.camera.pose.center - world).normalize();
    let on_plane = |normal: DVec3| {
        align_warped(a, b, &|pixel| {
            let ray = a.camera.world_ray(pixel);
            let along = (world - a.camera.pose.center).dot(normal) / ray.dot(normal);
            (along > 0.0).then(|| b.camera.project(a.camera.pose.center + ray * along)).flatten()
        })
    };
    let tried = [DVec3::Z, facing.normalize_or(DVec3::Z)].into_iter().filter_map(on_plane);
    tried.max_by(|x, y| x.1.total_cmp(&y.1)).map(|(place, _)| place)
}

/// Aligns a patch by `to_b`, which says where a pixel of `a` lies in `b`; and how well the two patches correlate there.
fn align_warped(a: &Side, b: &Side, to_b: &dyn Fn([f32; 2]) -> Option<DVec2>) -> Option<([f32; 2], f64)> {
    let place = |s: &Side| DVec2::new(s.at[0].into(), s.at[1].into());
    // How a step in a's picture looks in b's: the plane's derivative, good enough for a patch of 11 pixels.
    let step = |dx: f32, dy: f32| to_b([a.at[0] + dx, a.at[1] + dy]);
    let (right, left) = (step(2.0, 0.0)?, step(-2.0, 0.0)?);
    let (down, up) = (step(0.0, 2.0)?, step(0.0, -2.0)?);
    let warp = DMat2::from_cols((right - left) / 4.0, (down - up) / 4.0);
    let warp = DMat2::from_diagonal(b.grey.scale) * warp * DMat2::from_diagonal(a.grey.scale.recip());
    if !(0.25..4.0).contains(&warp.determinant()) {
        return None;
    }
    let from = place(a) * a.grey.scale;
    let (template, mut by_x, mut by_y) = template(a.grey, from)?;
    let (template, contrast) = normalised(template)?;
    by_x.iter_mut().chain(&mut by_y).for_each(|g| *g /= contrast);
    let sum = |a: &[f32; SAMPLES], b: &[f32; SAMPLES]| f64::from(product(a, b));
    let (xx, xy, yy) = (sum(&by_x, &by_x), sum(&by_x, &by_y), sum(&by_y, &by_y));
    let inverse = DMat2::from_cols(DVec2::new(xx, xy), DVec2::new(xy, yy)).inverse();
    if !inverse.is_finite() {
        return None;
    }
    let start = place(b) * b.grey.scale;
    let mut at = start;
    let mut correlation = 0.0;
    for _ in 0..STEPS {
        let (seen, _) = normalised(patch(b.grey, at, warp)?)?;
        correlation = sum(&seen, &template) / SAMPLES as f64;
        let apart: [f32; SAMPLES] = std::array::from_fn(|k| seen[k] - template[k]);
        let g = DVec2::new(sum(&by_x, &apart), sum(&by_y, &apart));
        let shift = warp * (inverse * g);
        at -= shift;
        if !(at - start).is_finite() || (at - start).length() > REACH {
            return None;
        }
        if shift.length_squared() < 4e-4 {
            break;
        }
    }
    (correlation >= MIN_CORRELATION).then(|| ((at / b.grey.scale).as_vec2().to_array(), correlation))
}

/// Sum of products, in lanes of its own that the compiler makes vectors of.
fn product(a: &[f32; SAMPLES], b: &[f32; SAMPLES]) -> f32 {
    let (a, b) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut lanes = [0.0f32; LANES];
    for (a, b) in a.0.iter().zip(b.0) {
        (0..LANES).for_each(|k| lanes[k] += a[k] * b[k]);
    }
    lanes.iter().sum::<f32>() + a.1.iter().zip(b.1).map(|(a, b)| a * b).sum::<f32>()
}

/// Values less their mean over their standard deviation (given too): light and exposure drop out.
fn normalised(mut values: [f32; SAMPLES]) -> Option<([f32; SAMPLES], f32)> {
    let mean = product(&values, &[1.0; SAMPLES]) / SAMPLES as f32;
    values.iter_mut().for_each(|v| *v -= mean);
    let contrast = (product(&values, &values) / SAMPLES as f32).sqrt();
    if contrast < MIN_CONTRAST {
        return None;
    }
    let per = 1.0 / contrast;
    values.iter_mut().for_each(|v| *v *= per);
    Some((values, contrast))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::{DMat3, DQuat, DVec3};
    use image::RgbImage;

    const LENS: Intrinsics = Intrinsics { width: 128, height: 128, fx: 100.0, fy: 100.0, cx: 64.0, cy: 64.0 };

    /// The ground's brightness at a place, seen from 50 m by a nadir camera with the given heading.
    fn picture(camera: &Pinhole, gain: f64) -> RgbImage {
        RgbImage::from_fn(128, 128, |x, y| {
            let p = Ground(Some(0.0)).meet(camera, [x as f32 + 0.5, y as f32 + 0.5]);
            let v = 120.0 + gain * ((p.x * 0.8).sin() * 40.0 + (p.y * 0.7 + p.x * 0.3).cos() * 40.0);
            image::Rgb([v as u8; 3])
        })
    }

    fn nadir(x: f64, heading: f64) -> Pinhole {
        let down = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z));
        let pose = Pose { rotation: DQuat::from_rotation_z(heading) * down, center: DVec3::new(x, 0.0, 50.0) };
        Pinhole::new(pose, &LENS, 1.0)
    }

    #[test]
    fn a_key_point_off_by_two_pixels_is_pulled_to_its_place_through_rotation_and_exposure() {
        for heading in [0.0, 0.7, 3.1] {
            let (a, b) = (nadir(0.0, 0.0), nadir(6.0, heading));
            let (ga, gb) = (Grey::new(&picture(&a, 1.0), None, 640), Grey::new(&picture(&b, 0.6), None, 640));
            let at = [70.3f32, 60.8];
            let truth = predict(&a, &b, Ground(Some(0.0)), at).unwrap().as_vec2();
            let start = [truth.x + 1.5, truth.y - 1.2];
            let side = |grey, camera, at| Side { grey, camera, at };
            let found = align_patch(&side(&ga, &a, at), &side(&gb, &b, start), Ground(Some(0.0))).unwrap();
            assert!((glam::Vec2::from(found) - truth).length() < 0.1, "{heading}: {found:?} {truth}");
        }
    }

    #[test]
    fn blank_patches_edges_and_other_places_are_refused() {
        let (a, b) = (nadir(0.0, 0.0), nadir(6.0, 0.0));
        let (ga, gb) = (Grey::new(&picture(&a, 1.0), None, 640), Grey::new(&picture(&b, 1.0), None, 640));
        let blank = Grey::new(&RgbImage::new(128, 128), None, 640);
        let side = |grey, camera, at| Side { grey, camera, at };
        let ground = Ground(Some(0.0));
        assert!(align_patch(&side(&blank, &a, [64.0; 2]), &side(&gb, &b, [64.0; 2]), ground).is_none());
        assert!(align_patch(&side(&ga, &a, [1.0; 2]), &side(&gb, &b, [64.0; 2]), ground).is_none());
        let truth = predict(&a, &b, ground, [70.0, 60.0]).unwrap().as_vec2();
        assert!(align_patch(&side(&ga, &a, [70.0, 60.0]), &side(&gb, &b, [truth.x + 9.0, truth.y]), ground).is_none());
    }
}

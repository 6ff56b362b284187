//! Models of different aircraft lie decimetres to metres apart, because each holds to its own GPS. Where two of them show
//! the same ground they can be brought together before they are cut and merged: both are rendered from the same places,
//! features of the two renderings are matched, lifted by the rendered depths, and a rigid motion is fitted to the pairs of
//! points. No picture is needed for it, only the models.

use std::collections::BTreeSet;

use glam::{DVec3, Vec3};
use models::align::similarity::umeyama;
use models::camera::{Intrinsics, View};
use models::init::mutual_matches;
use models::metrics::to_rgb8;
use models::onnx::features::{FeatureNetwork, Features};
use vulkan::trainer::{Rendering, Trainer};

use super::LocalModel;
use super::frame::Motion;
use crate::engine::device::renderer;

/// Views of one model that are looked at through the other.
const VIEWS: usize = 8;
/// Longer side of the renderings, pixels: a feature every few of them is plenty for a rigid motion.
const SIDE: u32 = 480;
/// Features per rendering.
const FEATURES: usize = 700;
/// A pixel shows a model when less than this much light passes through it.
const CLEAR: f32 = 0.3;
/// Share of a view that both models must show.
const OVERLAP: f64 = 0.1;
/// Fewer agreeing points than this prove nothing.
const LEAST_POINTS: usize = 40;
/// Motions beyond these are taken for a mistake: GPS is not that wrong.
const MOST_METRES: f64 = 15.0;
const MOST_DEGREES: f64 = 6.0;

/// What became of one model.
#[derive(Clone, Debug, PartialEq)]
pub struct Registration {
    /// The model.
    pub name: String,
    /// The model it was fitted to.
    pub onto: String,
    /// Points that agree, of those matched.
    pub points: [usize; 2],
    /// By how far its middle moved, metres.
    pub moved_m: f64,
    /// By how much it turned, degrees.
    pub turned_deg: f64,
    /// Root mean square distance of the agreeing points, metres: before and after.
    pub rms_m: [f64; 2],
}

/// Brings all models into the frame of the first one, each by way of those that overlap it. Models that overlap no other
/// stay where their GPS put them.
///
/// # Errors
/// The feature network or the device cannot be used; the models are then as they were.
pub fn register(models: &mut [LocalModel], device: Option<&str>) -> Result<Vec<Registration>, String> {
    if models.len() < 2 {
        return Ok(Vec::new());
    }
    let mut network = FeatureNetwork::open(None, 2).map_err(|e| e.to_string())?;
    let mut done = Vec::new();
    let mut fixed = BTreeSet::from([0]);
    loop {
        // The free model with the most points in common with a fixed one goes next.
        let mut best: Option<(usize, Registration, Motion)> = None;
        for free in (0..models.len()).filter(|i| !fixed.contains(i)) {
            for &anchor in &fixed {
                let Some((registration, motion)) = fit(&models[anchor], &models[free], device, &mut network)? else {
                    continue;
                };
                if best.as_ref().is_none_or(|b| registration.points[0] > b.1.points[0]) {
                    best = Some((free, registration, motion));
                }
            }
        }
        let Some((free, registration, motion)) = best else { return Ok(done) };
        // Regions are agreed on beforehand and stay where they are.
        let region = std::mem::take(&mut models[free].header.region);
        motion.model(&mut models[free]);
        models[free].header.region = region;
        fixed.insert(free);
        done.push(registration);
    }
}

/// The motion that brings `free` onto `anchor`, when enough of them overlaps.
fn fit(
    anchor: &LocalModel,
    free: &LocalModel,
    device: Option<&str>,
    network: &mut FeatureNetwork,
) -> Result<Option<(Registration, Motion)>, String> {
    let views = shared_views(anchor, free);
    if views.is_empty() {
        return Ok(None);
    }
    let open = |m: &LocalModel| {
        renderer(device, &m.cloud, views[0].intrinsics.width, views[0].intrinsics.height).map_err(|e| e.to_string())
    };
    let (mut a, mut b) = (open(anchor)?, open(free)?);
    let mut pairs: Vec<(DVec3, DVec3)> = Vec::new();
    let mut renderings = (Rendering::default(), Rendering::default());
    for view in &views {
        render(&mut a, view, &mut renderings.0)?;
        render(&mut b, view, &mut renderings.1)?;
        let both = |i: &usize| renderings.0.transmittance[*i] < CLEAR && renderings.1.transmittance[*i] < CLEAR;
        let pixels = renderings.0.transmittance.len();
        if ((0..pixels).filter(both).count() as f64) < OVERLAP * pixels as f64 {
            continue;
        }
        let (fa, fb) = (features(network, &renderings.0)?, features(network, &renderings.1)?);
        for (i, j) in mutual_matches(&fa, &fb) {
            let lifted = (lift(view, &renderings.0, fa.keypoints[i]), lift(view, &renderings.1, fb.keypoints[j]));
            if let (Some(p), Some(q)) = lifted {
                pairs.push((q, p));
            }
        }
    }
    Ok(rigid(&pairs).map(|(motion, kept, rms_m)| {
        let middle = kept.iter().map(|(q, _)| *q).sum::<DVec3>() / kept.len() as f64;
        let registration = Registration {
            name: free.name().to_owned(),
            onto: anchor.name().to_owned(),
            points: [kept.len(), pairs.len()],
            moved_m: motion.point(middle).distance(middle),
            turned_deg: motion.angle().to_degrees(),
            rms_m,
        };
        (registration, motion)
    }))
}

/// Views of either model from which the other might be seen: those nearest to the other's cameras.
fn shared_views(anchor: &LocalModel, free: &LocalModel) -> Vec<View> {
    let nearest = |v: &View, others: &[(String, View)]| {
        let d = others.iter().map(|(_, o)| o.pose.center.distance_squared(v.pose.center));
        d.fold(f64::INFINITY, f64::min)
    };
    let (va, vb) = (&anchor.header.views, &free.header.views);
    let mut ranked: Vec<(f64, View)> = va.iter().map(|(_, v)| (nearest(v, vb), *v)).collect();
    ranked.extend(vb.iter().map(|(_, v)| (nearest(v, va), *v)));
    ranked.sort_by(|x, y| x.0.total_cmp(&y.0));
    let Some(first) = ranked.first() else { return Vec::new() };
    let k = first.1.intrinsics;
    let shrink = (SIDE as f32 / k.width.max(k.height) as f32).min(1.0);
    let small = |side: u32| ((side as f32 * shrink) as u32).max(8);
    let lens = |k: Intrinsics| k.resized(small(k.width), small(k.height));
    ranked.into_iter().take(VIEWS).map(|(_, v)| View { intrinsics: lens(v.intrinsics), pose: v.pose }).collect()
}

fn render(trainer: &mut Trainer, view: &View, into: &mut Rendering) -> Result<(), String> {
    trainer.render(view, into).map_err(|e| e.to_string())
}

fn features(network: &mut FeatureNetwork, rendering: &Rendering) -> Result<Features, String> {
    let picture = to_rgb8(&rendering.rgb, rendering.width, rendering.height).ok_or("a rendering without pixels")?;
    network.extract(&picture, FEATURES).map_err(|e| e.to_string())
}

/// The surface point under a key point, by the depth of the Gaussians there.
fn lift(view: &View, rendering: &Rendering, [x, y]: [f32; 2]) -> Option<DVec3> {
    let (px, py) = (x.max(0.0) as usize, y.max(0.0) as usize);
    let at = py * rendering.width as usize + px;
    if px >= rendering.width as usize || py >= rendering.height as usize {
        return None;
    }
    let opaque = 1.0 - rendering.transmittance[at];
    if opaque < 1.0 - CLEAR {
        return None;
    }
    // Blended depth is weighted by opacity (the paper's equation); the surface lies at the mean.
    let depth = rendering.depth[at] / opaque;
    let k = &view.intrinsics;
    let p = Vec3::new((x - k.cx) / k.fx * depth, (y - k.cy) / k.fy * depth, depth).as_dvec3();
    let p = view.pose.rotation * p + view.pose.center;
    p.is_finite().then_some(p)
}

type Fit = (Motion, Vec<(DVec3, DVec3)>, [f64; 2]);

/// Rigid motion of pairs (from, to) by iterated trimming: the median shift first, then least squares over what agrees.
fn rigid(pairs: &[(DVec3, DVec3)]) -> Option<Fit> {
    if pairs.len() < LEAST_POINTS {
        return None;
    }
    let median = |pick: &dyn Fn(&(DVec3, DVec3)) -> f64, of: &[(DVec3, DVec3)]| {
        let mut v: Vec<f64> = of.iter().map(pick).collect();
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    let shift = DVec3::from_array(std::array::from_fn(|k| median(&|(q, p)| p[k] - q[k], pairs)));
    let mut motion = Motion::rigid(glam::DQuat::IDENTITY, shift);
    let mut kept: Vec<(DVec3, DVec3)> = Vec::new();
    for _ in 0..8 {
        let error = |(q, p): &(DVec3, DVec3)| motion.point(*q).distance(*p);
        // Three times the median, but never so tight that rounding throws points out.
        let limit = (3.0 * median(&error, if kept.is_empty() { pairs } else { &kept })).max(0.02);
        kept = pairs.iter().filter(|pair| error(pair) <= limit).copied().collect();
        if kept.len() < LEAST_POINTS {
            return None;
        }
        let (from, to): (Vec<DVec3>, Vec<DVec3>) = kept.iter().copied().unzip();
        let fitted = umeyama(&from, &to, None).ok()?;
        // The models' scales come from the same kind of GPS; a rigid motion keeps both.
        let middle =
            kept.iter().map(|(q, p)| (*q, *p)).fold((DVec3::ZERO, DVec3::ZERO), |s, (q, p)| (s.0 + q, s.1 + p));
        let n = kept.len() as f64;
        let translation = middle.1 / n - fitted.rotation * (middle.0 / n);
        motion = Motion::rigid(fitted.rotation, translation);
    }
    let rms = |f: &dyn Fn(&DVec3) -> DVec3| {
        (kept.iter().map(|(q, p)| f(q).distance_squared(*p)).sum::<f64>() / kept.len() as f64).sqrt()
    };
    let errors = [rms(&|q| *q), rms(&|q| motion.point(*q))];
    let middle = kept.iter().map(|(q, _)| *q).sum::<DVec3>() / kept.len() as f64;
    let plausible = motion.point(middle).distance(middle) <= MOST_METRES
        && motion.angle().to_degrees() <= MOST_DEGREES
        && errors[1] < errors[0];
    plausible.then_some((motion, kept, errors))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    fn pairs(n: u32, truth: &Motion, outliers: u32) -> Vec<(DVec3, DVec3)> {
        (0..n)
            .map(|i| {
                let t = f64::from(i);
                let q = DVec3::new((t * 7.3) % 60.0, (t * 3.1) % 40.0, (t * 1.7) % 4.0);
                let wrong = if i < outliers { DVec3::new(5.0 + t % 9.0, -t % 7.0, 1.0) } else { DVec3::ZERO };
                (q, truth.point(q) + wrong)
            })
            .collect()
    }

    #[test]
    fn two_models_of_the_same_ground_are_brought_together_despite_false_matches() {
        let truth = Motion::rigid(DQuat::from_rotation_z(0.02), DVec3::new(0.8, -0.5, 0.3));
        let (motion, kept, rms) = rigid(&pairs(200, &truth, 60)).expect("fits");
        let p = DVec3::new(20.0, 30.0, 2.0);
        assert!(motion.point(p).distance(truth.point(p)) < 1e-6, "{motion:?}");
        assert!(kept.len() >= 140 && rms[1] < 1e-6 && rms[0] > 0.5);
    }

    #[test]
    fn too_few_points_or_a_motion_no_gps_is_wrong_by_leave_a_model_where_it_is() {
        let small = Motion::rigid(DQuat::IDENTITY, DVec3::X);
        assert!(rigid(&pairs(20, &small, 0)).is_none());
        let absurd = Motion::rigid(DQuat::IDENTITY, DVec3::X * 40.0);
        assert!(rigid(&pairs(200, &absurd, 0)).is_none());
    }
}

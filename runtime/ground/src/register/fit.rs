//! One pair of models: both are rendered from the same places, features of the two renderings are matched, lifted by the
//! rendered depths, and a motion is fitted to what the renderings show. No picture is needed for it, only the models.

use engine::device::renderer;
use glam::{DMat3, DVec3, Vec3};
use models::align::sightings::{self, Prior, Sighting};
use models::align::similarity::{Similarity, umeyama};
use models::camera::{Intrinsics, View};
use models::cloud::GaussianCloud;
use models::formats::model::ModelHeader;
use models::init::mutual_matches;
use models::metrics::to_rgb8;
use models::onnx::features::{FeatureNetwork, Features};
use vulkan::trainer::{Rendering, Trainer};

use super::edge::Fitted;
use super::graph::TILT_RAD;
use super::{Fitter, POINTS_ALIKE, SCALE_BY_GPS, SCALE_BY_NOTHING};
use crate::frame::Motion;
use crate::member::Member;

/// Views of one model that are looked at through the other.
const VIEWS: usize = 12;
/// Longer side of the renderings, pixels: a feature every few of them is plenty for a rigid motion.
const SIDE: u32 = 640;
/// Features per rendering.
const FEATURES: usize = 700;
/// A pixel shows a model when less than this much light passes through it.
const CLEAR: f32 = 0.3;
/// Share of a view that both models must show.
const OVERLAP: f64 = 0.1;
/// Fewer agreeing points than this prove nothing.
const LEAST_POINTS: usize = 40;
/// And fewer than this share of all matches.
const LEAST_SHARE: f64 = 0.2;
/// Pairs of points agree on a shift when theirs are no farther apart: what a heading wrong by a degree does over a view's ground.
const AGREE_M: f64 = 1.0;
/// Half of what agrees in the end lies closer together than this share of it: of matches by chance within a disc half lie within 0.7.
const CLOSER: f64 = 0.5;
/// Shifts that are tried.
const MOST_TRIED: usize = 500;
/// Motions beyond these are taken for a mistake: GPS is not that wrong.
const MOST_METRES: f64 = 15.0;
const MOST_DEGREES: f64 = 6.0;
/// Nor a scale so far from 1: where GPS measured it, and where nobody did.
const MOST_SCALE: [f64; 2] = [1.03, 1.2];

/// Rounds of trimming, in space and then across the lines of sight.
const ROUNDS: usize = 8;

/// A renderer and what it holds.
struct Stage {
    trainer: Trainer,
    size: (u32, u32),
    gaussians: usize,
    sh_degree: u8,
    shows: [u8; 32],
}

impl Stage {
    fn has_room(&self, cloud: &GaussianCloud, size: (u32, u32)) -> bool {
        self.gaussians >= cloud.len()
            && self.sh_degree >= cloud.sh_degree
            && self.size.0 >= size.0
            && self.size.1 >= size.1
    }
}

/// Fits by rendering: one network and two renderers, opened when the first pair asks for them and kept for all others.
pub struct RenderedFitter {
    device: Option<String>,
    network: Option<FeatureNetwork>,
    /// Of the first and of the second of a pair.
    stages: [Option<Stage>; 2],
    /// The first of the last pair: its content and its views.
    first: Option<([u8; 32], ModelHeader)>,
}

impl RenderedFitter {
    /// On this device; nothing is opened yet.
    pub fn new(device: Option<&str>) -> Self {
        Self { device: device.map(str::to_owned), network: None, stages: [None, None], first: None }
    }

    /// Shows `cloud` on a stage, which is opened anew only for a model larger than any before.
    fn show(
        &mut self,
        which: usize,
        content: &[u8; 32],
        cloud: &GaussianCloud,
        size: (u32, u32),
    ) -> Result<(), String> {
        let stage = &mut self.stages[which];
        match stage {
            Some(s) if s.has_room(cloud, size) => {
                s.trainer.load(cloud).map_err(|e| e.to_string())?;
                s.shows = *content;
            }
            _ => {
                // The smaller one goes first: two would have to fit in side by side.
                *stage = None;
                let trainer = renderer(self.device.as_deref(), cloud, size.0, size.1).map_err(|e| e.to_string())?;
                let (gaussians, sh_degree) = (cloud.len(), cloud.sh_degree);
                *stage = Some(Stage { trainer, size, gaussians, sh_degree, shows: *content });
            }
        }
        Ok(())
    }

    fn render(&mut self, which: usize, view: &View, into: &mut Rendering) -> Result<(), String> {
        let stage = self.stages[which].as_mut().ok_or("a renderer was not opened")?;
        stage.trainer.render(view, into).map_err(|e| e.to_string())
    }

    fn features(&mut self, rendering: &Rendering) -> Result<Features, String> {
        let network = match &mut self.network {
            Some(network) => network,
            none => none.insert(FeatureNetwork::open(None, 2).map_err(|e| e.to_string())?),
        };
        let picture = to_rgb8(&rendering.rgb, rendering.width, rendering.height).ok_or("a rendering without pixels")?;
        network.extract(&picture, FEATURES).map_err(|e| e.to_string())
    }
}

impl Fitter for RenderedFitter {
    fn fit(&mut self, first: &Member, second: &Member) -> Result<Option<Fitted>, String> {
        if first.gaussians == 0 || second.gaussians == 0 {
            return Ok(None);
        }
        let (mut header, mut cloud) = second.as_written().map_err(|e| e.to_string())?;
        let prior = second.to_frame_of(first);
        prior.header(&mut header);
        prior.cloud(&mut cloud);
        let mut anchor_cloud = None;
        if self.first.as_ref().is_none_or(|f| f.0 != *first.content()) {
            let (header, cloud) = first.as_written().map_err(|e| e.to_string())?;
            (self.first, anchor_cloud) = (Some((*first.content(), header)), Some(cloud));
        }
        let Some((_, anchor)) = &self.first else { return Ok(None) };
        let views = shared_views(&anchor.views, &header.views);
        let Some(lens) = views.first().map(|v| v.intrinsics) else { return Ok(None) };
        let size = (lens.width, lens.height);
        if !self.stages[0]
            .as_ref()
            .is_some_and(|s| s.shows == *first.content() && s.size.0 >= size.0 && s.size.1 >= size.1)
        {
            let anchor_cloud = match anchor_cloud {
                Some(cloud) => cloud,
                None => first.as_written().map_err(|e| e.to_string())?.1,
            };
            self.show(0, first.content(), &anchor_cloud, size)?;
        }
        self.show(1, second.content(), &cloud, size)?;
        drop(cloud);
        let mut pairs: Vec<Sighting> = Vec::new();
        let mut renderings = (Rendering::default(), Rendering::default());
        for view in &views {
            self.render(0, view, &mut renderings.0)?;
            self.render(1, view, &mut renderings.1)?;
            let both = |i: &usize| renderings.0.transmittance[*i] < CLEAR && renderings.1.transmittance[*i] < CLEAR;
            let pixels = renderings.0.transmittance.len();
            if ((0..pixels).filter(both).count() as f64) < OVERLAP * pixels as f64 {
                continue;
            }
            let (fa, fb) = (self.features(&renderings.0)?, self.features(&renderings.1)?);
            for (i, j) in mutual_matches(&fa, &fb) {
                let lifted = (lift(view, &renderings.0, fa.keypoints[i]), lift(view, &renderings.1, fb.keypoints[j]));
                if let (Some(fixed), Some(moving)) = lifted {
                    pairs.push(Sighting { from: view.pose, moving, fixed });
                }
            }
        }
        let has_free_scale = !(first.is_georeferenced() && second.is_georeferenced());
        Ok(fitted(&pairs, has_free_scale))
    }
}

/// Views of either model from which the other might be seen: those nearest to the other's cameras.
fn shared_views(of_first: &[(String, View)], of_second: &[(String, View)]) -> Vec<View> {
    let nearest = |v: &View, others: &[(String, View)]| {
        let d = others.iter().map(|(_, o)| o.pose.center.distance_squared(v.pose.center));
        d.fold(f64::INFINITY, f64::min)
    };
    let mut ranked: Vec<(f64, View)> = of_first.iter().map(|(_, v)| (nearest(v, of_second), *v)).collect();
    ranked.extend(of_second.iter().map(|(_, v)| (nearest(v, of_first), *v)));
    ranked.sort_by(|x, y| x.0.total_cmp(&y.0));
    let Some(first) = ranked.first() else { return Vec::new() };
    // One size for all, which the network is opened for.
    let k = first.1.intrinsics;
    let shrink = (SIDE as f32 / k.width.max(k.height) as f32).min(1.0);
    let small = |side: u32| ((side as f32 * shrink) as u32).max(8);
    let lens = |k: Intrinsics| k.resized(small(k.width), small(k.height));
    ranked.into_iter().take(VIEWS).map(|(_, v)| View { intrinsics: lens(v.intrinsics), pose: v.pose }).collect()
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

/// The motion by iterated trimming: the shift that most agree on first, then least squares in space over what agrees, then across
/// the lines of sight. Scales are compared, too: that of a small flight is known from GPS to no better than parts of a thousand,
/// which over the length of a border are pixels.
fn fitted(pairs: &[Sighting], has_free_scale: bool) -> Option<Fitted> {
    let shift = agreed_shift(pairs)?;
    let mut motion = Similarity { translation: shift, ..Similarity::IDENTITY };
    let mut kept: Vec<Sighting> =
        pairs.iter().filter(|s| (s.fixed - s.moving).distance(shift) <= AGREE_M).copied().collect();
    let in_space = |motion: &Similarity, s: &Sighting| motion.apply(s.moving).distance(s.fixed);
    for _ in 0..ROUNDS {
        kept = agreeing(pairs, &kept, |s| in_space(&motion, s))?.0;
        let (from, to): (Vec<DVec3>, Vec<DVec3>) = kept.iter().map(|s| (s.moving, s.fixed)).unzip();
        motion = umeyama(&from, &to, None).ok()?;
    }
    let across = |motion: &Similarity, s: &Sighting| s.across(motion).map_or(f64::INFINITY, |d| d.length());
    let log_scale = if has_free_scale { SCALE_BY_NOTHING } else { SCALE_BY_GPS };
    let prior = Prior { turn: TILT_RAD, log_scale };
    let mut middling = 0.0;
    for _ in 0..ROUNDS {
        (kept, middling) = agreeing(pairs, &kept, |s| across(&motion, s))?;
        motion = sightings::step(&motion, &kept, middling * POINTS_ALIKE.sqrt(), &prior);
    }
    let rms =
        |motion: &Similarity| (kept.iter().map(|s| across(motion, s).powi(2)).sum::<f64>() / kept.len() as f64).sqrt();
    let rms_m = [rms(&Similarity::IDENTITY), rms(&motion)];
    let middle = kept.iter().map(|s| s.moving).sum::<DVec3>() / kept.len() as f64;
    let Similarity { scale, rotation, translation } = motion;
    let plausible = middling <= CLOSER * AGREE_M
        && motion.apply(middle).distance(middle) <= MOST_METRES
        && Motion::of(motion).angle().to_degrees() <= MOST_DEGREES
        && scale.max(1.0 / scale) <= MOST_SCALE[usize::from(has_free_scale)]
        && rms_m[1] < rms_m[0];
    plausible.then(|| Fitted {
        turn: rotation.to_array(),
        scale,
        shift: translation.to_array(),
        places: places(&kept, middle),
        points: [kept.len() as u32, pairs.len() as u32],
        rms_m,
    })
}

/// Pairs whose error is no more than three times the median of `kept`, and that median; None when they are too few to
/// prove anything.
fn agreeing(pairs: &[Sighting], kept: &[Sighting], error: impl Fn(&Sighting) -> f64) -> Option<(Vec<Sighting>, f64)> {
    let mut errors: Vec<f64> = kept.iter().map(&error).collect();
    errors.sort_by(f64::total_cmp);
    // Never so tight that rounding throws points out.
    let median = errors.get(errors.len() / 2)?.max(0.02 / 3.0);
    let agree: Vec<Sighting> = pairs.iter().filter(|s| error(s) <= 3.0 * median).copied().collect();
    let enough = agree.len() >= LEAST_POINTS && agree.len() as f64 >= LEAST_SHARE * pairs.len() as f64;
    enough.then_some((agree, median))
}

/// The shift within [`AGREE_M`] of which most pairs lie, of those GPS may be wrong by. Half of the matches may be wrong where
/// ground repeats itself: a median would be led astray.
fn agreed_shift(pairs: &[Sighting]) -> Option<DVec3> {
    let shifts: Vec<DVec3> = pairs.iter().map(|s| s.fixed - s.moving).filter(|d| d.length() <= MOST_METRES).collect();
    let agreeing = |d: &DVec3| shifts.iter().filter(|other| other.distance(*d) <= AGREE_M).count();
    let tried = shifts.iter().step_by(shifts.len().div_ceil(MOST_TRIED).max(1));
    // The first of equals: the same pairs give the same motion.
    tried
        .fold(None, |best: Option<(usize, DVec3)>, d| {
            let n = agreeing(d);
            if best.is_none_or(|b| n > b.0) { Some((n, *d)) } else { best }
        })
        .map(|b| b.1)
}

/// Six places with the middle and the covariance of all: what a motion costs at them it costs at all points.
fn places(kept: &[Sighting], middle: DVec3) -> [[f64; 3]; 6] {
    let covariance = kept.iter().fold(DMat3::ZERO, |sum, s| {
        let d = s.moving - middle;
        sum + DMat3::from_cols(d * d.x, d * d.y, d * d.z)
    }) * (1.0 / kept.len() as f64);
    // Columns of its Cholesky factor; √3 makes the mean of six outer products the covariance.
    let c = covariance.to_cols_array_2d();
    let mut l = [[0.0f64; 3]; 3];
    for j in 0..3 {
        let below: f64 = (0..j).map(|k| l[k][j] * l[k][j]).sum();
        l[j][j] = (c[j][j] - below).max(1e-12).sqrt();
        for i in j + 1..3 {
            let below: f64 = (0..j).map(|k| l[k][i] * l[k][j]).sum();
            l[j][i] = (c[j][i] - below) / l[j][j];
        }
    }
    std::array::from_fn(|i| {
        let column = DVec3::from(l[i / 2]) * 3.0f64.sqrt();
        (if i % 2 == 0 { middle + column } else { middle - column }).to_array()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use models::camera::Pose;

    /// Details of ground below three cameras.
    fn pairs(n: u32, truth: &Motion, outliers: u32) -> Vec<Sighting> {
        let down = DQuat::from_rotation_x(std::f64::consts::PI);
        (0..n)
            .map(|i| {
                let t = f64::from(i);
                let q = DVec3::new((t * 7.3) % 60.0, (t * 3.1) % 40.0, (t * 1.7) % 4.0);
                let wrong = if i < outliers { DVec3::new(5.0 + t % 9.0, -t % 7.0, 1.0) } else { DVec3::ZERO };
                let from = Pose { rotation: down, center: DVec3::new(f64::from(i % 3) * 30.0, 20.0, 60.0) };
                Sighting { from, moving: q, fixed: truth.point(q) + wrong }
            })
            .collect()
    }

    #[test]
    fn two_models_of_the_same_ground_are_brought_together_despite_false_matches() {
        let truth = Motion::rigid(DQuat::from_rotation_z(0.02), DVec3::new(0.8, -0.5, 0.3));
        let fit = fitted(&pairs(200, &truth, 60), false).expect("fits");
        let (motion, p) = (fit.motion(), DVec3::new(20.0, 30.0, 2.0));
        assert!(motion.point(p).distance(truth.point(p)) < 1e-4, "{motion:?}");
        assert!(fit.points[0] >= 140 && fit.rms_m[1] < 1e-4 && fit.rms_m[0] > 0.5);
    }

    #[test]
    fn six_of_ten_matches_may_be_false() {
        let truth = Motion::rigid(DQuat::from_rotation_z(0.01), DVec3::new(-0.6, 1.5, 0.3));
        let fit = fitted(&pairs(200, &truth, 120), false).expect("fits");
        let p = DVec3::new(20.0, 30.0, 2.0);
        assert!(fit.motion().point(p).distance(truth.point(p)) < 1e-4, "{fit:?}");
        assert!(fitted(&pairs(200, &truth, 180), false).is_none(), "nine of ten may not");
    }

    #[test]
    fn a_scale_is_fitted_within_what_it_may_be_wrong_by() {
        let truth = |scale| Motion::of(Similarity { scale, rotation: DQuat::IDENTITY, translation: DVec3::X });
        let scale = |of: f64, is_free| fitted(&pairs(200, &truth(of), 0), is_free).map(|f| f.scale);
        for (of, is_free) in [(1.05, true), (0.998, true), (1.002, false), (0.998, false)] {
            assert!(scale(of, is_free).is_some_and(|s| (s - of).abs() < 1e-5), "{of}");
        }
        assert_eq!(scale(1.05, false), None, "no GPS is wrong by that");
    }

    #[test]
    fn too_few_points_or_a_motion_no_gps_is_wrong_by_leave_a_model_where_it_is() {
        let small = Motion::rigid(DQuat::IDENTITY, DVec3::X);
        assert!(fitted(&pairs(20, &small, 0), false).is_none());
        let absurd = Motion::rigid(DQuat::IDENTITY, DVec3::X * 40.0);
        assert!(fitted(&pairs(200, &absurd, 0), false).is_none());
    }

    #[test]
    fn six_places_have_the_middle_and_the_spread_of_all() {
        let all = pairs(300, &Motion::NONE, 0);
        let middle = all.iter().map(|s| s.moving).sum::<DVec3>() / 300.0;
        let six = places(&all, middle).map(DVec3::from);
        assert!((six.iter().sum::<DVec3>() / 6.0).distance(middle) < 1e-9);
        for (i, j) in [(0, 0), (1, 1), (2, 2), (0, 1), (1, 2)] {
            let of = |p: &DVec3| (p[i] - middle[i]) * (p[j] - middle[j]);
            let (few, many) =
                (six.iter().map(of).sum::<f64>() / 6.0, all.iter().map(|s| of(&s.moving)).sum::<f64>() / 300.0);
            assert!((few - many).abs() < 1e-6 * (1.0 + many.abs()), "{i} {j}: {few} {many}");
        }
    }
}

//! Ground control: points that were surveyed and marked in pictures. They enter the bundle adjustment as points that are known to
//! their own standard deviation, and so fix the frame: position, and with three or more heading, tilt and scale.

use glam::{DQuat, DVec2, DVec3};

use super::linking::median;
use super::problem::{Anchor, Observation, Problem};
use super::triangulate::{Triangulated, triangulate};
use super::{ControlResidual, Refiner};
use crate::align::similarity::{Similarity, umeyama};
use crate::camera::Pinhole;

/// Marks further off than this from where the others say are left out, pixels: the wrong point was marked.
const MISMARKED_PX: f64 = 15.0;
/// Smallest angle between two marks of a point, radians: marks are few and made with care.
const MIN_ANGLE: f64 = 0.01;
/// Points of which one can be found wrong by the others: three fit nearly any place.
const CONTRADICTED_BY: usize = 4;
/// A point this far from where the others put it was surveyed or marked wrongly, metres.
const WRONG_M: f64 = 1.0;
/// Triples of points tried for a similarity; as many as ten points have.
const TRIPLES: usize = 120;

/// A surveyed point.
#[derive(Clone, Debug, PartialEq)]
pub struct ControlPoint {
    /// What the survey calls it.
    pub name: String,
    /// Where it is, world metres.
    pub place: DVec3,
    /// Standard deviation east, north and up, metres.
    pub sigma_m: DVec3,
    /// Names of key frames that show it, and where: pixels of the picture as it was given to [`Refiner::add`].
    pub marks: Vec<(String, [f32; 2])>,
}

impl Refiner {
    /// Takes surveyed points, which the next [`Refiner::solve`] holds the poses to; marks in unknown pictures are ignored.
    pub fn set_control(&mut self, points: Vec<ControlPoint>) {
        self.control = points;
        self.standing.anchored = false;
    }

    /// Whether surveyed points fix where, how large and which way a scene is of which no picture says it.
    pub fn is_fixed(&self) -> bool {
        self.standing.fixed
    }

    /// A surveyed point as the pictures see it, with the marks that agree.
    fn seen(&self, point: &ControlPoint) -> Option<(Triangulated, Vec<Observation>)> {
        let cameras = self.cameras();
        let mut marks: Vec<Observation> = Vec::with_capacity(point.marks.len());
        for (name, pixel) in &point.marks {
            if let Some(frame) = self.by_name.get(name).filter(|i| !self.frames[**i as usize].unplaced) {
                marks.push(Observation { camera: *frame, pixel: *pixel });
            }
        }
        loop {
            let views: Vec<(Pinhole, [f32; 2])> = marks
                .iter()
                .map(|o| {
                    let camera = cameras[o.camera as usize];
                    (camera, self.shared.lens.radial.undistorted(&camera, o.pixel))
                })
                .collect();
            let found = triangulate(&views, MIN_ANGLE)?;
            let off = |(camera, pixel): &(Pinhole, [f32; 2])| {
                let at = DVec2::new(pixel[0].into(), pixel[1].into());
                camera.project(found.world).map_or(f64::INFINITY, |q| q.distance(at))
            };
            let worst = views.iter().map(off).enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
            if worst.1 <= MISMARKED_PX {
                return Some((found, marks));
            }
            if marks.len() <= 3 {
                return None;
            }
            marks.remove(worst.0);
        }
    }

    /// Moves everything to where the surveyed points are, so that what remains is for the adjustment: by their median where the
    /// pictures have positions of their own, by a similarity where they have none.
    pub(super) fn move_to_control(&mut self) {
        let pairs = self.control.iter().filter_map(|c| Some((self.seen(c)?.0.world, c.place)));
        let (from, to): (Vec<DVec3>, Vec<DVec3>) = pairs.unzip();
        let by = match (self.standing.floating, agreed(&from, &to)) {
            _ if from.is_empty() => return,
            (true, None) => {
                let what = "fewer than three surveyed points that lie apart agree with the pictures";
                return tracing::warn!("ground control: {what}; the scene stays without a place");
            }
            (true, Some(by)) => by,
            (false, Some(by)) if from.len() >= CONTRADICTED_BY => by,
            _ => {
                let axis = |k: usize| median(&mut from.iter().zip(&to).map(|(a, b)| b[k] - a[k]).collect::<Vec<_>>());
                let translation = DVec3::new(axis(0), axis(1), axis(2));
                Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation }
            }
        };
        for frame in &mut self.frames {
            frame.pose.rotation = (by.rotation * frame.pose.rotation).normalize();
            frame.pose.center = by.apply(frame.pose.center);
            if self.standing.floating {
                // The prior was a place in the scene before it had any other.
                frame.prior.rotation = (by.rotation * frame.prior.rotation).normalize();
                frame.prior.center = by.apply(frame.prior.center);
                frame.sigma.position_m = frame.sigma.position_m.map(|s| s * by.scale as f32);
            }
        }
        self.ground = self.ground.map(|z| by.apply(DVec3::new(from[0].x, from[0].y, z)).z);
        self.standing.anchored = true;
        self.standing.fixed = self.standing.floating;
    }

    /// Adds the surveyed points to an adjustment.
    pub(super) fn anchor(&self, problem: &mut Problem) {
        if !self.standing.anchored {
            return;
        }
        for point in &self.control {
            let Some((found, marks)) = self.seen(point) else { continue };
            problem.points.push(found.world);
            problem.observations.extend(marks);
            problem.starts.push(problem.observations.len() as u32);
            problem.anchors.push(Anchor { place: point.place, weight: point.sigma_m.recip() });
        }
    }

    pub(super) fn control_residuals(&self) -> Vec<ControlResidual> {
        let of = |c: &ControlPoint| {
            let seen = self.seen(c);
            ControlResidual {
                name: c.name.clone(),
                views: seen.as_ref().map_or(0, |(_, marks)| marks.len()),
                off_m: seen.as_ref().map_or([0.0; 3], |(found, _)| (found.world - c.place).to_array()),
                error_px: seen.map_or(0.0, |(found, _)| found.rms_px),
            }
        };
        self.control.iter().map(of).collect()
    }
}

/// The similarity that most points agree on, however wrong the others are; `None` of fewer than three, or all on a line.
fn agreed(from: &[DVec3], to: &[DVec3]) -> Option<Similarity> {
    let n = from.len();
    let off = |by: &Similarity, i: usize| by.apply(from[i]).distance(to[i]);
    let all = (0..n).flat_map(|a| (a + 1..n).flat_map(move |b| (b + 1..n).map(move |c| [a, b, c])));
    let every = (n * n.saturating_sub(1) * n.saturating_sub(2) / 6).div_ceil(TRIPLES).max(1);
    let fitted = |chosen: &[usize]| {
        let pick = |of: &[DVec3]| chosen.iter().map(|i| of[*i]).collect::<Vec<_>>();
        umeyama(&pick(from), &pick(to), None).ok()
    };
    let tried = all.step_by(every).filter_map(|triple| {
        let by = fitted(&triple)?;
        Some(((0..n).map(|i| off(&by, i).min(WRONG_M).powi(2)).sum::<f64>(), by))
    });
    let best = tried.min_by(|a, b| a.0.total_cmp(&b.0))?.1;
    let good: Vec<usize> = (0..n).filter(|i| off(&best, *i) < WRONG_M).collect();
    Some(if good.len() >= 3 { fitted(&good).unwrap_or(best) } else { best })
}

//! Which pictures agree on one scene. Two rays nearly always meet somewhere, and an adjustment bends to what it is given: that a picture
//! is held by many points says little where nothing but itself fixes them. So the scene is grown once more at its final poses, from its
//! best pair: a picture belongs to it when enough of the points that two others of it fix are seen where it says, and most of a group
//! that one weak match joined is not. With two pictures side by side, a third one elsewhere on their line may agree at other depths: in the
//! end each is asked about the points that all the others fix.

use rayon::prelude::*;

use super::Refiner;
use super::solving::TIED;
use super::tracks::{Sighting, Tracks};
use super::triangulate::triangulate;
use crate::camera::Pinhole;

/// Share of the points that a picture should see of those that others fix, and sees where it says: as COLMAP asks for when it registers one.
const LEAST_SHARE: f64 = 0.25;
/// Share, of the points that all the others of its part fix, that a picture sees where it says. Along a street, seven tenths and more of them
/// agree where all stand right, a quarter to a half where some of them went astray.
const MEMBER_SHARE: f64 = 0.5;
/// Of the pictures that disagree, the worst one in so many is dropped before all are asked again.
const WORST_ONE_IN: usize = 4;
/// By how much a rolling shutter stretches a picture (5 m/s for 30 ms at 60 m), in picture widths: it grows with the size in pixels, a key
/// point's own noise does not.
const MISFIT: f64 = 0.0025;

/// Of the points that others fix, those that a picture has matches with, and those of them that it sees where it says.
#[derive(Clone, Copy, Debug, Default)]
struct Word {
    asked: usize,
    agrees: usize,
}

impl Word {
    fn share(self) -> f64 {
        self.agrees as f64 / self.asked.max(1) as f64
    }

    fn suffices(self) -> bool {
        self.agrees >= TIED && self.share() >= LEAST_SHARE
    }
}

/// Who is asked about the points that a part of the scene fixes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Whose {
    /// Pictures outside it.
    Others,
    /// Its own, each about the points that the rest of it fixes.
    Members,
}

/// Tells of every tied key frame whether it agrees with the largest part of the scene.
pub(super) fn agree(refiner: &mut Refiner, tracks: &Tracks) {
    let tied: Vec<bool> = refiner.frames.iter().map(|f| f.tied && !f.unplaced).collect();
    let best = largest_part(refiner, tracks, &tied);
    refiner.frames.iter_mut().zip(&best).filter(|(f, _)| !f.unplaced).for_each(|(f, agrees)| {
        f.known.apart = f.tied && !agrees;
    });
}

/// The largest part of the scene whose pictures, of `all`, agree with each other at their present poses.
pub(super) fn largest_part(refiner: &Refiner, tracks: &Tracks, all: &[bool]) -> Vec<bool> {
    let cameras = refiner.cameras();
    let (mut waiting, mut best) = (all.to_vec(), vec![false; all.len()]);
    let count = |of: &[bool]| of.iter().filter(|x| **x).count();
    // A part that starts elsewhere may be larger, as long as more wait than there are in the largest.
    while count(&waiting) > count(&best).max(1) {
        let Some((a, b)) = best_pair(refiner, tracks, &cameras, &waiting) else { break };
        let part = part(refiner, tracks, &cameras, all, [a, b]);
        if count(&part) > count(&best) {
            best.clone_from(&part);
        }
        waiting.iter_mut().zip(&part).for_each(|(w, p)| *w &= !p);
        // Those that the part began with may have been dropped from it.
        (waiting[a], waiting[b]) = (false, false);
    }
    best
}

/// The pictures `among` all that agree with the two of `start`, and each with what all the others of them fix.
fn part(refiner: &Refiner, tracks: &Tracks, cameras: &[Pinhole], among: &[bool], start: [usize; 2]) -> Vec<bool> {
    let (mut among, mut start) = (among.to_vec(), start);
    loop {
        let mut part = grown(refiner, tracks, cameras, &among, start);
        let words = words(refiner, tracks, cameras, &part, Whose::Members);
        let is_against = |i: &usize| part[*i] && words[*i].asked >= TIED && words[*i].share() < MEMBER_SHARE;
        let mut against: Vec<usize> = (0..part.len()).filter(is_against).collect();
        if against.is_empty() {
            return part;
        }
        // The worst of them may be why others disagree; and what was reached by them alone has to be reached without them.
        against.sort_by(|a, b| words[*a].share().total_cmp(&words[*b].share()));
        against.truncate(against.len().div_ceil(WORST_ONE_IN));
        for i in against {
            tracing::debug!("{}: {:?}, against the others", refiner.frames[i].name, words[i]);
            (among[i], part[i]) = (false, false);
        }
        if !start.iter().all(|i| part[*i]) {
            let Some((a, b)) = best_pair(refiner, tracks, cameras, &part) else { return vec![false; part.len()] };
            start = [a, b];
        }
    }
}

/// The pictures `among` all that agree with what those before them fix, from the two of `start` on.
fn grown(refiner: &Refiner, tracks: &Tracks, cameras: &[Pinhole], among: &[bool], start: [usize; 2]) -> Vec<bool> {
    let n = refiner.frames.len();
    let mut part = vec![false; n];
    start.iter().for_each(|i| part[*i] = true);
    loop {
        let words = words(refiner, tracks, cameras, &part, Whose::Others);
        let outside = || (0..n).filter(|i| among[*i] && !part[*i]);
        let new: Vec<usize> = outside().filter(|i| words[*i].suffices()).collect();
        if new.is_empty() {
            let of = &refiner.frames[start[0]].name;
            outside().for_each(|i| tracing::debug!("{}: {:?}, no part of {of}'s", refiner.frames[i].name, words[i]));
            return part;
        }
        new.into_iter().for_each(|i| part[i] = true);
    }
}

/// The two pictures that see most points together at the present poses.
fn best_pair(refiner: &Refiner, tracks: &Tracks, cameras: &[Pinhole], among: &[bool]) -> Option<(usize, usize)> {
    let n = refiner.frames.len();
    let every: Vec<u32> = (0..tracks.len() as u32).collect();
    let within = |s: &Sighting| among[s.frame as usize];
    let mut common = vec![0usize; n * n];
    for (_, seen) in
        refiner.placed(cameras, tracks, &every, refiner.settings.outlier_px, within).into_iter().filter_map(|p| p.found)
    {
        for (k, x) in seen.iter().enumerate() {
            seen[..k]
                .iter()
                .for_each(|y| common[x.frame.max(y.frame) as usize * n + x.frame.min(y.frame) as usize] += 1);
        }
    }
    let most = (0..n * n).max_by_key(|k| (common[*k], std::cmp::Reverse(*k)))?;
    (common[most] >= TIED).then_some((most / n, most % n))
}

/// What pictures say of the points that those of `part` fix.
fn words(refiner: &Refiner, tracks: &Tracks, cameras: &[Pinhole], part: &[bool], whose: Whose) -> Vec<Word> {
    let n = part.len();
    let longer = refiner.frames.iter().map(|f| f.intrinsics.width.max(f.intrinsics.height)).max().unwrap_or(0);
    // How far from its point a picture may see it; of all the errors of a point the largest counts.
    let limit = refiner.settings.outlier_px.hypot(MISFIT * f64::from(longer));
    let view =
        |s: &Sighting| (cameras[s.frame as usize], refiner.frames[s.frame as usize].keypoints()[s.feature as usize]);
    let fix = |mut seen: Vec<Sighting>| {
        let fixed = seen.len() >= 2 && refiner.robust_point(cameras, &mut seen, limit, &mut Vec::new()).is_some();
        fixed.then_some(seen)
    };
    let ask = |words: &mut [Word], fixed: &[Sighting], s: &Sighting| {
        let word = &mut words[s.frame as usize];
        word.asked += 1;
        let mut with: Vec<_> = fixed.iter().map(view).collect();
        with.push(view(s));
        // Together, for two rays that hardly cross fix no depth.
        let near = |(camera, at): &(Pinhole, [f32; 2]), world| {
            let at = glam::DVec2::new(at[0].into(), at[1].into());
            camera.project(world).is_some_and(|q| q.distance(at) <= limit)
        };
        let point = triangulate(&with, 0.0);
        word.agrees += usize::from(point.is_some_and(|p| with.iter().all(|v| near(v, p.world))));
    };
    let of = |mut words: Vec<Word>, t: usize| {
        let (inside, outside): (Vec<Sighting>, Vec<Sighting>) =
            refiner.sightings(tracks, t as u32).into_iter().partition(|s| part[s.frame as usize]);
        match whose {
            Whose::Others if outside.is_empty() => {}
            Whose::Others => {
                if let Some(fixed) = fix(inside) {
                    outside.iter().for_each(|s| ask(&mut words, &fixed, s));
                }
            }
            Whose::Members => {
                for (k, s) in inside.iter().enumerate() {
                    if let Some(fixed) = fix([&inside[..k], &inside[k + 1..]].concat()) {
                        ask(&mut words, &fixed, s);
                    }
                }
            }
        }
        words
    };
    let sum = |mut a: Vec<Word>, b: Vec<Word>| {
        for (a, b) in a.iter_mut().zip(&b) {
            (a.asked, a.agrees) = (a.asked + b.asked, a.agrees + b.agrees);
        }
        a
    };
    let none = || vec![Word::default(); n];
    (0..tracks.len()).into_par_iter().fold(none, of).reduce(none, sum)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
pub(super) mod tests {
    use config::refine::RefineSettings;
    use glam::{DQuat, DVec3};

    use super::super::intake::arrived;
    use super::super::twoview::SplitMix;
    use super::*;
    use crate::camera::{Intrinsics, Pose, PoseSigma, View};

    /// A number between -1 and 1.
    pub fn chance(random: &mut SplitMix) -> f64 {
        random.below(2001) as f64 / 1000.0 - 1.0
    }

    /// Pictures of 80 points from 40 m above, 6 m apart, whose key points are off by up to `off` pixels along either axis.
    pub fn flown(pictures: u32, off: f64) -> (Refiner, Tracks) {
        let mut random = SplitMix::default();
        let points: Vec<DVec3> = (0..80)
            .map(|_| {
                DVec3::new(15.0 + 25.0 * chance(&mut random), 20.0 * chance(&mut random), 4.0 * chance(&mut random))
            })
            .collect();
        let lens = Intrinsics { width: 1200, height: 900, fx: 500.0, fy: 500.0, cx: 600.0, cy: 450.0 };
        let sigma = PoseSigma { position_m: [1.0; 3], rotation_rad: [0.1; 3] };
        let mut refiner = Refiner::without_network(&RefineSettings::default()).unwrap();
        for i in 0..pictures {
            let center = DVec3::new(6.0 * f64::from(i), 0.0, 40.0);
            let pose = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center };
            let mut frame = arrived(&format!("{i}.jpg"), u64::from(i), &View { intrinsics: lens, pose }, &sigma);
            let camera = refiner.camera_of(&frame);
            let mut see = |p: &DVec3| {
                let at = camera.project(*p).unwrap();
                [(at.x + off * chance(&mut random)) as f32, (at.y + off * chance(&mut random)) as f32]
            };
            frame.seen = points.iter().map(&mut see).collect();
            (frame.settled, frame.colors) = (vec![false; 80], vec![[0; 3]; 80]);
            (frame.tied, frame.first_node) = (true, refiner.union.grow(i, 80));
            refiner.frames.push(frame);
        }
        for node in 80..80 * pictures {
            refiner.union.join(node % 80, node);
        }
        let tracks = Tracks::build(&mut refiner.union, &refiner.frames, 100_000);
        (refiner, tracks)
    }

    #[test]
    fn pictures_agree_up_to_twice_the_errors_that_are_dropped_and_one_that_stands_elsewhere_does_not() {
        for off in [0.0, 2.0, 3.5] {
            let (mut refiner, tracks) = flown(6, off);
            refiner.frames[4].pose.center += DVec3::new(3.0, 0.0, 0.0);
            agree(&mut refiner, &tracks);
            let apart: Vec<bool> = refiner.frames.iter().map(|f| f.known.apart).collect();
            assert_eq!(apart, [false, false, false, false, true, false], "{off} pixels");
        }
    }

    #[test]
    fn pictures_that_only_dropped_ones_reach_are_no_part_either() {
        let (mut refiner, _) = flown(9, 0.0);
        // The first four and the last three have no point in common; the two between see most of the first ones' where they are not.
        for (i, t) in (4..6).flat_map(|i| (18..60).map(move |t| (i, t))) {
            refiner.frames[i].seen[t][1] += if (i + t) % 2 == 0 { 40.0 } else { -40.0 };
        }
        let track = |t: u32| (if t < 60 { 0..6 } else { 4..9 }).map(|frame| Sighting { frame, feature: t }).collect();
        let tracks = Tracks::of((0..80).map(track).collect());
        agree(&mut refiner, &tracks);
        let apart: Vec<bool> = refiner.frames.iter().map(|f| f.known.apart).collect();
        assert_eq!(apart, [false, false, false, false, true, true, true, true, true]);
    }
}

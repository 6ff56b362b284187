//! Which pictures agree on one scene. Two rays nearly always meet somewhere, and an adjustment bends to what it is given: that a picture
//! is held by many points says little where nothing but itself fixes them. So the scene is grown once more at its final poses, from its
//! best pair: a picture belongs to it when enough of the points that two others of it fix are seen where it says, and most of a group
//! that one weak match joined is not.

use rayon::prelude::*;

use super::Refiner;
use super::solving::TIED;
use super::tracks::{Sighting, Tracks};
use super::triangulate::triangulate;
use crate::camera::Pinhole;

/// Share of the points that a picture should see of those that others fix, and sees where it says: as COLMAP asks for when it registers one.
const LEAST_SHARE: f64 = 0.25;

/// Of the points that others fix, those that a picture has matches with, and those of them that it sees where it says.
#[derive(Clone, Copy, Debug, Default)]
struct Word {
    asked: usize,
    agrees: usize,
}

impl Word {
    fn suffices(self) -> bool {
        self.agrees >= TIED && self.agrees as f64 >= LEAST_SHARE * self.asked as f64
    }
}

/// Tells of every tied key frame whether it agrees with the largest part of the scene.
pub(super) fn agree(refiner: &mut Refiner, tracks: &Tracks) {
    let cameras = refiner.cameras();
    let all: Vec<bool> = refiner.frames.iter().map(|f| f.tied && !f.unplaced).collect();
    let (mut waiting, mut best) = (all.clone(), vec![false; all.len()]);
    let count = |of: &[bool]| of.iter().filter(|x| **x).count();
    // A part that starts elsewhere may be larger, as long as more wait than there are in the largest.
    while count(&waiting) > count(&best).max(1) {
        let Some((a, b)) = best_pair(refiner, tracks, &cameras, &waiting) else { break };
        let part = part(refiner, tracks, &cameras, &all, [a, b]);
        if count(&part) > count(&best) {
            best.clone_from(&part);
        }
        waiting.iter_mut().zip(&part).for_each(|(w, p)| *w &= !p);
    }
    refiner.frames.iter_mut().zip(&best).filter(|(f, _)| !f.unplaced).for_each(|(f, agrees)| {
        f.known.apart = f.tied && !agrees;
    });
}

/// The pictures `among` all that agree with the two of `start`.
fn part(refiner: &Refiner, tracks: &Tracks, cameras: &[Pinhole], among: &[bool], start: [usize; 2]) -> Vec<bool> {
    let n = refiner.frames.len();
    let mut part = vec![false; n];
    start.iter().for_each(|i| part[*i] = true);
    loop {
        let words = words(refiner, tracks, cameras, &part);
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

/// What the pictures outside `part` say of the points that those within fix.
fn words(refiner: &Refiner, tracks: &Tracks, cameras: &[Pinhole], part: &[bool]) -> Vec<Word> {
    let (limit, n) = (refiner.settings.outlier_px, part.len());
    let view =
        |s: &Sighting| (cameras[s.frame as usize], refiner.frames[s.frame as usize].keypoints()[s.feature as usize]);
    let of = |mut words: Vec<Word>, t: usize| {
        let (mut inside, outside): (Vec<Sighting>, Vec<Sighting>) =
            refiner.sightings(tracks, t as u32).into_iter().partition(|s| part[s.frame as usize]);
        if inside.len() < 2 || outside.is_empty() {
            return words;
        }
        let mut views = Vec::new();
        if refiner.robust_point(cameras, &mut inside, limit, &mut views).is_none() {
            return words;
        }
        for s in outside {
            let word = &mut words[s.frame as usize];
            word.asked += 1;
            let mut with: Vec<_> = inside.iter().map(view).collect();
            with.push(view(&s));
            // Together, for two rays that hardly cross fix no depth.
            let near = |(camera, at): &(Pinhole, [f32; 2]), world| {
                let at = glam::DVec2::new(at[0].into(), at[1].into());
                camera.project(world).is_some_and(|q| q.distance(at) <= limit)
            };
            let point = triangulate(&with, 0.0);
            word.agrees += usize::from(point.is_some_and(|p| with.iter().all(|v| near(v, p.world))));
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

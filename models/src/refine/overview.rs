//! Which pictures show the same, whatever their priors say: every picture is compared with those it may have something in common
//! with, the lens is estimated from the pairs that agree best, and then all pairs are verified again as closely as the lens allows.

use glam::DVec2;
use rayon::prelude::*;

use super::discovery::discover;
use super::keyframe::KeyFrame;
use super::linking::{Pair, epipolar_lines, median, rays};
use super::matching::{Guide, Match, MatchLimits, likeliest_first, match_frames};
use super::problem::INDEPENDENT;
use super::tracks::Union;
use super::twoview::{RayPair, TwoView, TwoViewLimits, adapted, verify};
use super::{AddReport, RefineError, Refiner, decoys};

/// Up to so many pictures, each is compared with every other one.
const ALL_PAIRS: usize = 64;
/// Beyond, each is compared with so many before it,
const BEFORE: usize = 8;
/// and so many that look most alike.
const ALIKE: usize = 24;
/// Key points compared at the first look, best first; its cost grows with their square.
const COMPARED_FIRST: usize = 1000;
/// Partners of a picture of which all key points are compared, those with most in common first.
const PARTNERS: usize = 12;
/// Pairs that the lens is estimated from.
const LENS_PAIRS: usize = 24;
/// Values of k1 that are tried, and their step: lenses that fly lie between −0.35 (action cameras) and 0.1.
const K1: (f64, f64, f64) = (-0.4, 0.16, 0.04);
/// Step of the second search around the best.
const K1_FINE: f64 = 0.01;
/// What k1 may be wrong by when pairs have told it.
const K1_LEFT: f64 = 0.02;
/// Share of a lens's bend at the corner by which it spoils the epipolar lines of a pair: both pictures are bent alike.
const BEND_SHARE: f64 = 1.0 / 3.0;
/// Pictures of a group that say how it is turned against the others, and those of the others each is compared with.
const REPRESENTATIVES: usize = 4;
const COMPARED: usize = 4;

/// Two pictures and what they have in common.
#[derive(Clone)]
pub(super) struct Look {
    a: usize,
    b: usize,
    matches: Vec<Match>,
    /// None agree.
    found: Option<TwoView>,
}

impl Look {
    fn inliers(&self) -> usize {
        self.found.as_ref().map_or(0, |f| f.inliers.len())
    }
}

/// Forgets all pairs and finds them anew with nothing but the pictures; `refiner.shared.lens` has then what the pairs say of it.
///
/// # Errors
/// The network failed.
pub(super) fn overview(refiner: &mut Refiner) -> Result<(), RefineError> {
    let mut report = AddReport::default();
    let clock = std::time::Instant::now();
    let bend = refiner.settings.radial_sigma;
    let mut looks = compared(refiner, &worth_a_look(refiner), COMPARED_FIRST, threshold(refiner, bend));
    let mut left = bend;
    if lens_from_pairs(refiner, &looks) {
        left = left.min(K1_LEFT);
    }
    verify_again(refiner, &mut looks, threshold(refiner, left));
    compare_apart(refiner, &mut looks, threshold(refiner, left));
    turn_apart(refiner, &mut looks, left, &mut report)?;
    take_pairs(refiner, &looks, left, &mut report);
    report.match_seconds = clock.elapsed().as_secs_f64();
    refiner.totals.absorb(&report);
    Ok(())
}

/// Pairs that may have something in common, older picture first.
fn worth_a_look(refiner: &Refiner) -> Vec<(usize, usize)> {
    let n = refiner.frames.len();
    if n <= ALL_PAIRS {
        return (0..n).flat_map(|b| (0..b).map(move |a| (a, b))).collect();
    }
    let looks: Vec<Vec<f32>> = refiner.frames.iter().map(KeyFrame::look).collect();
    let mut pairs: Vec<(usize, usize)> = (0..n)
        .into_par_iter()
        .flat_map_iter(|i| {
            let alike = |j: usize| -> f32 { looks[i].iter().zip(&looks[j]).map(|(x, y)| x * y).sum() };
            let mut rated: Vec<(f32, usize)> = (0..n).filter(|j| *j != i).map(|j| (alike(j), j)).collect();
            rated.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
            let near = i.saturating_sub(BEFORE)..i;
            let others: Vec<usize> = rated.into_iter().take(ALIKE).map(|(_, j)| j).chain(near).collect();
            others.into_iter().map(move |j| (i.min(j), i.max(j)))
        })
        .collect();
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// Largest distance from an epipolar line while k1 may be wrong by `bend`: the key points' own noise, and what the lens does to a
/// corner. In pixels of the picture that key points are found in.
fn threshold(refiner: &Refiner, bend: f64) -> f64 {
    let corner = refiner.frames.iter().map(|f| {
        let (k, camera) = (&f.intrinsics, refiner.camera_of(f));
        let radius = (f64::from(k.width).hypot(f64::from(k.height)) / 2.0) / camera.f.min_element();
        camera.f.min_element() * radius.powi(3)
    });
    let corner = median(&mut corner.collect::<Vec<_>>());
    refiner.settings.epipolar_px + BEND_SHARE * bend * corner
}

fn rays_of(refiner: &Refiner, a: usize, b: usize, matches: &[Match]) -> Vec<RayPair> {
    let (ca, cb) = (refiner.camera_of(&refiner.frames[a]), refiner.camera_of(&refiner.frames[b]));
    rays(&refiner.frames, (a, &ca), (b, &cb), matches)
}

fn focal(refiner: &Refiner, a: usize, b: usize) -> f64 {
    let of = |i: usize| refiner.camera_of(&refiner.frames[i]).f.min_element();
    of(a).min(of(b))
}

/// Where groups of pictures have nothing in common so far, all of their key points are compared: a strip along the edge of two pictures
/// holds few of the best.
fn compare_apart(refiner: &Refiner, looks: &mut Vec<Look>, threshold_px: f64) {
    let mut group = vec![0; refiner.frames.len()];
    let groups = joined(refiner, looks);
    groups.iter().enumerate().for_each(|(k, of)| of.iter().for_each(|i| group[*i] = k));
    let apart: Vec<(usize, usize)> = looks.iter().map(|l| (l.a, l.b)).filter(|(a, b)| group[*a] != group[*b]).collect();
    looks.retain(|l| group[l.a] == group[l.b]);
    looks.extend(compared(refiner, &apart, usize::MAX, threshold_px));
}

/// Size of a picture in ray units.
fn size_of(refiner: &Refiner, i: usize) -> DVec2 {
    let k = &refiner.frames[i].intrinsics;
    DVec2::new(k.width.into(), k.height.into()) / refiner.camera_of(&refiner.frames[i]).f
}

/// The best `features` key points of each two, compared all with all, and the relative pose they agree on.
fn compared(refiner: &Refiner, pairs: &[(usize, usize)], features: usize, threshold_px: f64) -> Vec<Look> {
    let limits = MatchLimits {
        min_cosine: refiner.settings.min_cosine,
        cosine_margin: refiner.settings.cosine_margin,
        features,
    };
    let look = |(a, b): &(usize, usize)| {
        let (fa, fb) = (&refiner.frames[*a], &refiner.frames[*b]);
        let anywhere = vec![Some(refiner.camera_of(fa).c); fb.keypoints().len()];
        let guide = Guide { predicted: &anywhere, radius: f64::INFINITY, lines: None };
        let mut matches = match_frames(fa, fb, &guide, limits);
        likeliest_first(fa, fb, &mut matches);
        let threshold = threshold_px / focal(refiner, *a, *b);
        let rays = rays_of(refiner, *a, *b, &matches);
        let found = discover(&rays, size_of(refiner, *a), threshold, refiner.settings.min_inliers);
        Look { a: *a, b: *b, matches, found }
    };
    pairs.par_iter().map(look).collect()
}

/// Drops what does not agree to within `threshold_px` with the lens as it is known now.
fn verify_again(refiner: &Refiner, looks: &mut [Look], threshold_px: f64) {
    looks.par_iter_mut().for_each(|look| {
        if look.found.is_some() {
            let rays = rays_of(refiner, look.a, look.b, &look.matches);
            let threshold = threshold_px / focal(refiner, look.a, look.b);
            look.found = discover(&rays, size_of(refiner, look.a), threshold, refiner.settings.min_inliers);
        }
    });
}

/// k1, and the focal length where it may be wrong, with which the best pairs agree most; false where the lens is known or no pair is
/// left to ask.
fn lens_from_pairs(refiner: &mut Refiner, looks: &[Look]) -> bool {
    let (radial_sigma, focal_sigma) = (refiner.settings.radial_sigma, refiner.settings.focal_sigma);
    let mut best: Vec<&Look> = looks.iter().filter(|l| l.found.as_ref().is_some_and(|f| !f.rotation_only)).collect();
    if radial_sigma <= 0.0 || best.is_empty() {
        return false;
    }
    best.sort_by_key(|l| std::cmp::Reverse(l.inliers()));
    best.truncate(LENS_PAIRS);
    let matches: usize = best.iter().map(|l| l.inliers()).sum();
    // Few matches of a picture say something of their own.
    let share = (INDEPENDENT * best.len() as f64 / matches.max(1) as f64).min(1.0);
    let cost = |log_focal: f64, k1: f64| -> f64 {
        let mut lens = refiner.shared.lens;
        (lens.log_focal, lens.radial.k1, lens.radial.k2) = (log_focal, k1, 0.0);
        let of = |look: &&Look| {
            let Some(found) = &look.found else { return 0.0 };
            let [ca, cb] = [look.a, look.b].map(|i| lens.camera(refiner.frames[i].pose, &refiner.frames[i].intrinsics));
            let ray = |i: usize, camera: &_, k: u32| {
                let seen = refiner.frames[i].seen[k as usize];
                crate::camera::Pinhole::ray(camera, lens.radial.undistorted(camera, seen))
            };
            let rays: Vec<RayPair> = found
                .inliers
                .iter()
                .map(|m| look.matches[*m as usize])
                .map(|m| RayPair { a: ray(look.a, &ca, m.a), b: ray(look.b, &cb, m.b) })
                .collect();
            let threshold = refiner.settings.epipolar_px / ca.f.min_element().min(cb.f.min_element());
            adapted(&rays, found.pose, threshold).0
        };
        let data: f64 = best.par_iter().map(of).collect::<Vec<_>>().iter().sum();
        let prior = |value: f64, sigma: f64| if sigma > 0.0 { (value / sigma).powi(2) } else { 0.0 };
        share * data + prior(k1, radial_sigma) + prior(log_focal, focal_sigma)
    };
    let steps = ((K1.1 - K1.0) / K1.2).round() as i32;
    let k1s: Vec<f64> = (0..=steps).map(|i| K1.0 + f64::from(i) * K1.2).collect();
    let focals: Vec<f64> = match focal_sigma > 0.0 {
        true => (-3..=3).map(|i| f64::from(i) * 0.7 * focal_sigma).collect(),
        false => vec![0.0],
    };
    let mut least = (f64::INFINITY, 0.0, 0.0);
    let mut consider = |log_focal: f64, k1: f64| {
        let now = cost(log_focal, k1);
        if now < least.0 {
            least = (now, log_focal, k1);
        }
        least
    };
    focals.iter().for_each(|f| k1s.iter().for_each(|k| _ = consider(*f, *k)));
    let (_, log_focal, k1) = consider(0.0, 0.0);
    for i in -3..=3 {
        consider(log_focal, k1 + f64::from(i) * K1_FINE);
    }
    let (_, log_focal, k1) = least;
    tracing::debug!("lens from {} pairs: k1 {k1:.3}, focal length x {:.3}", best.len(), log_focal.exp());
    refiner.shared.lens.radial.k1 = k1;
    refiner.shared.lens.log_focal = log_focal;
    let lens = refiner.shared.lens;
    refiner.frames.iter_mut().for_each(|f| f.straighten(&lens));
    true
}

/// Groups that nothing joins are turned as they have to be to match the largest one: descriptors know no other heading than their own.
fn turn_apart(
    refiner: &mut Refiner,
    looks: &mut Vec<Look>,
    bend: f64,
    report: &mut AddReport,
) -> Result<(), RefineError> {
    if refiner.networks.is_none() {
        return Ok(());
    }
    let threshold = threshold(refiner, bend);
    let mut refused: Vec<usize> = Vec::new();
    loop {
        let groups = joined(refiner, looks);
        let Some(most) = groups.first() else { return Ok(()) };
        let Some(group) = groups[1..].iter().find(|g| !refused.contains(&g[0])) else { return Ok(()) };
        let mut best = (0, 0u8);
        for &i in group.iter().step_by(group.len().div_ceil(REPRESENTATIVES)) {
            let as_it_was = refiner.frames[i].turns;
            for quarters in 1..4 {
                refiner.extract_turned(i, (as_it_was + quarters) % 4, report)?;
                let with: Vec<(usize, usize)> =
                    alike(refiner, i, most, COMPARED).into_iter().map(|j| (i.min(j), i.max(j))).collect();
                let inliers =
                    compared(refiner, &with, COMPARED_FIRST, threshold).iter().map(Look::inliers).max().unwrap_or(0);
                best = best.max((inliers, quarters));
            }
            refiner.extract_turned(i, as_it_was, report)?;
        }
        if best.0 == 0 {
            refused.push(group[0]);
            continue;
        }
        for &i in group {
            refiner.extract_turned(i, (refiner.frames[i].turns + best.1) % 4, report)?;
        }
        let concerns = |i: usize| group.binary_search(&i).is_ok();
        looks.retain(|l| !concerns(l.a) && !concerns(l.b));
        let again: Vec<(usize, usize)> = match refiner.frames.len() <= ALL_PAIRS {
            true => worth_a_look(refiner).into_iter().filter(|(a, b)| concerns(*a) || concerns(*b)).collect(),
            false => {
                let everybody: Vec<usize> = (0..refiner.frames.len()).collect();
                let of = |i: usize| {
                    let alike = alike(refiner, i, &everybody, ALIKE);
                    alike.into_iter().map(move |j| (j.min(i), j.max(i)))
                };
                group.iter().flat_map(|i| of(*i)).collect()
            }
        };
        looks.extend(compared(refiner, &again, COMPARED_FIRST, threshold));
        // What was joined by the turn must not be turned back and forth.
        if joined(refiner, looks).iter().any(|g| g[0] == group[0]) {
            refused.push(group[0]);
        }
    }
}

/// Pictures of `among` that look most like picture `i`.
fn alike(refiner: &Refiner, i: usize, among: &[usize], count: usize) -> Vec<usize> {
    let own = refiner.frames[i].look();
    let alike = |j: &usize| -> f32 { refiner.frames[*j].look().iter().zip(&own).map(|(a, b)| a * b).sum() };
    let mut rated: Vec<(f32, usize)> = among.iter().filter(|j| **j != i).map(|j| (alike(j), *j)).collect();
    rated.sort_by(|a, b| b.0.total_cmp(&a.0));
    rated.into_iter().take(count).map(|(_, j)| j).collect()
}

/// Pictures that verified looks join, the largest group first, each sorted.
fn joined(refiner: &Refiner, looks: &[Look]) -> Vec<Vec<usize>> {
    let mut union = Union::with_capacity(refiner.frames.len());
    (0..refiner.frames.len()).for_each(|i| _ = union.grow(i as u32, 1));
    for look in looks.iter().filter(|l| l.found.is_some()) {
        union.join(look.a as u32, look.b as u32);
    }
    let mut groups = vec![Vec::new(); refiner.frames.len()];
    (0..refiner.frames.len()).for_each(|i| groups[union.find(i as u32) as usize].push(i));
    groups.retain(|g: &Vec<usize>| !g.is_empty());
    groups.sort_by_key(|g| std::cmp::Reverse(g.len()));
    groups
}

/// The best partners of every picture compared along their epipolar lines, with all key points; their matches become tracks.
fn take_pairs(refiner: &mut Refiner, looks: &[Look], bend: f64, report: &mut AddReport) {
    forget_pairs(refiner);
    let mut order: Vec<&Look> = looks.iter().filter(|l| l.found.is_some()).collect();
    order.sort_by_key(|l| std::cmp::Reverse(l.inliers()));
    let mut partners = vec![0usize; refiner.frames.len()];
    order.retain(|l| {
        let wanted = partners[l.a] < PARTNERS || partners[l.b] < PARTNERS;
        partners[l.a] += usize::from(wanted);
        partners[l.b] += usize::from(wanted);
        wanted
    });
    report.pairs_tried = looks.len();
    for (i, frame) in refiner.frames.iter().enumerate() {
        let mut own: Vec<usize> = looks.iter().filter(|l| l.a == i || l.b == i).map(Look::inliers).collect();
        own.sort_unstable_by_key(|n| std::cmp::Reverse(*n));
        own.truncate(4);
        tracing::debug!("{}: {} key points, most common with others {own:?}", frame.name, frame.seen.len());
    }
    let this = &*refiner;
    let threshold_px = threshold(refiner, bend);
    let fine: Vec<_> = order.par_iter().map(|l| look_closely(this, l, threshold_px)).collect();
    for (look, (matches, found)) in order.into_iter().zip(fine) {
        report.matches += matches.len();
        let Some(found) = found else { continue };
        let (a, b) = (look.a as u32, look.b as u32);
        let joined = found.inliers.iter().map(|i| matches[*i as usize]);
        join(refiner, Pair { a, b, pose: found.pose, rotation_only: found.rotation_only }, joined, report);
    }
}

/// All key points are single again.
pub(super) fn forget_pairs(refiner: &mut Refiner) {
    refiner.union = Union::with_capacity(refiner.settings.max_keyframes * refiner.settings.max_features);
    refiner.pairs.clear();
    refiner.solved_pairs = 0;
    for (i, frame) in refiner.frames.iter_mut().enumerate() {
        frame.first_node = refiner.union.grow(i as u32, frame.seen.len());
        frame.pairs = 0;
        frame.settled.fill(false);
    }
}

/// Takes a verified pair, its matches become tracks.
pub(super) fn join(refiner: &mut Refiner, pair: Pair, matches: impl Iterator<Item = Match>, report: &mut AddReport) {
    report.pairs_verified += 1;
    report.pairs_without_baseline += usize::from(pair.rotation_only);
    let (first_a, first_b) = (refiner.frames[pair.a as usize].first_node, refiner.frames[pair.b as usize].first_node);
    for m in matches {
        report.inliers += 1;
        report.conflicting += usize::from(!refiner.union.join(first_a + m.a, first_b + m.b));
    }
    refiner.frames[pair.a as usize].pairs += 1;
    refiner.frames[pair.b as usize].pairs += 1;
    refiner.pairs.push(pair);
}

fn look_closely(refiner: &Refiner, look: &Look, threshold_px: f64) -> (Vec<Match>, Option<TwoView>) {
    let Some(coarse) = &look.found else { return (Vec::new(), None) };
    let (fa, fb) = (&refiner.frames[look.a], &refiner.frames[look.b]);
    let (ca, cb) = (refiner.camera_of(fa), refiner.camera_of(fb));
    let limits = MatchLimits {
        min_cosine: refiner.settings.min_cosine,
        cosine_margin: refiner.settings.cosine_margin,
        features: usize::MAX,
    };
    let matches = if coarse.rotation_only {
        let anywhere = vec![Some(ca.c); fb.keypoints().len()];
        match_frames(fa, fb, &Guide { predicted: &anywhere, radius: f64::INFINITY, lines: None }, limits)
    } else {
        let lines = epipolar_lines(&coarse.pose, &ca, &cb, fb.keypoints());
        decoys::match_along((fa, fb), (&lines, 2.0 * threshold_px), limits, decoys::FEW_WRONG)
    };
    let limits = TwoViewLimits {
        threshold: threshold_px / focal(refiner, look.a, look.b),
        min_inliers: refiner.settings.min_inliers,
        any_heading: false,
        rotation_sigma: 0.05,
        direction_sigma: 0.3,
        rounds: 0,
    };
    let found = verify(&rays(&refiner.frames, (look.a, &ca), (look.b, &cb), &matches), coarse.pose, limits);
    (matches, found)
}

//! Promises on cards made up by seed, whose truth is known: whatever lens, way of flying and positions, the pictures that overlap are
//! found, and none that is said to be placed is off by more than it is said to be.
//!
//! `DGTR_CARDS=200 cargo test --release -p models --test simulated_cards -- --nocapture` tries as many and prints each; with
//! `DGTR_CARD_DETAIL=2` their key points are found in pictures twice as large, as those of 12 megapixels and more are.
#![allow(clippy::unwrap_used)] // a test may

use cards::{Gps, SimulatedCard};
use glam::DVec3;
use models::align::similarity::{Similarity, umeyama};

#[path = "support/cards.rs"]
mod cards;

/// Cards of the ordinary run: each way of flying, each kind of positions, lenses far from what is stated.
const USUAL: [u64; 6] = [1, 2, 7, 10, 68, 95];

/// What one card came to.
#[derive(Debug, Default)]
struct Outcome {
    wanted: usize,
    /// Of those.
    tied: usize,
    /// Said to be placed, and further off than three of their standard deviations and half a metre.
    lies: Vec<(String, f64, f64)>,
    reprojection_px: f64,
}

fn outcome(seed: u64, times: u32) -> Outcome {
    let card = SimulatedCard::new(seed, times);
    let (refiner, report, floats) = card.settle();
    let wanted = card.overlapping();
    let tied: Vec<usize> = (0..card.truth.len()).filter(|i| refiner.is_tied(&cards::name(*i))).collect();
    let found: Vec<DVec3> = tied.iter().map(|i| refiner.pose(&cards::name(*i)).unwrap().center).collect();
    let truth: Vec<DVec3> = tied.iter().map(|i| card.truth[*i].center).collect();
    let alike = robust(&found, &truth);
    let by = if floats { alike } else { Some(Similarity::IDENTITY) };
    let mut out = Outcome { wanted: wanted.len(), ..Outcome::default() };
    out.tied = wanted.iter().filter(|i| tied.contains(i)).count();
    out.reprojection_px = report.reprojection_rms_px;
    for (k, i) in tied.iter().enumerate() {
        let Some(by) = &by else { continue };
        let sigma = refiner.precision(&cards::name(*i)).map_or(0.0, |p| p.distance()) * by.scale;
        let off = by.apply(found[k]).distance(truth[k]);
        if off > 3.0 * sigma + 0.5 {
            out.lies.push((cards::name(*i), off, sigma));
        }
    }
    let worst = |by: &Similarity| found.iter().zip(&truth).map(|(a, b)| by.apply(*a).distance(*b)).fold(0.0, f64::max);
    println!(
        "   lens x {:.3} k1 {:.3}, {:.2} m off at most within the scene (scale {:.3})",
        report.shared.focal_scale,
        report.shared.radial[0],
        alike.as_ref().map_or(0.0, worst),
        alike.as_ref().map_or(0.0, |by| by.scale)
    );
    println!(
        "{seed}: {card}: {} of {} tied ({} in all of {}), {:.2} px, {} off by more than they say {:?}",
        out.tied,
        out.wanted,
        tied.len(),
        card.truth.len(),
        out.reprojection_px,
        out.lies.len(),
        out.lies.iter().map(|l| format!("{} {:.2} ({:.2})", l.0, l.1, l.2)).take(4).collect::<Vec<_>>()
    );
    out
}

/// The similarity that most agree with.
fn robust(from: &[DVec3], to: &[DVec3]) -> Option<Similarity> {
    let mut by = umeyama(from, to, None).ok()?;
    for _ in 0..8 {
        let off: Vec<f64> = from.iter().zip(to).map(|(a, b)| by.apply(*a).distance(*b)).collect();
        let mut sorted = off.clone();
        sorted.sort_by(f64::total_cmp);
        let usual = sorted[sorted.len() / 2].max(1e-9);
        let weights: Vec<f64> = off.iter().map(|o| 1.0 / (1.0 + (o / (2.0 * usual)).powi(2))).collect();
        by = umeyama(from, to, Some(&weights)).ok()?;
    }
    Some(by)
}

#[test]
fn pictures_of_made_up_cards_that_overlap_are_tied_and_none_is_further_off_than_it_says() {
    let asked = |name: &str| std::env::var(name).ok().and_then(|n| n.parse::<u64>().ok());
    let first = asked("DGTR_FIRST_CARD").unwrap_or(0);
    let seeds: Vec<u64> = match asked("DGTR_CARDS") {
        Some(cards) => (first..first + cards).collect(),
        None => USUAL.to_vec(),
    };
    let times = asked("DGTR_CARD_DETAIL").unwrap_or(1) as u32;
    let all: Vec<Outcome> = seeds.into_iter().map(|seed| outcome(seed, times)).collect();
    let (wanted, tied) = (all.iter().map(|o| o.wanted).sum::<usize>(), all.iter().map(|o| o.tied).sum::<usize>());
    let lies: usize = all.iter().map(|o| o.lies.len()).sum();
    println!("{tied} of {wanted} pictures that overlap are tied, {lies} are further off than they say");
    assert!(wanted > 8 * all.len(), "{wanted} overlap");
    assert!(tied as f64 >= 0.98 * wanted as f64, "{tied} of {wanted}");
    assert_eq!(lies, 0);
    // Key points are off by 0.7 pixels along each axis.
    assert!(all.iter().all(|o| o.reprojection_px < 1.4));
}

#[test]
fn cards_of_every_kind_are_made() {
    let all: Vec<SimulatedCard> = (0..40).map(|seed| SimulatedCard::new(seed, 1)).collect();
    for gps in [Gps::None, Gps::Wrong, Gps::Noisy, Gps::Half] {
        assert!(all.iter().any(|c| c.gps == gps), "{gps:?}");
    }
    assert!(all.iter().any(|c| c.k1 < -0.2) && all.iter().any(|c| c.k1 > 0.0));
    assert!(all.iter().any(|c| c.focal_off < 0.9) && all.iter().any(|c| c.focal_off > 1.1));
}

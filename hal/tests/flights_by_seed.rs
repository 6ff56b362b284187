//! Flights by seed on a simulated clock, capture and matching only: intervals, latencies, late and lost announcements by chance. No
//! picture gets another exposure's pose with confidence above 0.9.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use hal::matcher::*;
use hal::traits::PictureClues;
use hal::trigger::*;
const S: f64 = 1e9;
struct R(u64);
impl R {
    fn u(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        let x = self.0 ^ (self.0 >> 33);
        ((x.wrapping_mul(0xff51afd7ed558ccd)) >> 11) as f64 / (1u64 << 53) as f64
    }
    fn r(&mut self, a: f64, b: f64) -> f64 {
        a + (b - a) * self.u()
    }
}
#[derive(Default, Debug)]
struct Tally {
    flights: usize,
    pictures: usize,
    wrong_sure: usize,
    wrong: usize,
    posed: usize,
    right: usize,
    inflight: usize,
    ambiguous: usize,
}
fn flight(seed: u64, t: &mut [Tally; 2], verbose: bool) {
    let mut r = R(seed * 7919 + 13);
    for _ in 0..5 {
        r.u();
    }
    let rate = r.r(0.3, 3.0);
    let latency = r.r(0.0, 4.0);
    let jitter = r.r(0.01, 0.08);
    let n = r.r(15.0, 70.0) as usize;
    let lost_e = if r.u() < 0.5 { 0.0 } else { r.r(0.0, 0.2) };
    let lost_p = if r.u() < 0.5 { 0.0 } else { r.r(0.0, 0.2) };
    let doubled = if r.u() < 0.5 { 0.0 } else { r.r(0.0, 0.2) };
    let reordered = if r.u() < 0.5 { 0.0 } else { r.r(0.0, 0.2) };
    let delay = if r.u() < 0.5 { r.r(0.0, 0.2) } else { r.r(0.0, 4.0) };
    let numbers = r.u() < 0.7;
    let exif = r.u() < 0.4;
    let regular = r.u() < 0.3;
    let skip = if r.u() < 0.7 { 0.0 } else { r.r(0.0, 0.1) };
    let _ = doubled;
    let mut times = vec![];
    let mut at = 20.0;
    let line = r.r(4.0, 12.0) as usize;
    for k in 0..n {
        times.push(at);
        at += if regular {
            rate
        } else {
            rate * r.r(0.85, 1.15) + if k % line == line - 1 { r.r(0.5, 3.0) * rate } else { 0.0 }
        };
    }
    // events
    enum E {
        T(Trigger),
        P(PictureClues, usize),
    }
    let mut ev: Vec<(f64, E)> = vec![];
    let mut number = 100;
    let mut lost_any = 0;
    for (k, at) in times.iter().enumerate() {
        let t = Trigger {
            source: Source::default(),
            sequence: k as u32 + 1,
            boot_ns: (at * S) as u64,
            time_ns: ((at + r.r(-0.005, 0.005)) * S) as u64,
            sigma_ns: 2_000_000,
            kind: TriggerKind::Feedback,
        };
        if r.u() >= lost_e {
            let d = delay + r.r(0.0, 0.05) + if r.u() < reordered { r.r(0.0, 1.5 * rate) } else { 0.0 };
            ev.push((at + d, E::T(t)));
        } else {
            lost_any += 1;
        }
        if r.u() < skip {
            continue;
        }
        number += 1;
        if r.u() < lost_p {
            lost_any += 1;
            continue;
        }
        let a =
            at + latency + r.r(0.0, jitter) * 2.0 + if r.u() < reordered * 0.3 { r.r(0.0, 1.5 * rate) } else { 0.0 };
        let c = PictureClues {
            arrived_ns: (a * S) as u64,
            number: numbers.then_some(number),
            camera_ns: exif.then_some(((at + 7777.3).floor() * S) as u64),
            camera_resolution_ns: 1_000_000_000,
            ..Default::default()
        };
        ev.push((a, E::P(c, k)));
    }
    ev.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut m: Matcher<usize> = Matcher::new(MatcherSettings::default());
    let mut posed: Vec<(usize, u32, f32, bool)> = vec![];
    let mut found: Vec<(Trigger, PictureClues, usize)> = vec![];
    let mut aside: Vec<(PictureClues, usize)> = vec![];
    let mut all: Vec<Trigger> = vec![];
    let take = |o: Outcome<usize>,
                posed: &mut Vec<(usize, u32, f32, bool)>,
                found: &mut Vec<(Trigger, PictureClues, usize)>,
                aside: &mut Vec<(PictureClues, usize)>| match o {
        Outcome::Matched { trigger, picture, clues, confidence, .. } => {
            posed.push((picture, trigger.sequence - 1, confidence, true));
            found.push((trigger, clues, picture));
        }
        Outcome::Picture { picture, clues, reason } => {
            if reason != Reason::Duplicate {
                aside.push((clues, picture))
            }
        }
        _ => {}
    };
    let possible = ev
        .iter()
        .filter(|e| {
            if let E::P(_, k) = &e.1 {
                ev.iter().any(|f| if let E::T(t) = &f.1 { t.sequence as usize - 1 == *k } else { false })
            } else {
                false
            }
        })
        .count();
    let np = ev.iter().filter(|e| matches!(e.1, E::P(..))).count();
    let announced: std::collections::HashSet<u32> =
        ev.iter().filter_map(|e| if let E::T(t) = &e.1 { Some(t.sequence - 1) } else { None }).collect();
    let mut now = 20.0;
    let mut q = ev.into_iter().peekable();
    let mut frac = 0;
    while q.peek().is_some() || frac < 20 {
        if q.peek().is_none() {
            frac += 1;
        }
        now += 0.1;
        while q.peek().is_some_and(|e| e.0 <= now) {
            let e = q.next().unwrap();
            let o = match e.1 {
                E::T(t) => {
                    all.push(t);
                    m.push_trigger(t)
                }
                E::P(c, k) => m.push_picture(c, k),
            };
            if let Some(o) = o {
                take(o, &mut posed, &mut found, &mut aside);
            }
        }
        while let Some(o) = m.poll((now * S) as u64) {
            take(o, &mut posed, &mut found, &mut aside);
        }
    }
    while let Some(o) = m.flush() {
        take(o, &mut posed, &mut found, &mut aside);
    }
    // landing
    all.sort_by_key(|t| t.time_ns);
    let known: Vec<(Trigger, PictureClues)> = found.iter().map(|f| (f.0, f.1)).collect();
    let waiting: Vec<PictureClues> = aside.iter().map(|a| a.0).collect();
    let (pairs, revised) = landing::settle(&all, &waiting, &known, MatcherSettings::default());
    for p in &pairs {
        posed.push((aside[p.picture].1, all[p.exposure].sequence - 1, p.confidence, false));
    }
    for x in revised {
        let k = found[x].2;
        for p in posed.iter_mut().filter(|p| p.0 == k && p.3) {
            p.2 = p.2.min(0.49);
        }
    }
    let i = usize::from(regular);
    let t = &mut t[i];
    t.flights += 1;
    t.pictures += possible;
    let _ = lost_any;
    let wrong: Vec<_> = posed.iter().filter(|p| p.0 as u32 != p.1).collect();
    let ws = wrong.iter().filter(|p| p.2 > 0.9).count();
    if verbose || ws > 0 {
        println!(
            "seed {seed} rate {rate:.2} lat {latency:.2} jit {jitter:.2} n {n} lostE {lost_e:.2} lostP {lost_p:.2} reord {reordered:.2} delay {delay:.2} numbers {numbers} exif {exif} regular {regular} skip {skip:.2}: posed {} of {np}, wrong {} sure {} inflight {} first wrong {:?}",
            posed.len(),
            wrong.len(),
            ws,
            posed.iter().filter(|p| p.3).count(),
            wrong.iter().take(6).collect::<Vec<_>>()
        );
    }
    t.wrong += wrong.len();
    t.wrong_sure += ws;
    t.posed += posed.iter().filter(|p| announced.contains(&(p.0 as u32))).count();
    t.inflight += posed.iter().filter(|p| p.3).count();
    t.right += posed.iter().filter(|p| p.0 as u32 == p.1).count();
    t.ambiguous += usize::from(posed.iter().any(|p| p.2 <= 0.9));
}

#[test]
fn no_picture_of_any_flight_is_surely_another_exposures_and_where_the_rhythm_tells_nearly_all_are_posed() {
    let flights = std::env::var("DGTR_FLIGHTS").ok().and_then(|n| n.parse().ok()).unwrap_or(150);
    let mut tallies = [Tally::default(), Tally::default()];
    for seed in 0..flights {
        flight(seed, &mut tallies, false);
    }
    let [irregular, regular] = tallies;
    assert_eq!((irregular.wrong_sure, regular.wrong_sure), (0, 0), "{irregular:?} {regular:?}");
    assert!(irregular.right * 100 >= 99 * irregular.pictures, "{irregular:?}");
}

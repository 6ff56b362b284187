//! The matcher alone, by seed on a simulated clock: one camera, whose announcements are late, lost and reordered by chance. Nearly all
//! pictures are posed in flight; `flights_by_seed.rs` flies with the whole HAL around it.
//!
//! `DGTR_FLIGHTS=2000` flies as many.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[allow(dead_code, reason = "flights of the whole HAL draw more")]
#[path = "seeded/chance.rs"]
mod chance;

use std::collections::HashSet;

use chance::{Chance, Rhythm};
use hal::matcher::{Matcher, MatcherSettings, Outcome, Reason, landing};
use hal::traits::PictureClues;
use hal::trigger::{Source, Trigger, TriggerKind};

/// Nanoseconds of a second.
const SECOND: f64 = 1e9;
/// The camera's clock is ahead of the autopilot's by this, s.
const CAMERA_AHEAD_S: f64 = 7777.3;
/// The flight goes on after the last event for this many tenths of a second.
const AFTER_TENTHS: usize = 20;

/// What vehicle, link and camera of a flight are like. Times in seconds, shares 0 … 1.
#[derive(Debug)]
struct Conditions {
    interval: f64,
    latency: f64,
    jitter: f64,
    exposures: usize,
    lost_announcements: f64,
    lost_pictures: f64,
    reordered: f64,
    announced_after: f64,
    numbered: bool,
    camera_clock: bool,
    /// Always the same interval: nothing tells one exposure from the next but the flight's ends.
    regular: bool,
    not_taken: f64,
    /// Exposures of one survey line.
    line: usize,
}

impl Conditions {
    fn by_chance(chance: &mut Chance) -> Self {
        Self {
            interval: chance.between(0.3, 3.0),
            latency: chance.between(0.0, 4.0),
            jitter: chance.between(0.01, 0.08),
            exposures: chance.between(15.0, 70.0) as usize,
            lost_announcements: chance.sometimes(0.5, 0.2),
            lost_pictures: chance.sometimes(0.5, 0.2),
            reordered: chance.sometimes(0.5, 0.2),
            announced_after: if chance.unit() < 0.5 { chance.between(0.0, 0.2) } else { chance.between(0.0, 4.0) },
            numbered: chance.unit() < 0.7,
            camera_clock: chance.unit() < 0.4,
            regular: chance.unit() < 0.3,
            not_taken: chance.sometimes(0.7, 0.1),
            line: chance.between(4.0, 12.0) as usize,
        }
    }

    /// When the shutter opened.
    fn times(&self, chance: &mut Chance) -> Vec<f64> {
        Rhythm { interval: self.interval, regular: self.regular, line: self.line }.times(chance, 20.0, self.exposures)
    }

    fn late(&self, chance: &mut Chance, share: f64) -> f64 {
        if chance.unit() < share { chance.between(0.0, 1.5 * self.interval) } else { 0.0 }
    }

    /// All that reaches the aircraft, in the order in which it does.
    fn events(&self, chance: &mut Chance) -> Vec<(f64, Event)> {
        let mut events = vec![];
        let mut number = 100;
        for (k, at) in self.times(chance).into_iter().enumerate() {
            let trigger = Trigger {
                source: Source::default(),
                sequence: k as u32 + 1,
                boot_ns: (at * SECOND) as u64,
                time_ns: ((at + chance.between(-0.005, 0.005)) * SECOND) as u64,
                sigma_ns: 2_000_000,
                kind: TriggerKind::Feedback,
            };
            if chance.unit() >= self.lost_announcements {
                let heard = at + self.announced_after + chance.between(0.0, 0.05) + self.late(chance, self.reordered);
                events.push((heard, Event::Announced(trigger)));
            }
            if chance.unit() < self.not_taken {
                continue;
            }
            number += 1;
            if chance.unit() < self.lost_pictures {
                continue;
            }
            let whole =
                at + self.latency + 2.0 * chance.between(0.0, self.jitter) + self.late(chance, 0.3 * self.reordered);
            let clues = PictureClues {
                arrived_ns: (whole * SECOND) as u64,
                number: self.numbered.then_some(number),
                camera_ns: self.camera_clock.then_some(((at + CAMERA_AHEAD_S).floor() * SECOND) as u64),
                camera_resolution_ns: 1_000_000_000,
                ..Default::default()
            };
            events.push((whole, Event::Taken(clues, k)));
        }
        events.sort_by(|a, b| a.0.total_cmp(&b.0));
        events
    }
}

enum Event {
    Announced(Trigger),
    /// A picture is complete; whose exposure it is.
    Taken(PictureClues, usize),
}

/// A picture that was posed.
#[derive(Clone, Copy, Debug)]
struct Posed {
    picture: usize,
    exposure: usize,
    confidence: f32,
    in_flight: bool,
}

/// What the matcher gave out.
#[derive(Default)]
struct Given {
    posed: Vec<Posed>,
    known: Vec<(Trigger, PictureClues)>,
    waiting: Vec<(PictureClues, usize)>,
}

impl Given {
    fn take(&mut self, outcome: Outcome<usize>) {
        match outcome {
            Outcome::Matched { trigger, picture, clues, confidence, .. } => {
                self.posed.push(Posed {
                    picture,
                    exposure: trigger.sequence as usize - 1,
                    confidence,
                    in_flight: true,
                });
                self.known.push((trigger, clues));
            }
            Outcome::Picture { picture, clues, reason } if reason != Reason::Duplicate => {
                self.waiting.push((clues, picture));
            }
            Outcome::Picture { .. } | Outcome::Trigger { .. } => {}
        }
    }

    /// The comparison at the landing pairs what waits. What it says otherwise of stays as it was given out in flight.
    fn land(mut self, mut exposures: Vec<Trigger>) -> Vec<Posed> {
        exposures.sort_by_key(|t| t.time_ns);
        let waiting: Vec<PictureClues> = self.waiting.iter().map(|w| w.0).collect();
        let pairs = landing::settle(&exposures, &waiting, &self.known, MatcherSettings::default()).pairs;
        self.posed.extend(pairs.iter().map(|pair| Posed {
            picture: self.waiting[pair.picture].1,
            exposure: exposures[pair.exposure].sequence as usize - 1,
            confidence: pair.confidence,
            in_flight: false,
        }));
        self.posed
    }
}

/// Flies, and lands.
fn fly(events: Vec<(f64, Event)>) -> Vec<Posed> {
    let mut matcher: Matcher<usize> = Matcher::new(MatcherSettings::default());
    let (mut given, mut exposures) = (Given::default(), vec![]);
    let mut events = events.into_iter().peekable();
    let (mut now, mut after) = (20.0, 0);
    while events.peek().is_some() || after < AFTER_TENTHS {
        after += usize::from(events.peek().is_none());
        now += 0.1;
        while let Some((_, event)) = events.next_if(|e| e.0 <= now) {
            let evicted = match event {
                Event::Announced(trigger) => {
                    exposures.push(trigger);
                    matcher.push_trigger(trigger)
                }
                Event::Taken(clues, picture) => matcher.push_picture(clues, picture),
            };
            evicted.into_iter().for_each(|outcome| given.take(outcome));
        }
        while let Some(outcome) = matcher.poll((now * SECOND) as u64) {
            given.take(outcome);
        }
    }
    while let Some(outcome) = matcher.flush() {
        given.take(outcome);
    }
    given.land(exposures)
}

/// Sums over flights.
#[derive(Default, Debug)]
struct Tally {
    /// Pictures whose exposure was announced.
    possible: usize,
    right: usize,
    /// Of those, the ones that did not wait for the landing.
    in_flight: usize,
    wrong: usize,
    /// Wrong with a confidence above 0.9.
    surely_wrong: usize,
}

impl Tally {
    fn add(&mut self, seed: u64) -> bool {
        let mut chance = Chance::new(seed);
        let conditions = Conditions::by_chance(&mut chance);
        let events = conditions.events(&mut chance);
        let announced: HashSet<usize> = events
            .iter()
            .filter_map(|e| if let Event::Announced(t) = &e.1 { Some(t.sequence as usize - 1) } else { None })
            .collect();
        let possible = |e: &&(f64, Event)| matches!(&e.1, Event::Taken(_, k) if announced.contains(k));
        self.possible += events.iter().filter(possible).count();
        let posed = fly(events);
        let wrong: Vec<&Posed> = posed.iter().filter(|p| p.picture != p.exposure).collect();
        let surely = wrong.iter().filter(|p| p.confidence > 0.9).count();
        if surely > 0 {
            println!("seed {seed}: {conditions:?}: {surely} surely wrong: {wrong:?}");
        }
        self.right += posed.len() - wrong.len();
        self.in_flight += posed.iter().filter(|p| p.in_flight && p.picture == p.exposure).count();
        self.wrong += wrong.len();
        self.surely_wrong += surely;
        conditions.regular
    }
}

#[test]
fn no_match_is_surely_another_exposures_and_where_the_rhythm_tells_most_need_not_wait_for_the_landing() {
    let flights = std::env::var("DGTR_FLIGHTS").ok().and_then(|n| n.parse().ok()).unwrap_or(150);
    let [mut irregular, mut regular] = [Tally::default(), Tally::default()];
    for seed in 0..flights {
        let mut flight = Tally::default();
        let sum = if flight.add(seed) { &mut regular } else { &mut irregular };
        sum.possible += flight.possible;
        sum.right += flight.right;
        sum.in_flight += flight.in_flight;
        sum.wrong += flight.wrong;
        sum.surely_wrong += flight.surely_wrong;
    }
    println!("{flights} flights, irregular: {irregular:?}, regular: {regular:?}");
    assert_eq!((irregular.surely_wrong, regular.surely_wrong), (0, 0), "{irregular:?} {regular:?}");
    assert!(irregular.right * 100 >= 99 * irregular.possible, "{irregular:?}");
    assert!(irregular.in_flight * 100 >= 85 * irregular.possible, "most need not wait for the landing: {irregular:?}");
}

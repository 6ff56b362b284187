//! Boot time ↔ companion time. TIMESYNC round trips give pairs with a known error; without answers (a recording, an
//! autopilot that does not answer) the earliest arrivals of stamped messages do. The rate is 1 unless the pairs plainly
//! say otherwise: crystals differ by 50 ppm, simulators run at 8×.

use heapless::Deque;

/// Pairs kept.
const PAIRS: usize = 32;
/// Pairs that decide the offset once the rate is known: the newest.
const RECENT: usize = 8;
/// Passive arrivals are reduced to the earliest within this span.
const BIN_NS: u64 = 250_000_000;
/// TIMESYNC is trusted alone for this long after an answer.
const TIMESYNC_HOLD_NS: u64 = 10_000_000_000;
/// Round trips longer than this are not worth using on a link that ever does better (PX4 uses 10 ms as well).
const RTT_SLACK_NS: u64 = 10_000_000;
/// A pair this far from the others is an outlier; this many in a row are a step of the clock (PX4: 5). Arrivals over a
/// telemetry radio jitter by hundreds of milliseconds.
const OUTLIER_NS: f64 = 50e6;
const PASSIVE_OUTLIER_NS: f64 = 1e9;
const OUTLIERS: u8 = 5;
/// Uncertainty of a passive pair: unknown delay of the link.
const PASSIVE_SIGMA_NS: u64 = 10_000_000;
/// Deviation of the rate from 1 that is believed, over short and long spans of pairs; of arrivals more is asked.
const RATE_SHORT: f64 = 0.05;
const RATE_LONG: f64 = 0.005;
const PASSIVE_DOUBT: f64 = 10.0;
const LONG_SPAN_S: f64 = 4.0;

#[derive(Clone, Copy, Debug)]
struct Pair {
    companion_ns: u64,
    boot_ns: u64,
    sigma_ns: u64,
}

/// The line boot = boot₀ + rate · (companion − companion₀).
#[derive(Clone, Copy, Debug)]
struct Fit {
    companion_ns: u64,
    boot_ns: f64,
    rate: f64,
    sigma_ns: u64,
}

/// The mapping between the two clocks.
#[derive(Default)]
pub struct ClockMap {
    pairs: Deque<Pair, PAIRS>,
    fit: Option<Fit>,
    /// Rate before the last jump: a clock that was set goes on as fast as before.
    known_rate: Option<f64>,
    /// Start of the current span of arrivals, and the best of them.
    bin: Option<(u64, Pair)>,
    active: bool,
    last_answer_ns: Option<u64>,
    least_rtt_ns: Option<u64>,
    outliers: u8,
    steps: u32,
    rejected: u32,
}

impl ClockMap {
    /// A TIMESYNC round trip: sent and received on the companion's clock, answered at `boot_ns`.
    pub fn round_trip(&mut self, sent_ns: u64, received_ns: u64, boot_ns: u64) {
        let Some(rtt) = received_ns.checked_sub(sent_ns) else { return };
        let starved = self.last_answer_ns.is_none_or(|t| received_ns.saturating_sub(t) > TIMESYNC_HOLD_NS);
        let least = self.least_rtt_ns.map_or(rtt, |least| least.min(rtt));
        if rtt > 2 * least + RTT_SLACK_NS && !starved {
            self.rejected += 1;
            return;
        }
        self.least_rtt_ns = Some(least);
        if !self.active {
            self.active = true;
            self.pairs.clear();
        }
        let pair = Pair { companion_ns: sent_ns + rtt / 2, boot_ns, sigma_ns: (rtt / 4).max(50_000) };
        if self.add(pair) {
            self.last_answer_ns = Some(received_ns);
        }
    }

    /// A message stamped `boot_ns` arrived; used only while TIMESYNC is not answered.
    pub fn arrival(&mut self, arrived_ns: u64, boot_ns: u64) {
        if self.last_answer_ns.is_some_and(|t| arrived_ns.saturating_sub(t) < TIMESYNC_HOLD_NS) {
            return;
        }
        self.active = false;
        let pair = Pair { companion_ns: arrived_ns, boot_ns, sigma_ns: PASSIVE_SIGMA_NS };
        let rate = self.rate();
        match &mut self.bin {
            Some((since_ns, best)) if arrived_ns.wrapping_sub(*since_ns) < BIN_NS => {
                // The one with the least delay is furthest ahead on the boot clock.
                let elapsed = arrived_ns.saturating_sub(best.companion_ns) as f64 * rate;
                if boot_ns as f64 > best.boot_ns as f64 + elapsed {
                    *best = pair;
                }
            }
            Some((_, best)) => {
                let best = *best;
                self.bin = Some((arrived_ns, pair));
                self.add(best);
            }
            None => {
                self.bin = Some((arrived_ns, pair));
                self.add(pair);
            }
        }
    }

    /// Companion time of a boot time; `None` before the first pair.
    pub fn to_companion_ns(&self, boot_ns: u64) -> Option<u64> {
        let fit = self.fit?;
        let elapsed = (boot_ns as f64 - fit.boot_ns) / fit.rate;
        Some(fit.companion_ns.saturating_add_signed(elapsed as i64))
    }

    /// Boot time of a companion time; `None` before the first pair.
    pub fn to_boot_ns(&self, companion_ns: u64) -> Option<u64> {
        let fit = self.fit?;
        let elapsed = (companion_ns as i64).wrapping_sub(fit.companion_ns as i64) as f64 * fit.rate;
        let boot = fit.boot_ns + elapsed;
        if boot >= 0.0 { Some(boot as u64) } else { None }
    }

    /// Boot seconds per companion second.
    pub fn rate(&self) -> f64 {
        self.fit.map_or(self.known_rate.unwrap_or(1.0), |f| f.rate)
    }

    /// One standard deviation of the mapping, companion ns.
    pub fn sigma_ns(&self) -> u64 {
        self.fit.map_or(u64::MAX, |f| f.sigma_ns)
    }

    /// How often a clock stepped.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// Round trips and pairs not used.
    pub fn rejected(&self) -> u32 {
        self.rejected
    }

    /// Forgets everything but the rate, for a restarted autopilot.
    pub fn reset(&mut self) {
        let known_rate = self.fit.map(|f| f.rate).or(self.known_rate);
        *self = Self { steps: self.steps, rejected: self.rejected, known_rate, ..Self::default() };
    }

    fn add(&mut self, pair: Pair) -> bool {
        if let Some(fit) = self.fit
            && self.pairs.len() >= 4
        {
            let limit = if self.active { OUTLIER_NS + 3.0 * pair.sigma_ns as f64 } else { PASSIVE_OUTLIER_NS };
            let expected = fit.boot_ns + (pair.companion_ns as f64 - fit.companion_ns as f64) * fit.rate;
            if (pair.boot_ns as f64 - expected).abs() / fit.rate > limit {
                self.outliers += 1;
                self.rejected += 1;
                if self.outliers < OUTLIERS {
                    return false;
                }
                self.pairs.clear();
                self.known_rate = Some(fit.rate);
                self.steps += 1;
            }
        }
        self.outliers = 0;
        if self.pairs.is_full() {
            self.pairs.pop_front();
        }
        // Not full any more, so this cannot fail.
        let _ = self.pairs.push_back(pair);
        self.refit();
        true
    }

    fn refit(&mut self) {
        let Some(&last) = self.pairs.back() else { return };
        let xy = |p: &Pair| {
            let x = (p.companion_ns as i64 - last.companion_ns as i64) as f64 * 1e-9;
            (x, (p.boot_ns as i64 - last.boot_ns as i64) as f64 * 1e-9)
        };
        let n = self.pairs.len() as f64;
        let (sx, sy) = self.pairs.iter().map(xy).fold((0.0, 0.0), |a, p| (a.0 + p.0, a.1 + p.1));
        let (mx, my) = (sx / n, sy / n);
        let (sxx, sxy) = self
            .pairs
            .iter()
            .map(xy)
            .fold((0.0, 0.0), |a, (x, y)| (a.0 + (x - mx) * (x - mx), a.1 + (x - mx) * (y - my)));
        let span = self.pairs.front().map_or(0.0, |p| -xy(p).0);
        let slope = if self.pairs.len() >= 3 && sxx > 1e-6 { sxy / sxx } else { self.known_rate.unwrap_or(1.0) };
        let doubt = if self.active { 1.0 } else { PASSIVE_DOUBT };
        let believed = doubt * if span > LONG_SPAN_S { RATE_LONG } else { RATE_SHORT };
        let rate = if (slope - 1.0).abs() > believed && slope.is_finite() && slope > 0.01 { slope } else { 1.0 };
        let skip = self.pairs.len().saturating_sub(RECENT);
        let recent = || self.pairs.iter().skip(skip).map(|p| (xy(p), p.sigma_ns as f64));
        let offset = if self.active {
            let (weighted, weights) = recent().fold((0.0, 0.0), |a, ((x, y), s)| {
                let w = 1.0 / (s * s);
                (a.0 + w * (y - rate * x), a.1 + w)
            });
            weighted / weights
        } else {
            // Delays only make messages late: the earliest one tells most.
            recent().map(|((x, y), _)| y - rate * x).fold(f64::NEG_INFINITY, f64::max)
        };
        self.fit = Some(Fit {
            companion_ns: last.companion_ns,
            boot_ns: last.boot_ns as f64 + offset * 1e9,
            rate,
            sigma_ns: last.sigma_ns,
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    const S: u64 = 1_000_000_000;
    const MS: u64 = 1_000_000;

    /// Deterministic delays of 1 to 8 ms.
    fn delays() -> impl Iterator<Item = u64> {
        let mut state = 7u64;
        core::iter::repeat_with(move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            MS + (state >> 33) % (7 * MS)
        })
    }

    fn error_ms(map: &ClockMap, companion: u64, boot: u64) -> f64 {
        (map.to_boot_ns(companion).expect("mapped") as f64 - boot as f64) / MS as f64
    }

    #[test]
    fn round_trips_map_the_clocks_within_two_milliseconds() {
        let mut map = ClockMap::default();
        let mut delay = delays();
        for i in 0..40 {
            let (there, back) = (delay.next().expect("endless"), delay.next().expect("endless"));
            let sent = 100 * S + i * S;
            map.round_trip(sent, sent + there + back, sent + there - 90 * S);
        }
        assert!(error_ms(&map, 200 * S, 110 * S).abs() < 2.0);
        assert_eq!(map.rate(), 1.0);
    }

    #[test]
    fn a_simulator_at_eight_times_real_time_is_followed_from_arrivals_alone() {
        let mut map = ClockMap::default();
        let mut delay = delays();
        for i in 0..200u64 {
            let sent = 100 * S + i * 40 * MS;
            map.arrival(sent + delay.next().expect("endless"), 5 * S + (sent - 100 * S) * 8);
        }
        let companion = 107 * S;
        assert!((map.rate() - 8.0).abs() < 0.05, "{}", map.rate());
        assert!(error_ms(&map, companion, 5 * S + 7 * S * 8).abs() < 8.0 * 6.0);
        let back = map.to_companion_ns(map.to_boot_ns(companion).expect("mapped")).expect("mapped");
        assert!(back.abs_diff(companion) < 1000);
    }

    #[test]
    fn the_rate_of_a_fast_simulator_outlives_a_jump_of_its_clock() {
        let mut map = ClockMap::default();
        for i in 0..10 {
            map.round_trip(i * S, i * S + 2 * MS, 8 * (i * S + MS));
        }
        map.reset();
        assert_eq!(map.to_boot_ns(11 * S), None, "what was known is gone");
        map.round_trip(10 * S, 10 * S + 2 * MS, 8 * (10 * S + MS) + 500 * S);
        assert!(error_ms(&map, 12 * S, 8 * 12 * S + 500 * S).abs() < 20.0, "one pair and the known rate");
    }

    #[test]
    fn one_late_answer_is_ignored_and_a_step_of_the_clock_is_followed() {
        let mut map = ClockMap::default();
        for i in 0..10 {
            map.round_trip(i * S, i * S + 2 * MS, i * S + MS + 50 * S);
        }
        map.round_trip(10 * S, 10 * S + 900 * MS, 10 * S + 890 * MS + 50 * S);
        assert!(error_ms(&map, 11 * S, 61 * S).abs() < 0.1);
        let errors: Vec<f64> = (11..25)
            .map(|i| {
                map.round_trip(i * S, i * S + 2 * MS, i * S + MS + 53 * S);
                error_ms(&map, i * S, (i + 53) * S)
            })
            .collect();
        assert!(errors[0] < -2999.0 && errors[13].abs() < 0.1, "{errors:?}");
        assert_eq!(map.steps(), 1);
    }
}

//! A hot-shoe that blinks twice a picture, at the shutter and again when the picture is on the card: every exposure is announced twice,
//! the second time late by however long writing took. The shutter is the one of the two that keeps the flight's rhythm.

use crate::trigger::Trigger;

/// Announcements that show a rhythm.
const LEAST: usize = 12;
/// The shutter's intervals vary by so much less than those of the other one, and than those between both, where so many announcements
/// show it. Of fewer it is asked for more: of twelve that are all exposures, one flight in ten looks so by chance.
const STEADIER: f64 = 0.35;
const SHOWN_BY: f64 = 40.0;
/// No clock of announcements is better, seconds.
const RESOLUTION_S: f64 = 0.002;
/// Pictures may be missing or too many by this share.
const PICTURES: f64 = 0.15;

/// Which of `exposures` (by time) are the shutter's, where each of about `pictures` pictures has two; `None` where the rhythm does not
/// say so.
pub fn shutters(exposures: &[Trigger], pictures: usize) -> Option<Vec<usize>> {
    if exposures.len() < LEAST {
        return None;
    }
    // By the counter where it counts: an announcement that was lost must not exchange the two.
    let counts = exposures.windows(2).all(|w| (1..=8).contains(&w[1].sequence.wrapping_sub(w[0].sequence)));
    let place = |k: usize| if counts { exposures[k].sequence.wrapping_sub(exposures[0].sequence) as usize } else { k };
    let of = |phase: usize| -> Vec<usize> { (0..exposures.len()).filter(|&k| place(k) % 2 == phase).collect() };
    let spread =
        |of: &[usize]| around_median(of.windows(2).map(|w| seconds(&exposures[w[0]], &exposures[w[1]])).collect());
    let all: Vec<usize> = (0..exposures.len()).collect();
    let (first, second) = (of(0), of(1));
    let (a, b, between) = (spread(&first)?, spread(&second)?, spread(&all)?);
    let (steady, other, shutters) = if a <= b { (a, b, first) } else { (b, a, second) };
    let fits = (pictures as f64 - shutters.len() as f64).abs() <= (PICTURES * shutters.len() as f64).max(1.0);
    let most = STEADIER * (exposures.len() as f64 / SHOWN_BY).min(1.0) * other.min(between);
    (fits && steady <= most).then_some(shutters)
}

fn seconds(a: &Trigger, b: &Trigger) -> f64 {
    b.time_ns.saturating_sub(a.time_ns) as f64 * 1e-9
}

/// Median distance from the median: turns between lines and announcements that were lost count little.
fn around_median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let median = *values.get(values.len() / 2)?;
    values.iter_mut().for_each(|v| *v = (*v - median).abs());
    values.sort_by(f64::total_cmp);
    Some(values[values.len() / 2] + RESOLUTION_S)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trigger::{Source, TriggerKind};

    fn trigger(sequence: u32, s: f64) -> Trigger {
        let time_ns = (s * 1e9) as u64;
        let (source, kind) = (Source::default(), TriggerKind::Feedback);
        Trigger { source, sequence, boot_ns: time_ns, time_ns, sigma_ns: 1_000_000, kind }
    }

    /// Numbers that look random, 0 to 1.
    fn noise(k: usize) -> f64 {
        (k as f64 * 0.618_033_988).fract()
    }

    /// A picture every two seconds along lines with a pause between, its second blink 0.7 to 1.3 s later.
    fn blinks(pictures: usize) -> Vec<Trigger> {
        let shutter = |k: usize| 10.0 + 2.0 * k as f64 + 3.0 * (k / 6) as f64;
        let of = |k: usize| {
            [(2 * k, shutter(k)), (2 * k + 1, shutter(k) + 0.7 + 0.6 * noise(k * k))].map(|(n, s)| trigger(n as u32, s))
        };
        (0..pictures).flat_map(of).collect()
    }

    #[test]
    fn of_two_blinks_a_picture_the_one_with_the_rhythm_is_the_shutter_lost_ones_or_not() {
        let mut both = blinks(20);
        let expected: Vec<usize> = (0..20).map(|k| 2 * k).collect();
        assert_eq!(shutters(&both, 20), Some(expected));
        both.remove(15);
        both.remove(6);
        let found = shutters(&both, 20).expect("the counter tells");
        assert!(found.len() == 19 && found.iter().all(|&k| both[k].sequence.is_multiple_of(2)), "{found:?}");
        let uncounted: Vec<Trigger> = blinks(20).into_iter().map(|t| Trigger { sequence: 0, ..t }).collect();
        assert_eq!(shutters(&uncounted, 20), Some((0..20).map(|k| 2 * k).collect()), "in turn, where nothing counts");
        assert!(shutters(&blinks(6), 5).is_some_and(|found| found.len() == 6), "one picture is lost");
    }

    #[test]
    fn where_writing_takes_always_as_long_nobody_says_which_blink_is_the_shutters() {
        let mut both = blinks(21);
        for k in 0..21 {
            both[2 * k + 1] = trigger(2 * k as u32 + 1, both[2 * k].time_ns as f64 * 1e-9 + 0.8);
        }
        both.pop();
        assert_eq!(shutters(&both, 20), None);
    }

    #[test]
    fn of_a_thousand_uneven_flights_whose_camera_takes_every_second_exposure_few_look_like_blinks() {
        let (mut taken, mut flights) = (0, 0);
        for n in [12, 16, 20, 30, 40] {
            for flight in 0..200 {
                let mut at = 10.0;
                let of = |k: usize| {
                    at += 1.0 + 0.3 * noise(997 * flight + 13 * k + k * k * (flight + 1));
                    trigger(k as u32, at)
                };
                let uneven: Vec<Trigger> = (0..n).map(of).collect();
                taken += usize::from(shutters(&uneven, n / 2).is_some());
                flights += 1;
            }
        }
        assert!(taken * 200 <= flights, "{taken} of {flights}");
    }

    #[test]
    fn an_even_rhythm_an_uneven_one_and_as_many_pictures_as_announcements_are_no_blinks() {
        let even: Vec<Trigger> = (0..40).map(|k| trigger(k, f64::from(k))).collect();
        assert_eq!(shutters(&even, 20), None, "a camera that takes every second one");
        let uneven: Vec<Trigger> = (0..40).map(|k| trigger(k, f64::from(k) + 0.4 * noise(k as usize))).collect();
        assert_eq!(shutters(&uneven, 20), None);
        assert_eq!(shutters(&blinks(20), 40), None);
        assert_eq!(shutters(&blinks(5), 5), None, "too few to tell");
    }
}

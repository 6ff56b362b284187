//! What one battery flies.

use geometry::polygon;
use glam::DVec2;

use crate::FleetError;
use crate::ground::Ring;
use crate::lines::{Line, path_s};
use crate::pace::Manner;

/// Lines further apart than this, in distances of neighbouring ones, are no neighbours.
const FAR: f64 = 3.0;
/// Most sorties of one aircraft.
const MOST_SORTIES: usize = 200;

/// One aircraft.
#[derive(Clone, Debug, PartialEq)]
pub struct Craft {
    /// Its name.
    pub id: String,
    /// Where it takes off and lands, metres east and north.
    pub home: DVec2,
    /// Seconds that one battery may be flown for, its reserve left out.
    pub battery_s: f64,
    /// Height at which it crosses others' ground, metres above the take-off place.
    pub crossing_m: f64,
}

/// One flight from take-off to landing.
#[derive(Clone, Debug, PartialEq)]
pub struct Sortie {
    /// In flying order.
    pub lines: Vec<Line>,
    /// From take-off to landing.
    pub seconds: f64,
}

impl Sortie {
    /// Metres flown from the take-off place and back.
    pub fn metres(&self, home: DVec2) -> f64 {
        let mut here = home;
        let mut metres = 0.0;
        for line in &self.lines {
            metres += here.distance(line.from) + line.length();
            here = line.to;
        }
        metres + here.distance(home)
    }

    /// Lines that lead over a hole or reach into one.
    pub fn lines_over(&self, holes: &[Ring]) -> usize {
        self.lines.iter().filter(|line| holes.iter().any(|hole| crosses_ring((line.from, line.to), hole))).count()
    }

    /// Ways to the first line, from line to line and back that lead over a hole.
    pub fn ways_over(&self, holes: &[Ring], home: DVec2) -> usize {
        let ends = self.lines.iter().map(|line| line.to);
        let begins = self.lines.iter().map(|line| line.from);
        let ways = std::iter::once(home).chain(ends).zip(begins.chain([home]));
        ways.filter(|way| holes.iter().any(|hole| crosses_ring(*way, hole))).count()
    }
}

/// Whether a straight way crosses a side of a ring or lies inside.
fn crosses_ring((from, to): (DVec2, DVec2), ring: &Ring) -> bool {
    let side = |a: DVec2, b: DVec2, p: DVec2| (b - a).perp_dot(p - a);
    let apart = |a: DVec2, b: DVec2, p: DVec2, q: DVec2| side(a, b, p) * side(a, b, q) < 0.0;
    let mut sides = ring.iter().zip(ring.iter().cycle().skip(1));
    [from, to].into_iter().any(|end| polygon::contains(ring, end))
        || sides.any(|(a, b)| apart(from, to, *a, *b) && apart(*a, *b, from, to))
}

/// The lines as flights that a battery lasts for. A line that is too long for one is flown in several.
///
/// # Errors
/// The way there and back alone is too long.
pub fn sorties(lines: &[Line], craft: &Craft, manner: &Manner) -> Result<Vec<Sortie>, FleetError> {
    let Manner { pace, height_m, .. } = manner;
    let vertical = pace.vertical_s(craft.crossing_m, *height_m);
    let change = pace.change_s(craft.crossing_m, *height_m);
    let seconds = |lines: &[Line]| {
        let crossed = lines.windows(2).filter(|w| crosses(&w[0], &w[1], manner)).count();
        vertical + crossed as f64 * change + path_s(lines, craft.home, pace)
    };
    let fits = |lines: &[Line]| seconds(lines) <= craft.battery_s;
    let mut found = Vec::new();
    let mut rest: Vec<Line> = lines.iter().rev().copied().collect();
    while let Some(next) = rest.pop() {
        let mut flown = vec![next];
        if !fits(&flown) {
            let part = |share: f64| Line { from: next.from, to: next.from.lerp(next.to, share) };
            // As much as fits: seconds grow with the share but for the way home, hence from above.
            let share = (1..64).rev().map(|k| f64::from(k) / 64.0).find(|share| fits(&[part(*share)]));
            let Some(share) = share.filter(|_| found.len() < MOST_SORTIES) else {
                let far = craft.home.distance(next.from).max(craft.home.distance(next.to));
                return Err(FleetError::Reach(format!(
                    "{}: its lines begin {far:.0} m from the take-off place, and a battery lasts {:.1} min of flight; move --take-off \
                     nearer, raise --endurance or --speed, or give more aircraft",
                    craft.id,
                    craft.battery_s / 60.0
                )));
            };
            flown = vec![part(share)];
            rest.push(Line { from: flown[0].to, to: next.to });
        }
        while let Some(more) = rest.pop() {
            flown.push(more);
            if !fits(&flown) {
                flown.pop();
                rest.push(more);
                break;
            }
        }
        found.push(Sortie { seconds: seconds(&flown), lines: flown });
    }
    Ok(found)
}

/// Whether the way from a line to the next is so long that it may lead over others' ground: it is flown at the crossing height.
pub fn crosses(line: &Line, next: &Line, manner: &Manner) -> bool {
    line.to.distance(next.from) > FAR * manner.spacing_m + 2.0 * manner.beyond_m
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::tests::rectangle;
    use crate::pace::Pace;

    fn craft(battery_s: f64) -> Craft {
        Craft { id: "west".into(), home: DVec2::ZERO, battery_s, crossing_m: 50.0 }
    }

    #[test]
    fn ways_over_a_hole_are_counted_and_those_beside_it_are_not() {
        let holes = [rectangle(40.0, 40.0, 20.0, 20.0)];
        let line = |from: [f64; 2], to: [f64; 2]| Line { from: from.into(), to: to.into() };
        let home = DVec2::new(-10.0, 50.0);
        let over = |lines| Sortie { lines, seconds: 0.0 }.ways_over(&holes, home);
        // There over the hole and back beside it; and from line to line.
        assert_eq!(over(vec![line([90.0, 50.0], [90.0, 90.0])]), 1);
        assert_eq!(over(vec![line([10.0, 5.0], [90.0, 5.0])]), 0);
        assert_eq!(over(vec![line([5.0, 10.0], [30.0, 10.0]), line([70.0, 90.0], [5.0, 90.0])]), 1);
        // A line over it, one that ends in it, and one beside it.
        let lines =
            vec![line([0.0, 50.0], [90.0, 50.0]), line([0.0, 45.0], [45.0, 45.0]), line([0.0, 5.0], [90.0, 5.0])];
        assert_eq!(Sortie { lines, seconds: 0.0 }.lines_over(&holes), 2);
    }

    #[test]
    fn a_battery_flies_what_it_lasts_for_and_all_lines_are_flown() {
        let pace = Pace::new(8.0, 3.0, 15.0).expect("a pace");
        let pace = Manner { spacing_m: 20.0, beyond_m: 8.0, height_m: 40.0, pace };
        let line =
            |k: u32| Line { from: DVec2::new(0.0, 20.0 * f64::from(k)), to: DVec2::new(400.0, 20.0 * f64::from(k)) };
        let all: Vec<Line> = (0..10).map(line).collect();
        let one = sorties(&all, &craft(3600.0), &pace).expect("one");
        assert_eq!((one.len(), one[0].lines.len()), (1, 10));
        let several = sorties(&all, &craft(400.0), &pace).expect("several");
        assert!(several.len() > 2 && several.iter().all(|s| s.seconds <= 400.0));
        assert_eq!(several.iter().flat_map(|s| &s.lines).count(), 10);
        // A line too long for a battery is flown in parts.
        let long = [Line { from: DVec2::new(-2000.0, 0.0), to: DVec2::new(2000.0, 0.0) }];
        let parts = sorties(&long, &craft(700.0), &pace).expect("parts");
        assert!(parts.len() > 1 && parts.iter().all(|s| s.seconds <= 700.0));
        let metres: f64 = parts.iter().flat_map(|s| &s.lines).map(Line::length).sum();
        assert!((metres - 4000.0).abs() < 1e-6);
        let far = [Line { from: DVec2::new(5000.0, 0.0), to: DVec2::new(5100.0, 0.0) }];
        let refused = sorties(&far, &craft(600.0), &pace).expect_err("too far").to_string();
        assert!(refused.contains("5100 m from the take-off place") && refused.contains("10.0 min"), "{refused}");
    }
}

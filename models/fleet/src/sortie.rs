//! What one battery flies.

use glam::DVec2;

use crate::FleetError;
use crate::lines::Line;
use crate::obstacles::Obstacles;
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
    /// Where the ways to each line bend, and that back home: round what is not flown over.
    pub ways: Vec<Vec<DVec2>>,
    /// From take-off to landing.
    pub seconds: f64,
}

impl Sortie {
    /// All corners from the take-off place and back.
    pub fn path(&self, home: DVec2) -> Vec<DVec2> {
        let ends = self.lines.iter().map(|line| vec![line.from, line.to]).chain([vec![home]]);
        let flown = self.ways.iter().zip(ends).flat_map(|(way, end)| way.iter().copied().chain(end));
        std::iter::once(home).chain(flown).collect()
    }

    /// Metres flown from the take-off place and back.
    pub fn metres(&self, home: DVec2) -> f64 {
        metres(&self.path(home))
    }

    /// Ways that lead round something.
    pub fn detours(&self) -> usize {
        self.ways.iter().filter(|way| !way.is_empty()).count()
    }
}

fn metres(path: &[DVec2]) -> f64 {
    path.windows(2).map(|w| w[0].distance(w[1])).sum()
}

/// A way between two places.
struct Way {
    bends: Vec<DVec2>,
    seconds: f64,
    far: bool,
}

/// Who flies, how, and round what.
struct Flying<'a> {
    craft: &'a Craft,
    manner: &'a Manner,
    obstacles: &'a Obstacles,
}

impl Flying<'_> {
    fn way(&self, from: DVec2, to: DVec2) -> Result<Way, FleetError> {
        let bends = self.obstacles.way(from, to).ok_or_else(|| {
            FleetError::Reach(format!(
                "{}: no way leads {}round the holes of the area to all of its lines with {} m of room; move --take-off, give less \
                 --clearance, or draw {} otherwise",
                self.craft.id,
                if self.obstacles.fence().is_some() { "inside the fence and " } else { "" },
                self.obstacles.clearance_m(),
                if self.obstacles.fence().is_some() { "the fence" } else { "the holes" },
            ))
        })?;
        let path: Vec<DVec2> = std::iter::once(from).chain(bends.iter().copied()).chain([to]).collect();
        Ok(Way { seconds: self.manner.pace.path_s(&path), far: crosses(&path, self.manner), bends })
    }

    fn line_s(&self, line: &Line) -> f64 {
        self.manner.pace.leg_s(line.length())
    }
}

/// The lines as flights that a battery lasts for, round `obstacles`. A line that is too long for one is flown in several.
///
/// # Errors
/// The way there and back alone is too long, or there is none.
pub fn sorties(
    lines: &[Line],
    craft: &Craft,
    manner: &Manner,
    obstacles: &Obstacles,
) -> Result<Vec<Sortie>, FleetError> {
    let flying = Flying { craft, manner, obstacles };
    let Manner { pace, height_m, .. } = manner;
    let vertical_s = pace.vertical_s(craft.crossing_m, *height_m);
    let change_s = pace.change_s(craft.crossing_m, *height_m);
    let mut found = Vec::new();
    let mut rest: Vec<Line> = lines.iter().rev().copied().collect();
    while let Some(mut line) = rest.pop() {
        let there = flying.way(craft.home, line.from)?;
        let mut back = flying.way(line.to, craft.home)?;
        // Up to the end of the last line.
        let mut seconds = vertical_s + there.seconds + flying.line_s(&line);
        if seconds + back.seconds > craft.battery_s {
            let whole = line;
            let mut fits = None;
            // As much as fits: seconds grow with the share but for the way home, hence from above.
            for share in (1..64).rev().map(|k| f64::from(k) / 64.0) {
                let part = Line { from: whole.from, to: whole.from.lerp(whole.to, share) };
                let home = flying.way(part.to, craft.home)?;
                let up_to = vertical_s + there.seconds + flying.line_s(&part);
                if up_to + home.seconds <= craft.battery_s {
                    fits = Some((part, home, up_to));
                    break;
                }
            }
            let Some(fits) = fits.filter(|_| found.len() < MOST_SORTIES) else {
                let far = craft.home.distance(whole.from).max(craft.home.distance(whole.to));
                return Err(FleetError::Reach(format!(
                    "{}: its lines begin {far:.0} m from the take-off place, and a battery lasts {:.1} min of flight; move --take-off \
                     nearer, raise --endurance or --speed, or give more aircraft",
                    craft.id,
                    craft.battery_s / 60.0
                )));
            };
            (line, back, seconds) = fits;
            rest.push(Line { from: line.to, to: whole.to });
        }
        let (mut flown, mut ways) = (vec![line], vec![there.bends]);
        while let Some(more) = rest.pop() {
            let between = flying.way(line.to, more.from)?;
            let home = flying.way(more.to, craft.home)?;
            let change_s = if between.far { change_s } else { 0.0 };
            let longer = seconds + between.seconds + change_s + flying.line_s(&more);
            if longer + home.seconds > craft.battery_s {
                rest.push(more);
                break;
            }
            (line, back, seconds) = (more, home, longer);
            flown.push(more);
            ways.push(between.bends);
        }
        ways.push(back.bends);
        found.push(Sortie { lines: flown, ways, seconds: seconds + back.seconds });
    }
    Ok(found)
}

/// Whether the way from a line to the next is so long that it may lead over others' ground: it is flown at the crossing height.
pub fn crosses(way: &[DVec2], manner: &Manner) -> bool {
    metres(way) > FAR * manner.spacing_m + 2.0 * manner.beyond_m
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
    fn ways_round_a_hole_are_longer_and_counted_and_those_beside_it_are_straight() {
        let pace = Pace::new(8.0, 0.0, 15.0).expect("a pace");
        let manner = Manner { spacing_m: 20.0, beyond_m: 8.0, height_m: 40.0, pace };
        let obstacles = Obstacles::new(&[rectangle(40.0, 40.0, 20.0, 20.0)], 5.0).expect("one");
        let line = |from: [f64; 2], to: [f64; 2]| Line { from: from.into(), to: to.into() };
        let craft = Craft { home: DVec2::new(-10.0, 50.0), ..craft(900.0) };
        let one = |lines: &[Line], obstacles: &Obstacles| {
            let all = sorties(lines, &craft, &manner, obstacles).expect("a way");
            assert_eq!(all.len(), 1);
            all[0].clone()
        };
        // There over the hole and back beside it.
        let behind = [line([90.0, 50.0], [90.0, 90.0])];
        let (round, straight) = (one(&behind, &obstacles), one(&behind, &Obstacles::default()));
        assert_eq!((round.detours(), straight.detours()), (1, 0));
        assert!(round.seconds > straight.seconds && round.metres(craft.home) > straight.metres(craft.home) + 5.0);
        let path = round.path(craft.home);
        assert!(path.len() > 4 && path[0] == craft.home && path[path.len() - 1] == craft.home, "{path:?}");
        assert_eq!(one(&[line([10.0, 5.0], [90.0, 5.0])], &obstacles).detours(), 0);
        assert_eq!(one(&[line([5.0, 10.0], [30.0, 10.0]), line([70.0, 90.0], [5.0, 90.0])], &obstacles).detours(), 1);
        // It stands in the hole.
        let inside = Craft { home: DVec2::splat(50.0), ..craft.clone() };
        let refused = sorties(&behind, &inside, &manner, &obstacles).expect_err("no way").to_string();
        assert!(refused.contains("no way leads round the holes") && refused.contains("5 m of room"), "{refused}");
    }

    #[test]
    fn a_battery_flies_what_it_lasts_for_and_all_lines_are_flown() {
        let pace = Pace::new(8.0, 3.0, 15.0).expect("a pace");
        let pace = Manner { spacing_m: 20.0, beyond_m: 8.0, height_m: 40.0, pace };
        let line =
            |k: u32| Line { from: DVec2::new(0.0, 20.0 * f64::from(k)), to: DVec2::new(400.0, 20.0 * f64::from(k)) };
        let all: Vec<Line> = (0..10).map(line).collect();
        let one = sorties(&all, &craft(3600.0), &pace, &Obstacles::default()).expect("one");
        assert_eq!((one.len(), one[0].lines.len()), (1, 10));
        let several = sorties(&all, &craft(400.0), &pace, &Obstacles::default()).expect("several");
        assert!(several.len() > 2 && several.iter().all(|s| s.seconds <= 400.0));
        assert_eq!(several.iter().flat_map(|s| &s.lines).count(), 10);
        // A line too long for a battery is flown in parts.
        let long = [Line { from: DVec2::new(-2000.0, 0.0), to: DVec2::new(2000.0, 0.0) }];
        let parts = sorties(&long, &craft(700.0), &pace, &Obstacles::default()).expect("parts");
        assert!(parts.len() > 1 && parts.iter().all(|s| s.seconds <= 700.0));
        let metres: f64 = parts.iter().flat_map(|s| &s.lines).map(Line::length).sum();
        assert!((metres - 4000.0).abs() < 1e-6);
        let far = [Line { from: DVec2::new(5000.0, 0.0), to: DVec2::new(5100.0, 0.0) }];
        let refused = sorties(&far, &craft(600.0), &pace, &Obstacles::default()).expect_err("too far").to_string();
        assert!(refused.contains("5100 m from the take-off place") && refused.contains("10.0 min"), "{refused}");
    }
}

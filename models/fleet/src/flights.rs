//! The flights of a fleet as plans: heights, waypoints, pictures.

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DVec2, DVec3};
use models::formats::flight_plan::{FlightPlan, Waypoint};

use crate::FleetError;
use crate::lines::Line;
use crate::pace::Manner;
use crate::sortie::{Craft, Sortie, crosses};

/// Heights at which two aircraft cross others' ground differ by this, metres: twice the error of a barometer within one flight.
const APART_M: f64 = 5.0;
/// The lowest crossing above ground, metres.
const LOWEST_M: f64 = 20.0;
/// The ground is asked for its height this far apart, metres.
const STEP_M: f64 = 10.0;
/// A line may be off its height above ground by this share of it, and a crossing by so many metres.
const OFF: f64 = 0.05;
const CROSSING_OFF_M: f64 = 1.0;

/// Heights of the ground above the sea, metres, at places east and north.
pub type Terrain<'a> = &'a dyn Fn(DVec2) -> Option<f64>;

/// By how much an aircraft is higher or lower above the ground than planned, metres, as it follows terrain in straight pieces.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Off {
    line_m: f64,
    crossing_m: f64,
}

impl Off {
    /// Of flights that follow terrain and photograph from `height_m`.
    pub fn above_terrain(height_m: f64) -> Self {
        Self { line_m: OFF * height_m, crossing_m: CROSSING_OFF_M }
    }
}

/// Crossing heights of `count` aircraft that photograph from `height_m`, none above `highest_m`; one alone has no need to cross. They are
/// so far apart that nobody is nearer than 5 m to another's crossing or lines where both are `off`.
///
/// # Errors
/// There is no room for so many.
pub fn crossings(count: usize, height_m: f64, highest_m: f64, off: Off) -> Result<Vec<f64>, FleetError> {
    let Off { line_m, crossing_m } = off;
    if height_m + line_m.max(crossing_m) > highest_m {
        return Err(FleetError::Setting {
            what: "--gsd",
            value: format!("is flown {:.0} m above ground", height_m + line_m.max(crossing_m)),
            wanted: format!("at most {highest_m:.0} m (--highest); ask for finer pixels"),
        });
    }
    if count == 1 {
        return Ok(vec![height_m]);
    }
    let (first, apart) = (APART_M + line_m + crossing_m, APART_M + 2.0 * crossing_m);
    let steps = (0..count).map(|k| first + apart * k as f64);
    let above = steps.clone().map(|s| height_m + s).filter(|m| *m + crossing_m <= highest_m);
    let below = steps.map(|s| height_m - s).filter(|m| *m - crossing_m >= LOWEST_M);
    let found: Vec<f64> = above.chain(below).take(count).collect();
    match found.len() == count {
        true => Ok(found),
        false => Err(FleetError::Reach(format!(
            "{count} aircraft cannot cross at heights {APART_M} m apart between {LOWEST_M} and {highest_m} m; raise --highest or give \
             fewer aircraft"
        ))),
    }
}

/// How a fleet's flights are written.
pub struct Flights<'a> {
    /// Metres east and north of the mission's origin.
    pub frame: EnuFrame,
    /// How the area is photographed.
    pub manner: &'a Manner,
    /// Metres between two pictures on a line.
    pub base_m: f64,
    /// Heights of the ground; `None` = all of it lies as high as the take-off place.
    pub terrain: Option<Terrain<'a>>,
    /// Height of the take-off places without terrain, metres above the sea.
    pub home_m: f64,
}

impl Flights<'_> {
    /// The plan of one sortie.
    ///
    /// # Errors
    /// A place of it whose height is not known.
    pub fn plan(&self, craft: &Craft, sortie: &Sortie) -> Result<FlightPlan, FleetError> {
        let home = self.at(craft.home, self.ground(craft.home)?);
        let mut waypoints = Vec::new();
        let mut here = craft.home;
        for (k, (line, way)) in sortie.lines.iter().zip(&sortie.ways).enumerate() {
            let path: Vec<DVec2> = std::iter::once(here).chain(way.iter().copied()).chain([line.from]).collect();
            match k == 0 || crosses(&path, self.manner) {
                true => self.cross(&mut waypoints, &path, craft)?,
                false => {
                    for bend in way {
                        waypoints.push(self.waypoint(*bend, self.ground(*bend)? + self.manner.height_m, None));
                    }
                }
            }
            self.line(&mut waypoints, line)?;
            here = line.to;
        }
        let way = sortie.ways.last().into_iter().flatten().copied();
        let path: Vec<DVec2> = std::iter::once(here).chain(way).chain([craft.home]).collect();
        self.cross(&mut waypoints, &path, craft)?;
        Ok(FlightPlan {
            home,
            speed_m_s: self.manner.pace.speed_m_s,
            pitch_deg: Some(-90.0),
            waypoints,
            landing: Some(home),
        })
    }

    /// Pictures of a sortie.
    pub fn pictures(&self, sortie: &Sortie) -> usize {
        sortie.lines.iter().map(|line| (line.length() / self.base_m + 1e-6).floor() as usize + 1).sum()
    }

    fn ground(&self, p: DVec2) -> Result<f64, FleetError> {
        let Some(terrain) = self.terrain else { return Ok(self.home_m) };
        terrain(p).ok_or_else(|| {
            let at = self.at(p, 0.0);
            FleetError::Reach(format!(
                "--terrain holds no height at {:.5}, {:.5}; give a map of the area, what lies around it, and the take-off places",
                at.lat_deg, at.lon_deg
            ))
        })
    }

    /// A place on Earth. Heights are those of its own vertical, not of the origin's plane.
    fn at(&self, p: DVec2, alt_m: f64) -> Geodetic {
        Geodetic { alt_m, ..self.frame.to_geodetic(DVec3::new(p.x, p.y, 0.0)) }
    }

    fn waypoint(&self, p: DVec2, alt_m: f64, every_m: Option<f64>) -> Waypoint {
        Waypoint { position: self.at(p, alt_m), yaw_deg: None, picture: false, every_m }
    }

    /// From place to place at the aircraft's own height above the ground: level above all of it, somebody would be too high above
    /// valleys, or as high as another who crosses lower ground.
    fn cross(&self, waypoints: &mut Vec<Waypoint>, path: &[DVec2], craft: &Craft) -> Result<(), FleetError> {
        for (n, leg) in path.windows(2).enumerate() {
            let profile = self.profile(leg[0], leg[1])?;
            // Where a leg ends, the next begins.
            for k in simplified(&profile, CROSSING_OFF_M).into_iter().skip(usize::from(n > 0)) {
                let (share, ground) = profile[k];
                waypoints.push(self.waypoint(leg[0].lerp(leg[1], share), ground + craft.crossing_m, None));
            }
        }
        Ok(())
    }

    /// A line with its pictures, in as few straight pieces as follow the ground.
    fn line(&self, waypoints: &mut Vec<Waypoint>, line: &Line) -> Result<(), FleetError> {
        let profile = self.profile(line.from, line.to)?;
        let kept = simplified(&profile, OFF * self.manner.height_m);
        for (n, k) in kept.iter().enumerate() {
            let (share, ground) = profile[*k];
            let every_m = (n + 1 < kept.len()).then_some(self.base_m);
            waypoints.push(self.waypoint(line.from.lerp(line.to, share), ground + self.manner.height_m, every_m));
        }
        Ok(())
    }

    /// Shares of the way, and the ground's height there.
    fn profile(&self, from: DVec2, to: DVec2) -> Result<Vec<(f64, f64)>, FleetError> {
        let steps = match self.terrain {
            Some(_) => (from.distance(to) / STEP_M).ceil().clamp(1.0, 10_000.0),
            None => 1.0,
        };
        let shares = (0..=steps as usize).map(|k| k as f64 / steps);
        shares.map(|share| Ok((share, self.ground(from.lerp(to, share))?))).collect()
    }
}

/// Which points of a profile are kept so that none is further off than `off` (Douglas and Peucker 1973, along heights).
fn simplified(profile: &[(f64, f64)], off: f64) -> Vec<usize> {
    let mut kept = vec![0];
    let mut open = vec![(0, profile.len() - 1)];
    while let Some((a, b)) = open.pop() {
        let ((x, from), (y, to)) = (profile[a], profile[b]);
        let error = |k: usize| {
            let (share, height) = profile[k];
            (height - from - (to - from) * (share - x) / (y - x).max(1e-12)).abs()
        };
        match (a + 1..b).max_by(|i, j| error(*i).total_cmp(&error(*j))).filter(|k| error(*k) > off) {
            // The nearer half is taken next.
            Some(k) => open.extend([(k, b), (a, k)]),
            None => kept.push(b),
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::obstacles::Obstacles;
    use crate::pace::Pace;
    use crate::sortie::sorties;

    fn manner() -> Manner {
        let pace = Pace::new(8.0, 0.0, 15.0).expect("a pace");
        Manner { spacing_m: 20.0, beyond_m: 8.0, height_m: 60.0, pace }
    }

    fn craft() -> Craft {
        Craft { id: "west".into(), home: DVec2::new(-50.0, -50.0), battery_s: 1500.0, crossing_m: 75.0 }
    }

    #[test]
    fn ways_round_a_hole_are_waypoints_at_the_height_that_the_way_has() {
        let manner = manner();
        let craft = Craft { home: DVec2::new(-50.0, 35.0), ..craft() };
        let flights =
            Flights { frame: EnuFrame::new(ORIGIN), manner: &manner, base_m: 12.0, terrain: None, home_m: 430.0 };
        let hole: Vec<DVec2> = [[90.0, 34.0], [110.0, 34.0], [110.0, 36.0], [90.0, 36.0]].map(DVec2::from).to_vec();
        let obstacles = Obstacles::new(&[hole], 5.0).expect("one");
        let line = |a: [f64; 2], b: [f64; 2]| Line { from: a.into(), to: b.into() };
        // From one side of it to the other, and home along it.
        let lines = [line([0.0, 35.0], [80.0, 35.0]), line([120.0, 35.0], [200.0, 35.0])];
        let sortie = &sorties(&lines, &craft, &manner, &obstacles).expect("one")[0];
        assert_eq!(sortie.ways.iter().map(Vec::is_empty).collect::<Vec<_>>(), [true, false, false]);
        let plan = flights.plan(&craft, sortie).expect("a plan");
        let heights: Vec<f64> = plan.waypoints.iter().map(|w| w.position.alt_m - 430.0).collect();
        let [between, back] = [1, 2].map(|k| sortie.ways[k].len());
        let level = |height: f64, count: usize| vec![height; count];
        assert_eq!(heights, [level(75.0, 2), level(60.0, 4 + between), level(75.0, 2 + back)].concat());
        let frame = EnuFrame::new(ORIGIN);
        let bend = frame.to_enu(plan.waypoints[4].position).truncate();
        assert!(bend.distance(sortie.ways[1][0]) < 0.01, "{bend}");
    }

    const ORIGIN: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };

    fn lines() -> Vec<Line> {
        let line = |a: [f64; 2], b: [f64; 2]| Line { from: a.into(), to: b.into() };
        vec![line([0.0, 0.0], [200.0, 0.0]), line([200.0, 20.0], [0.0, 20.0]), line([0.0, 300.0], [200.0, 300.0])]
    }

    #[test]
    fn a_sortie_crosses_high_photographs_low_and_lands_where_it_took_off() {
        let (manner, craft) = (manner(), craft());
        let flights =
            Flights { frame: EnuFrame::new(ORIGIN), manner: &manner, base_m: 12.0, terrain: None, home_m: 430.0 };
        let sortie = &sorties(&lines(), &craft, &manner, &Obstacles::default()).expect("one")[0];
        let plan = flights.plan(&craft, sortie).expect("a plan");
        let heights: Vec<f64> = plan.waypoints.iter().map(|w| w.position.alt_m - 430.0).collect();
        // There, two lines, across to the third, back.
        assert_eq!(heights, [75.0, 75.0, 60.0, 60.0, 60.0, 60.0, 75.0, 75.0, 60.0, 60.0, 75.0, 75.0]);
        let every: Vec<usize> = (0..12).filter(|k| plan.waypoints[*k].every_m.is_some()).collect();
        assert_eq!(every, [2, 4, 8]);
        assert_eq!((flights.pictures(sortie), plan.landing), (3 * 17, Some(plan.home)));
        let frame = EnuFrame::new(ORIGIN);
        let at = frame.to_enu(plan.waypoints[3].position).truncate();
        assert!((at - DVec2::new(200.0, 0.0)).length() < 0.01, "{at}");
    }

    #[test]
    fn lines_follow_the_ground_within_a_twentieth_of_their_height() {
        let (manner, craft) = (manner(), craft());
        let hill = |p: DVec2| (p.x < 450.0).then(|| 500.0 + 30.0 * (p.x / 60.0).sin());
        let flights =
            Flights { frame: EnuFrame::new(ORIGIN), manner: &manner, base_m: 12.0, terrain: Some(&hill), home_m: 0.0 };
        let mut all = Vec::new();
        let line = Line { from: DVec2::ZERO, to: DVec2::new(400.0, 0.0) };
        flights.line(&mut all, &line).expect("a line");
        assert!((5..30).contains(&all.len()), "{}", all.len());
        let frame = EnuFrame::new(ORIGIN);
        let places: Vec<(f64, f64)> = all.iter().map(|w| (frame.to_enu(w.position).x, w.position.alt_m)).collect();
        for pair in places.windows(2) {
            for k in 0..=10 {
                let share = f64::from(k) / 10.0;
                let [x, z] = [pair[0].0 + share * (pair[1].0 - pair[0].0), pair[0].1 + share * (pair[1].1 - pair[0].1)];
                let above = z - hill(DVec2::new(x, 0.0)).expect("ground");
                assert!((above - 60.0).abs() < 3.5, "{above} m above ground at {x}");
            }
        }
        let far = Line { from: DVec2::ZERO, to: DVec2::new(500.0, 0.0) };
        let refused = flights.line(&mut Vec::new(), &far).expect_err("beyond the map").to_string();
        assert!(refused.starts_with("--terrain holds no height at 47.4"), "{refused}");
        // Ways across are at one height above the ground, too.
        let mut way = Vec::new();
        flights.cross(&mut way, &[DVec2::ZERO, DVec2::new(300.0, 0.0)], &craft).expect("a way");
        let places: Vec<(f64, f64)> = way.iter().map(|w| (frame.to_enu(w.position).x, w.position.alt_m)).collect();
        assert!(places[0].0.abs() < 1e-6 && (places[places.len() - 1].0 - 300.0).abs() < 0.1, "{places:?}");
        for pair in places.windows(2) {
            for k in 0..=10 {
                let share = f64::from(k) / 10.0;
                let [x, z] = [pair[0].0 + share * (pair[1].0 - pair[0].0), pair[0].1 + share * (pair[1].1 - pair[0].1)];
                let above = z - hill(DVec2::new(x, 0.0)).expect("ground");
                assert!((above - 75.0).abs() < 1.5, "{above} m above ground at {x}");
            }
        }
    }

    #[test]
    fn nobody_crosses_at_the_height_of_another() {
        let level = |count, height_m, highest_m| crossings(count, height_m, highest_m, Off::default());
        let found = level(8, 60.0, 120.0).expect("room");
        let mut sorted = found.clone();
        sorted.sort_by(f64::total_cmp);
        assert!(sorted.windows(2).all(|w| w[1] - w[0] >= APART_M) && sorted[0] > 60.0);
        assert_eq!(level(1, 60.0, 120.0), Ok(vec![60.0]));
        // Below, where there is no room above.
        assert_eq!(level(3, 110.0, 120.0), Ok(vec![115.0, 120.0, 105.0]));
        assert!(level(40, 60.0, 120.0).expect_err("no").to_string().contains("--highest"));
        assert!(level(1, 130.0, 120.0).expect_err("no").to_string().contains("--gsd is flown 130 m"));
        // Over terrain lines may be 3 m off at 60 m, and crossings 1 m.
        let off = Off::above_terrain(60.0);
        assert_eq!(crossings(4, 60.0, 79.0, off), Ok(vec![69.0, 76.0, 51.0, 44.0]));
        assert!(crossings(1, 60.0, 62.0, off).expect_err("no").to_string().contains("--gsd is flown 63 m"));
    }
}

//! An area dealt to a fleet: regions that do not overlap, leave nothing out, and take equally long to fly.
//!
//! The area is laid out in strips and cut in two, again and again: across the strips, or along one of them, wherever the cut is short.
//! What the parts hold is known as stretches of strips, so that together they are the area whatever happens. How long each takes is
//! then computed as it will be flown, and the cuts are moved until all take equally long.

use glam::DVec2;

use crate::FleetError;
use crate::ground::Ground;
use crate::lines::{Line, lines, path_s};
use crate::obstacles::Obstacles;
use crate::pace::Manner;
use crate::rows::{Lattice, MOST_ROWS, Rows, held, rows};
use crate::sortie::{Craft, Sortie, sorties};

/// Most aircraft that one area is dealt to.
pub const MOST_CRAFT: usize = 64;
/// Flight times may differ by this share of the longest.
pub const UNEQUAL: f64 = 0.10;
/// Good enough to stop.
const EQUAL: f64 = 0.05;
/// Rounds in which cuts are moved.
const ROUNDS: usize = 24;
/// Directions of strips tried for the whole area, and of lines for a region.
const MOST_LATTICES: usize = 4;
const MOST_DIRECTIONS: usize = 8;
/// Regions together are the area, and no two share ground, up to this share of it.
const INEXACT: f64 = 1e-4;

/// What one aircraft flies.
#[derive(Clone, Debug, PartialEq)]
pub struct Share {
    /// Its region.
    pub ground: Ground,
    /// Its flights.
    pub sorties: Vec<Sortie>,
    /// Distance of its lines, metres.
    pub spacing_m: f64,
}

impl Share {
    /// Seconds in the air.
    pub fn seconds(&self) -> f64 {
        self.sorties.iter().map(|s| s.seconds).sum()
    }
}

/// Deals `ground` to all of `craft`, in their order; they fly round `obstacles`.
///
/// # Errors
/// Too many aircraft for the area, batteries that do not reach, or times that cannot be made equal.
pub fn deal(
    ground: &Ground,
    obstacles: &Obstacles,
    craft: &[Craft],
    manner: &Manner,
) -> Result<Vec<Share>, FleetError> {
    if !(1..=MOST_CRAFT).contains(&craft.len()) {
        let wanted = format!("1 to {MOST_CRAFT}");
        return Err(FleetError::Setting { what: "--aircraft", value: craft.len().to_string(), wanted });
    }
    let mut best = Best::default();
    let quickest = quickest(ground, manner);
    if quickest.is_empty() {
        return Err(FleetError::Area(format!(
            "is too wide for lines {:.2} m apart, as {MOST_ROWS} are planned; survey it in parts, or ask for coarser pixels or less overlap",
            manner.spacing_m
        )));
    }
    // Lines along each region's best direction; where their number jumps, along the strips; and strips of another direction.
    for along in quickest {
        let lattice = Lattice::over(ground, along, manner.spacing_m);
        let all = rows(ground, &lattice);
        let dealer = Dealer { ground, obstacles, craft, manner, lattice, all };
        for free in [true, false] {
            dealer.equal(free, &mut best);
            if best.is_equal() {
                return checked(ground, best.shares);
            }
        }
    }
    Err(best.refused(craft.len()))
}

/// The most equal shares found.
#[derive(Default)]
struct Best {
    shares: Vec<Share>,
    unequal: f64,
    /// Why there are none.
    why: Option<FleetError>,
}

impl Best {
    fn is_equal(&self) -> bool {
        !self.shares.is_empty() && self.unequal <= UNEQUAL
    }

    fn refused(self, count: usize) -> FleetError {
        match (self.why, self.shares.is_empty()) {
            (Some(e), true) => e,
            _ => FleetError::Deal(format!(
                "flight times of {count} aircraft differ by {:.0} % at best; the area is too small for so many: give fewer aircraft, or a \
                 finer --gsd",
                100.0 * self.unequal
            )),
        }
    }
}

/// The directions of lines over all of `ground` that take the least time, the quickest first.
fn quickest(ground: &Ground, manner: &Manner) -> Vec<DVec2> {
    let home = ground.middle();
    let timed = directions(ground).into_iter().filter_map(|along| {
        let (_, lines) = laid(ground, along, home, manner)?;
        Some((path_s(&lines, home, &manner.pace), along))
    });
    let mut timed: Vec<(f64, DVec2)> = timed.collect();
    timed.sort_by(|a, b| a.0.total_cmp(&b.0));
    timed.into_iter().take(MOST_LATTICES).map(|t| t.1).collect()
}

/// Directions of the longest sides of its hull: the least width of a polygon is across one of them.
fn directions(ground: &Ground) -> Vec<DVec2> {
    let hull = geometry::polygon::hull(ground.rings().flatten().copied().collect());
    let mut sides: Vec<DVec2> = hull.iter().zip(hull.iter().cycle().skip(1)).map(|(a, b)| *b - *a).collect();
    sides.sort_by(|a, b| b.length_squared().total_cmp(&a.length_squared()));
    let mut found: Vec<DVec2> = Vec::new();
    for side in sides.into_iter().filter_map(DVec2::try_normalize) {
        if found.len() < MOST_DIRECTIONS && found.iter().all(|d| d.perp_dot(side).abs() > 0.03) {
            found.push(side);
        }
    }
    found
}

/// Lines over all of `ground`; `None` where more would be needed than are planned.
fn laid(ground: &Ground, along: DVec2, home: DVec2, manner: &Manner) -> Option<(Lattice, Vec<Line>)> {
    let lattice = Lattice::over(ground, along, manner.spacing_m);
    if lattice.width > manner.spacing_m * (1.0 + 1e-6) {
        return None;
    }
    let lines = lines(&rows(ground, &lattice), &lattice, manner.beyond_m, home, &manner.pace);
    Some((lattice, lines))
}

struct Dealer<'a> {
    ground: &'a Ground,
    obstacles: &'a Obstacles,
    craft: &'a [Craft],
    manner: &'a Manner,
    lattice: Lattice,
    all: Rows,
}

impl Dealer<'_> {
    /// Moves the cuts until all take equally long; `free`: with lines along each region's best direction.
    fn equal(&self, free: bool, best: &mut Best) {
        let mut weights = vec![1.0; self.craft.len()];
        let mut order: Option<Vec<usize>> = None;
        let (mut step, mut before) = (1.0, f64::INFINITY);
        for _ in 0..ROUNDS {
            let parts = self.cut(&self.all, &weights);
            let grounds: Vec<Ground> =
                parts.iter().map(|rows| held(self.ground, &self.lattice, &self.all, rows)).collect();
            let order = order.get_or_insert_with(|| assigned(&grounds, self.craft));
            let each = grounds.into_iter().zip(&parts).zip(order.iter());
            let shares: Result<Vec<Share>, FleetError> =
                each.map(|((ground, rows), craft)| self.share(ground, rows, &self.craft[*craft], free)).collect();
            let shares = match shares {
                Ok(shares) => shares,
                Err(e) => {
                    best.why = Some(e);
                    return;
                }
            };
            let seconds: Vec<f64> = shares.iter().map(Share::seconds).collect();
            let unequal = unequal(&seconds);
            if best.shares.is_empty() || unequal < best.unequal {
                let mut dealt: Vec<(usize, Share)> = order.iter().copied().zip(shares).collect();
                dealt.sort_by_key(|d| d.0);
                (best.unequal, best.shares) = (unequal, dealt.into_iter().map(|d| d.1).collect());
            }
            if unequal <= EQUAL {
                return;
            }
            if unequal >= before {
                step *= 0.7;
            }
            before = unequal;
            let mean = seconds.iter().sum::<f64>() / seconds.len() as f64;
            weights.iter_mut().zip(&seconds).for_each(|(w, s)| *w *= (mean / s.max(1.0)).powf(step));
        }
    }

    fn share(&self, ground: Ground, rows: &Rows, craft: &Craft, free: bool) -> Result<Share, FleetError> {
        let manner = self.manner;
        let beside = lines(rows, &self.lattice, manner.beyond_m, craft.home, &manner.pace);
        let mut tried = vec![(self.lattice.width, beside)];
        if free {
            tried.extend(directions(&ground).into_iter().filter_map(|along| {
                let (lattice, lines) = laid(&ground, along, craft.home, manner)?;
                Some((lattice.width, lines))
            }));
        }
        let seconds = |lines: &Vec<Line>| path_s(lines, craft.home, &manner.pace);
        let best = tried.into_iter().min_by(|a, b| seconds(&a.1).total_cmp(&seconds(&b.1)));
        let (spacing_m, lines) = best.unwrap_or_default();
        let lines: Vec<Line> = lines.iter().flat_map(|line| self.obstacles.along_strip(line, spacing_m)).collect();
        if lines.is_empty() {
            return Err(FleetError::Deal(format!("the area is too small for {} aircraft", self.craft.len())));
        }
        Ok(Share { ground, sorties: sorties(&lines, craft, manner, self.obstacles)?, spacing_m })
    }

    /// Cuts strips into one part for each weight.
    fn cut(&self, rows: &Rows, weights: &[f64]) -> Vec<Rows> {
        let half = weights.len() / 2;
        if half == 0 {
            return vec![rows.clone()];
        }
        let (first, second) = weights.split_at(half);
        let share = first.iter().sum::<f64>() / weights.iter().sum::<f64>();
        let across = self.across(rows, share);
        let along = self.along(rows, share);
        let short = |cut: &([Rows; 2], f64)| {
            let scattered: usize = cut.0.iter().map(components).sum();
            (scattered, cut.1)
        };
        let ([a, b], _) = match short(&across).partial_cmp(&short(&along)) {
            Some(std::cmp::Ordering::Less) => across,
            _ => along,
        };
        [self.cut(&a, first), self.cut(&b, second)].concat()
    }

    /// Seconds of a stretch and of the turn after it.
    fn cost(&self, [from, to]: [f64; 2]) -> f64 {
        let Manner { beyond_m, spacing_m, pace, .. } = self.manner;
        pace.leg_s(to - from + 2.0 * beyond_m) + pace.leg_s(*spacing_m)
    }

    fn total(&self, rows: &Rows) -> f64 {
        rows.iter().flatten().map(|s| self.cost(*s)).sum()
    }

    /// Cut across the strips such that the first part takes this share of the time, and how long the cut is.
    fn across(&self, rows: &Rows, share: f64) -> ([Rows; 2], f64) {
        let reach = rows.iter().flatten();
        let (mut low, mut high) = reach.fold((f64::MAX, f64::MIN), |(l, h), s| (l.min(s[0]), h.max(s[1])));
        let split = |x: f64| [clipped(rows, f64::MIN, x), clipped(rows, x, f64::MAX)];
        for _ in 0..40 {
            let x = 0.5 * (low + high);
            let [a, b] = split(x).map(|part| self.total(&part));
            if a < share * (a + b) { low = x } else { high = x }
        }
        let x = 0.5 * (low + high);
        let crossed = rows.iter().flatten().filter(|s| s[0] < x && s[1] > x).count();
        (split(x), crossed as f64 * self.lattice.width)
    }

    /// Cut along a strip, with a step in it.
    fn along(&self, rows: &Rows, share: f64) -> ([Rows; 2], f64) {
        let wanted = share * self.total(rows);
        let mut taken = 0.0;
        let mut at = 0;
        let row_s = |row: &Vec<[f64; 2]>| row.iter().map(|s| self.cost(*s)).sum::<f64>();
        while at + 1 < rows.len() && taken + row_s(&rows[at]) <= wanted {
            taken += row_s(&rows[at]);
            at += 1;
        }
        let lower = |x: f64| part(&rows[at], f64::MIN, x);
        let reach = rows[at].iter();
        let (low, high) = reach.fold((f64::MAX, f64::MIN), |(l, h), s| (l.min(s[0]), h.max(s[1])));
        let (mut from, mut to) = (low, high);
        for _ in 0..40 {
            let x = 0.5 * (from + to);
            if taken + row_s(&lower(x)) < wanted { from = x } else { to = x }
        }
        // A piece that is shorter than a strip is wide is not worth its turn.
        let least = self.lattice.width;
        let x = match 0.5 * (from + to) {
            x if x - low < least => f64::MIN,
            x if high - x < least => f64::MAX,
            x => x,
        };
        let (mut a, mut b) = (rows.clone(), rows.clone());
        a.iter_mut().skip(at + 1).for_each(Vec::clear);
        b.iter_mut().take(at).for_each(Vec::clear);
        (a[at], b[at]) = (lower(x), part(&rows[at], x, f64::MAX));
        let length = |row: &Vec<[f64; 2]>| row.iter().map(|s| s[1] - s[0]).sum::<f64>();
        ([a, b], length(&rows[at]) + self.lattice.width)
    }
}

/// By how much of the longest time these differ.
fn unequal(seconds: &[f64]) -> f64 {
    let (low, high) = seconds.iter().fold((f64::MAX, f64::MIN), |(l, h), s| (l.min(*s), h.max(*s)));
    1.0 - low / high
}

fn part(row: &[[f64; 2]], from: f64, to: f64) -> Vec<[f64; 2]> {
    row.iter().map(|s| [s[0].max(from), s[1].min(to)]).filter(|s| s[1] > s[0]).collect()
}

fn clipped(rows: &Rows, from: f64, to: f64) -> Rows {
    rows.iter().map(|row| part(row, from, to)).collect()
}

/// Parts of strips that do not touch each other.
fn components(rows: &Rows) -> usize {
    let places: Vec<(usize, [f64; 2])> =
        rows.iter().enumerate().flat_map(|(k, row)| row.iter().map(move |s| (k, *s))).collect();
    let mut root: Vec<usize> = (0..places.len()).collect();
    fn find(root: &mut [usize], mut i: usize) -> usize {
        while root[i] != i {
            root[i] = root[root[i]];
            i = root[i];
        }
        i
    }
    let mut first_of_next = 0;
    for (i, (row, a)) in places.iter().enumerate() {
        while first_of_next < places.len() && places[first_of_next].0 <= *row {
            first_of_next += 1;
        }
        for (j, (next, b)) in places.iter().enumerate().skip(first_of_next) {
            if *next != row + 1 {
                break;
            }
            if a[0] < b[1] && b[0] < a[1] {
                let (x, y) = (find(&mut root, i), find(&mut root, j));
                root[x] = y;
            }
        }
    }
    (0..places.len()).filter(|i| find(&mut root, *i) == *i).count()
}

/// For each region the aircraft that flies it: such that ways are short, by exchanges of two.
fn assigned(grounds: &[Ground], craft: &[Craft]) -> Vec<usize> {
    let middles: Vec<DVec2> = grounds.iter().map(Ground::middle).collect();
    let way = |region: usize, by: usize| middles[region].distance(craft[by].home);
    let mut order: Vec<usize> = (0..craft.len()).collect();
    for _ in 0..craft.len() {
        let mut better = false;
        for i in 0..order.len() {
            for j in i + 1..order.len() {
                let (a, b) = (order[i], order[j]);
                if way(i, b) + way(j, a) + 1e-6 < way(i, a) + way(j, b) {
                    order.swap(i, j);
                    better = true;
                }
            }
        }
        if !better {
            break;
        }
    }
    order
}

/// The shares, if together they are the ground and no two of them hold the same.
fn checked(ground: &Ground, shares: Vec<Share>) -> Result<Vec<Share>, FleetError> {
    let area = ground.area_m2();
    let together = shares.iter().fold(Ground::default(), |all, share| all.with(&share.ground));
    let sum: f64 = shares.iter().map(|s| s.ground.area_m2()).sum();
    let missing = ground.without(&together).area_m2();
    let doubled = sum - together.area_m2();
    match missing.abs().max(doubled.abs()) > INEXACT * area {
        true => Err(FleetError::Deal(format!(
            "the regions leave out {missing:.1} m² and share {doubled:.1} m² of {area:.0} m²; simplify the area's sides"
        ))),
        false => Ok(shares),
    }
}

#[cfg(test)]
mod tests;

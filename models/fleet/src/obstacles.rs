//! What is not flown over: holes of the area with room around them, what lies beyond its fence, and the ways round both.

use geometry::polygon;
use glam::DVec2;

use crate::FleetError;
use crate::ground::{Ground, Ring};
use crate::lines::Line;

/// Lines and ways keep this far inside a fence, metres: ArduPilot's FENCE_MARGIN.
const FENCE_M: f64 = 2.0;
/// Where a line lies whose strip has its middle beyond the fence, in widths of the strip from there.
const ASIDE: [f64; 4] = [0.25, -0.25, 0.45, -0.45];
/// Ways bend so much further out than they need to, metres: rounding is no collision.
const SLACK_M: f64 = 0.5;
/// A ring is drawn with fewer corners, none of the old further off than this share of the clearance.
const COARSE: f64 = 0.25;
/// Most corners of all rings with their room: ways are looked for among them.
const MOST_CORNERS: usize = 256;
/// Shorter pieces of a line are not worth their turns, metres.
const SHORTEST_M: f64 = 1.0;
/// The room around a corner is an octagon.
const AROUND: u32 = 8;

/// Rings that nobody flies over, and where ways round them bend.
#[derive(Clone, Debug, Default)]
pub struct Obstacles {
    /// The rings with their room.
    closed: Ground,
    sides: Vec<[DVec2; 2]>,
    /// A little more: lines end here.
    wide: Ground,
    /// Its corners, and the metres between those that see each other.
    corners: Vec<DVec2>,
    apart: Vec<f64>,
    clearance_m: f64,
    limit: Option<Limit>,
}

/// Ground that ways do not leave.
#[derive(Clone, Debug)]
struct Limit {
    ground: Ground,
    sides: Vec<[DVec2; 2]>,
    /// Where ways bend: corners of the holes, and those of this ground that point inwards.
    corners: Vec<DVec2>,
    /// Metres between those that see each other and this ground only.
    apart: Vec<f64>,
    /// A fence: nothing ever leaves it, and lines end inside of this, which is a little less. Else ways leave it where they have to.
    fence: Option<Ground>,
}

impl Obstacles {
    /// `holes` with `clearance_m` around them.
    ///
    /// # Errors
    /// More corners than ways can be found among.
    pub fn new(holes: &[Ring], clearance_m: f64) -> Result<Self, FleetError> {
        let coarse_m = COARSE * clearance_m;
        let rings: Vec<Ring> = holes.iter().map(|ring| simplified(ring, coarse_m)).collect();
        let drawn: usize = rings.iter().map(Vec::len).sum();
        let too_many = |count: usize| {
            FleetError::Area(format!(
                "has holes of {count} corners; ways round {MOST_CORNERS} can be found, so draw them simpler"
            ))
        };
        if drawn > MOST_CORNERS {
            return Err(too_many(drawn));
        }
        let [closed, wide] = [0.0, SLACK_M].map(|more| with_room(&rings, clearance_m + coarse_m + more));
        let corners: Vec<DVec2> = wide.rings().flatten().copied().collect();
        if corners.len() > MOST_CORNERS {
            return Err(too_many(corners.len()));
        }
        let sides = sides(&closed);
        let mut this = Self { sides, closed, wide, apart: Vec::new(), corners, clearance_m, limit: None };
        this.apart = between(&this.corners, |a, b| this.seen_m(a, b));
        Ok(this)
    }

    /// With ways round the holes that stay on the ground inside `outside` and `beyond_m` around it, where there is such a way.
    pub fn inside(mut self, outside: &Ring, beyond_m: f64) -> Self {
        if self.sides.is_empty() {
            return self;
        }
        let (ring, coarse_m) = drawn_coarsely(outside, COARSE * beyond_m);
        let [ground, inner] =
            [0.0, SLACK_M].map(|less| with_room(std::slice::from_ref(&ring), beyond_m + coarse_m - less));
        self.limit = Some(self.limited(ground, inward(&inner), None));
        self
    }

    /// With lines and ways that never leave `fence`.
    ///
    /// # Errors
    /// A fence that is too narrow to fly in.
    pub fn fenced(mut self, fence: &Ring) -> Result<Self, FleetError> {
        let whole = Ground::of(vec![fence.clone()]);
        let [ground, lines] = [FENCE_M, FENCE_M + SLACK_M].map(|metres| whole.without(&beside(fence, metres)));
        if lines.parts.is_empty() {
            return Err(FleetError::Area(format!(
                "is a fence with no room inside; lines keep {} m from its sides",
                FENCE_M + SLACK_M
            )));
        }
        // Ways bend where a coarser fence inside of this one has its corners.
        let (mut bends, mut coarse_m) = (inward(&lines), SLACK_M);
        while bends.len() > MOST_CORNERS {
            let ring = simplified(fence, coarse_m);
            let inner = Ground::of(vec![ring.clone()]).without(&beside(&ring, FENCE_M + SLACK_M + coarse_m));
            (bends, coarse_m) = (inward(&inner), 2.0 * coarse_m);
        }
        self.limit = Some(self.limited(ground, bends, Some(lines)));
        Ok(self)
    }

    fn limited(&self, ground: Ground, bends: Vec<DVec2>, fence: Option<Ground>) -> Limit {
        let corners = [&self.corners[..], &bends].concat();
        let mut limit = Limit { sides: sides(&ground), ground, corners, apart: Vec::new(), fence };
        limit.apart = between(&limit.corners, |a, b| limit.seen_m(self, a, b));
        limit
    }

    /// The ground inside the fence on which lines lie.
    pub fn fence(&self) -> Option<&Ground> {
        self.limit.as_ref()?.fence.as_ref()
    }

    /// Whether a place lies beyond the fence, or nearer to it than may be flown.
    pub fn shut_out(&self, p: DVec2) -> bool {
        self.limit.as_ref().is_some_and(|limit| limit.fence.is_some() && !limit.ground.contains(p))
    }

    /// Metres that are kept from every ring.
    pub fn clearance_m(&self) -> f64 {
        self.clearance_m
    }

    /// Whether a place lies on a ring or nearer to it than the clearance, or beyond the fence.
    pub fn hold(&self, p: DVec2) -> bool {
        self.closed.contains(p) || self.shut_out(p)
    }

    /// What of a line may be flown, in its direction.
    pub fn clear(&self, line: &Line) -> Vec<Line> {
        let way = line.to - line.from;
        let fence = self.fence();
        let rings = self.wide.rings().chain(fence.into_iter().flat_map(Ground::rings));
        let sides = rings.flat_map(|ring| ring.iter().zip(ring.iter().cycle().skip(1)));
        let crossed = sides.filter_map(|(a, b)| {
            let (side, across) = (*b - *a, way.perp_dot(*b - *a));
            let [along, at] = [side, way].map(|v| (*a - line.from).perp_dot(v) / across);
            ((0.0..=1.0).contains(&at) && along > 0.0 && along < 1.0).then_some(along)
        });
        let mut shares: Vec<f64> = crossed.chain([0.0, 1.0]).collect();
        shares.sort_by(f64::total_cmp);
        let mut open: Vec<[f64; 2]> = Vec::new();
        for pair in shares.windows(2) {
            let middle = line.from.lerp(line.to, 0.5 * (pair[0] + pair[1]));
            if self.wide.contains(middle) || fence.is_some_and(|fence| !fence.contains(middle)) {
                continue;
            }
            match open.last_mut() {
                Some(last) if last[1] == pair[0] => last[1] = pair[1],
                _ => open.push([pair[0], pair[1]]),
            }
        }
        let piece =
            |[from, to]: [f64; 2]| Line { from: line.from.lerp(line.to, from), to: line.from.lerp(line.to, to) };
        let whole = open.len() == 1 && open[0] == [0.0, 1.0];
        open.into_iter().map(piece).filter(|piece| whole || piece.length() >= SHORTEST_M).collect()
    }

    /// What of the line along a strip of ground `width` metres wide may be flown, in its direction. Where a fence has the strip's middle
    /// beyond it and a side of the strip inside, the line lies on that side.
    pub fn along_strip(&self, line: &Line, width: f64) -> Vec<Line> {
        let mut open = self.clear(line);
        let Some(along) = (line.to - line.from).try_normalize().filter(|_| self.fence().is_some()) else { return open };
        let metres = |p: DVec2| (p - line.from).dot(along);
        let ends = open.iter().flat_map(|piece| [metres(piece.from), metres(piece.to)]);
        let ends: Vec<f64> = std::iter::once(0.0).chain(ends).chain([line.length()]).collect();
        // At sides that cross the strip steeply no piece is as long as that.
        let is_long = |length: f64| length >= width;
        for gap in ends.chunks_exact(2).filter(|gap| is_long(gap[1] - gap[0])) {
            let beside = ASIDE.iter().map(|share| {
                let place = |metres: f64| line.from + along * metres + along.perp() * share * width;
                let mut pieces = self.clear(&Line { from: place(gap[0]), to: place(gap[1]) });
                pieces.retain(|piece| is_long(piece.length()));
                pieces
            });
            open.extend(beside.into_iter().find(|pieces| !pieces.is_empty()).unwrap_or_default());
        }
        open.sort_by(|a, b| metres(a.from).total_cmp(&metres(b.from)));
        open
    }

    /// Where the shortest way between two places bends, in flying order; `None` where there is none.
    pub fn way(&self, from: DVec2, to: DVec2) -> Option<Vec<DVec2>> {
        if self.hold(from) || self.hold(to) {
            return None;
        }
        let limit = self.limit.as_ref();
        let is_straight = match limit.filter(|limit| limit.fence.is_some()) {
            Some(fence) => fence.seen_m(self, from, to).is_finite(),
            None => self.seen_m(from, to).is_finite(),
        };
        if is_straight {
            return Some(Vec::new());
        }
        let inside =
            limit.and_then(|limit| bends((from, to), (&limit.corners, &limit.apart), |a, b| limit.seen_m(self, a, b)));
        match limit.is_some_and(|limit| limit.fence.is_some()) {
            true => inside,
            false => inside.or_else(|| bends((from, to), (&self.corners, &self.apart), |a, b| self.seen_m(a, b))),
        }
    }

    /// Metres between two places with nothing in between, else infinite.
    fn seen_m(&self, from: DVec2, to: DVec2) -> f64 {
        if meets(&self.sides, from, to) { f64::INFINITY } else { from.distance(to) }
    }
}

/// Where the shortest way bends, by the metres between corners and from place to place (Dijkstra 1959).
fn bends(
    (from, to): (DVec2, DVec2),
    (corners, apart): (&[DVec2], &[f64]),
    seen_m: impl Fn(DVec2, DVec2) -> f64,
) -> Option<Vec<DVec2>> {
    let count = corners.len();
    let mut metres: Vec<f64> = corners.iter().map(|c| seen_m(from, *c)).collect();
    let mut before = vec![count; count];
    let mut done = vec![false; count];
    let mut best = (f64::INFINITY, count);
    while let Some(k) = (0..count).filter(|k| !done[*k]).min_by(|i, j| metres[*i].total_cmp(&metres[*j])) {
        if metres[k] >= best.0 {
            break;
        }
        done[k] = true;
        let end = metres[k] + seen_m(corners[k], to);
        if end < best.0 {
            best = (end, k);
        }
        for next in (0..count).filter(|next| !done[*next]) {
            let longer = metres[k] + apart[k * count + next];
            if longer < metres[next] {
                (metres[next], before[next]) = (longer, k);
            }
        }
    }
    let mut at = best.1;
    let mut bends = Vec::new();
    while at < count {
        bends.push(corners[at]);
        at = before[at];
    }
    bends.reverse();
    (!bends.is_empty()).then_some(bends)
}

/// Metres between all corners.
fn between(corners: &[DVec2], metres: impl Fn(DVec2, DVec2) -> f64) -> Vec<f64> {
    corners.iter().flat_map(|a| corners.iter().map(|b| metres(*a, *b))).collect()
}

impl Limit {
    /// Metres between two places with nothing in between and this ground below, else infinite.
    fn seen_m(&self, obstacles: &Obstacles, from: DVec2, to: DVec2) -> f64 {
        match self.ground.contains(from) && self.ground.contains(to) && !meets(&self.sides, from, to) {
            true => obstacles.seen_m(from, to),
            false => f64::INFINITY,
        }
    }
}

/// The sides of all rings.
fn sides(ground: &Ground) -> Vec<[DVec2; 2]> {
    ground.rings().flat_map(|ring| ring.iter().zip(ring.iter().cycle().skip(1)).map(|(a, b)| [*a, *b])).collect()
}

/// Whether a straight way meets one of `sides`.
fn meets(sides: &[[DVec2; 2]], from: DVec2, to: DVec2) -> bool {
    let [low, high] = [from.min(to), from.max(to)];
    let side = |a: DVec2, b: DVec2, p: DVec2| (b - a).perp_dot(p - a);
    let apart = |a: DVec2, b: DVec2, p: DVec2, q: DVec2| side(a, b, p) * side(a, b, q) <= 0.0;
    let beside = |[a, b]: &[DVec2; 2]| a.max(*b).cmplt(low).any() || a.min(*b).cmpgt(high).any();
    sides.iter().filter(|s| !beside(s)).any(|[a, b]| apart(from, to, *a, *b) && apart(*a, *b, from, to))
}

/// Rings and all places within `metres` of them, and a little more at corners.
fn with_room(rings: &[Ring], metres: f64) -> Ground {
    let beside = rings.iter().flat_map(|ring| corridors(ring, metres));
    Ground::covered_by(rings.iter().cloned().chain(beside).collect())
}

/// All places within `metres` of a ring's sides, and a little more at corners.
fn beside(ring: &Ring, metres: f64) -> Ground {
    Ground::covered_by(corridors(ring, metres))
}

fn corridors(ring: &Ring, metres: f64) -> Vec<Ring> {
    let step = std::f64::consts::TAU / f64::from(AROUND);
    let octagon: Vec<DVec2> =
        (0..AROUND).map(|k| DVec2::from_angle(step * (f64::from(k) + 0.5)) * (metres / (0.5 * step).cos())).collect();
    let around = |(a, b): (&DVec2, &DVec2)| polygon::hull(octagon.iter().flat_map(|o| [*a + *o, *b + *o]).collect());
    ring.iter().zip(ring.iter().cycle().skip(1)).map(around).collect()
}

/// Corners of `ground` at which its sides turn away from it: the shortest ways on it bend there.
fn inward(ground: &Ground) -> Vec<DVec2> {
    let of = |ring: &Ring| {
        let count = ring.len();
        let turns = |k: &usize| {
            let [a, b, c] = [*k + count - 1, *k, *k + 1].map(|k| ring[k % count]);
            (b - a).perp_dot(c - b) < 0.0
        };
        (0..count).filter(turns).map(|k| ring[k]).collect::<Vec<_>>()
    };
    ground.rings().flat_map(of).collect()
}

/// A ring with no more than [`MOST_CORNERS`], and how far the old ones are off at most: `off` or more.
fn drawn_coarsely(ring: &Ring, mut off: f64) -> (Ring, f64) {
    loop {
        let drawn = simplified(ring, off);
        if drawn.len() <= MOST_CORNERS {
            return (drawn, off);
        }
        off *= 2.0;
    }
}

/// A ring with as few corners as leave none of the old further off than `off` (Douglas and Peucker 1973).
fn simplified(ring: &Ring, off: f64) -> Ring {
    let Some(first) = ring.first() else { return Ring::new() };
    let far = (0..ring.len()).max_by(|i, j| ring[*i].distance(*first).total_cmp(&ring[*j].distance(*first)));
    let (far, last) = (far.unwrap_or(0), ring.len());
    let at = |k: usize| ring[k % last];
    let mut kept = Vec::new();
    let mut open = vec![(far, last), (0, far)];
    while let Some((from, to)) = open.pop() {
        let error = |k: usize| from_segment_m(at(k), at(from), at(to));
        match (from + 1..to).max_by(|i, j| error(*i).total_cmp(&error(*j))).filter(|k| error(*k) > off) {
            Some(k) => open.extend([(k, to), (from, k)]),
            None => kept.push(at(from)),
        }
    }
    kept
}

/// How far a place is from a straight way.
fn from_segment_m(p: DVec2, a: DVec2, b: DVec2) -> f64 {
    let way = b - a;
    let share = ((p - a).dot(way) / way.length_squared().max(1e-12)).clamp(0.0, 1.0);
    p.distance(a + way * share)
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::ground::tests::rectangle;

    /// How near a way comes to a ring; 0 over it.
    fn nearest_m(path: &[DVec2], ring: &Ring) -> f64 {
        let places = path.windows(2).flat_map(|w| {
            let steps = w[0].distance(w[1]).ceil().max(1.0);
            (0..=steps as usize).map(move |k| w[0].lerp(w[1], k as f64 / steps))
        });
        let from_ring = |p: DVec2| {
            let sides = ring.iter().zip(ring.iter().cycle().skip(1));
            let beside = sides.map(|(a, b)| from_segment_m(p, *a, *b)).fold(f64::MAX, f64::min);
            if polygon::contains(ring, p) { 0.0 } else { beside }
        };
        places.map(from_ring).fold(f64::MAX, f64::min)
    }

    fn path(obstacles: &Obstacles, from: DVec2, to: DVec2) -> Vec<DVec2> {
        let bends = obstacles.way(from, to).expect("a way");
        std::iter::once(from).chain(bends).chain([to]).collect()
    }

    #[test]
    fn ways_lead_round_a_hole_the_shorter_way_and_straight_where_it_is_not_in_between() {
        let hole = rectangle(40.0, 40.0, 20.0, 20.0);
        let obstacles = Obstacles::new(std::slice::from_ref(&hole), 10.0).expect("one");
        let round = path(&obstacles, DVec2::new(0.0, 45.0), DVec2::new(100.0, 45.0));
        assert!(round.len() > 2 && round[1].y < 40.0, "south is shorter: {round:?}");
        let metres: f64 = round.windows(2).map(|w| w[0].distance(w[1])).sum();
        assert!(metres < 110.0 && nearest_m(&round, &hole) >= 10.0, "{metres} m, {round:?}");
        assert_eq!(path(&obstacles, DVec2::new(0.0, 5.0), DVec2::new(100.0, 5.0)).len(), 2);
        assert!(obstacles.hold(DVec2::new(50.0, 31.0)) && !obstacles.hold(DVec2::new(50.0, 26.0)));
        assert_eq!(obstacles.way(DVec2::new(50.0, 50.0), DVec2::ZERO), None, "it stands in the hole");
        assert_eq!(Obstacles::default().way(DVec2::ZERO, DVec2::ONE), Some(Vec::new()));
    }

    #[test]
    fn ways_round_a_hole_near_the_border_stay_inside_and_leave_only_where_there_is_no_other() {
        let area = rectangle(0.0, 0.0, 200.0, 100.0);
        // South of it is the shorter way, and no room between it and the border.
        let hole = rectangle(90.0, 5.0, 20.0, 50.0);
        let [from, to] = [[0.0, 20.0], [200.0, 20.0]].map(DVec2::from);
        let free = Obstacles::new(std::slice::from_ref(&hole), 10.0).expect("one");
        assert!(path(&free, from, to).iter().any(|p| p.y < -5.0));
        let inside = free.inside(&area, 3.0);
        let round = path(&inside, from, to);
        assert!(round.len() > 2 && round.iter().all(|p| (0.0..=100.0).contains(&p.y)), "{round:?}");
        assert!(nearest_m(&round, &hole) >= 10.0);
        // A take-off place outside, and a hole across the whole area.
        assert!(path(&inside, from, DVec2::new(100.0, -40.0)).len() > 1);
        let across = rectangle(90.0, -5.0, 20.0, 110.0);
        let split = Obstacles::new(&[across], 10.0).expect("one").inside(&area, 3.0);
        assert!(path(&split, from, to).len() > 2);
    }

    #[test]
    fn no_way_leaves_a_fence_where_a_hole_lies_across_it() {
        let (fence, across) = (rectangle(0.0, 0.0, 200.0, 100.0), rectangle(90.0, -5.0, 20.0, 110.0));
        let free = Obstacles::new(&[across], 10.0).expect("one");
        let [from, to] = [[20.0, 20.0], [180.0, 20.0]].map(DVec2::from);
        assert!(free.way(from, to).is_some());
        assert_eq!(free.fenced(&fence).expect("room").way(from, to), None);
    }

    #[test]
    fn lines_end_before_a_hole_and_go_on_behind_it() {
        let hole = rectangle(40.0, 40.0, 20.0, 20.0);
        let obstacles = Obstacles::new(std::slice::from_ref(&hole), 10.0).expect("one");
        let line = |from: [f64; 2], to: [f64; 2]| Line { from: from.into(), to: to.into() };
        let pieces = obstacles.clear(&line([100.0, 50.0], [0.0, 50.0]));
        assert!(pieces.len() == 2 && pieces[0].from.x == 100.0 && pieces[1].to.x == 0.0, "{pieces:?}");
        for piece in &pieces {
            let off = nearest_m(&[piece.from, piece.to], &hole);
            assert!((10.0..15.0).contains(&off), "{off} m");
        }
        let beside = line([0.0, 5.0], [100.0, 5.0]);
        assert_eq!(obstacles.clear(&beside), [beside]);
        assert!(obstacles.clear(&line([45.0, 50.0], [55.0, 50.0])).is_empty());
        assert_eq!(Obstacles::default().clear(&beside), [beside]);
    }

    #[test]
    fn what_a_hole_encloses_is_reached_by_no_way_and_too_many_corners_are_refused() {
        // A moat around a yard of 100 m, drawn as one ring with a slit.
        let (outside, inside) = (rectangle(0.0, 0.0, 200.0, 200.0), rectangle(50.0, 50.0, 100.0, 100.0));
        let mut moat = outside.clone();
        moat.push(outside[0]);
        moat.extend([inside[0], inside[3], inside[2], inside[1], inside[0]]);
        let obstacles = Obstacles::new(&[moat], 5.0).expect("a moat");
        assert_eq!(obstacles.way(DVec2::splat(100.0), DVec2::splat(-100.0)), None);
        assert!(obstacles.way(DVec2::splat(80.0), DVec2::splat(120.0)).is_some());
        let trees: Vec<Ring> = (0..100).map(|k| rectangle(f64::from(k) * 50.0, 0.0, 5.0, 5.0)).collect();
        let refused = Obstacles::new(&trees, 5.0).expect_err("too many").to_string();
        assert!(refused.contains("has holes of 400 corners") && refused.contains("draw them simpler"), "{refused}");
    }

    #[test]
    fn a_circle_of_many_corners_is_flown_round_by_a_few() {
        let circle: Ring = (0..360).map(|k| DVec2::from_angle(f64::from(k).to_radians()) * 30.0).collect();
        let obstacles = Obstacles::new(std::slice::from_ref(&circle), 10.0).expect("one");
        assert!(obstacles.corners.len() < 32, "{}", obstacles.corners.len());
        let round = path(&obstacles, DVec2::new(-80.0, 0.0), DVec2::new(80.0, 0.0));
        let off = nearest_m(&round, &circle);
        assert!((10.0..16.0).contains(&off), "{off} m");
    }

    /// Stars, which overlap or not, by seed.
    #[test]
    fn a_thousand_ways_among_holes_by_seed_keep_their_clearance() {
        let mut rng = Pcg64Mcg::seed_from_u64(59);
        let mut bent = 0;
        for _ in 0..50 {
            let holes: Vec<Ring> = (0..rng.random_range(1..6))
                .map(|_| {
                    let middle = DVec2::new(rng.random_range(0.0..400.0), rng.random_range(0.0..400.0));
                    let corners = rng.random_range(3..9);
                    let step = std::f64::consts::TAU / f64::from(corners);
                    (0..corners)
                        .map(|k| middle + DVec2::from_angle(step * f64::from(k)) * rng.random_range(5.0..70.0))
                        .collect()
                })
                .collect();
            let clearance = rng.random_range(1.0..20.0);
            let obstacles = Obstacles::new(&holes, clearance).expect("holes");
            for _ in 0..20 {
                let [from, to] =
                    [0, 1].map(|_| DVec2::new(rng.random_range(-99.0..499.0), rng.random_range(-99.0..499.0)));
                match obstacles.way(from, to) {
                    Some(bends) => {
                        let path: Vec<DVec2> = std::iter::once(from).chain(bends).chain([to]).collect();
                        bent += usize::from(path.len() > 2);
                        for hole in &holes {
                            let off = nearest_m(&path, hole);
                            assert!(off > clearance - 1e-6, "{off} m of {clearance} m: {path:?} round {hole:?}");
                        }
                    }
                    // It begins or ends too near to a hole, or holes that overlap enclose it.
                    None => {
                        let closed = &obstacles.closed;
                        let encloses = closed.rings().count() > closed.parts.len();
                        assert!(encloses || obstacles.hold(from) || obstacles.hold(to), "{from} {to} {holes:?}");
                    }
                }
            }
        }
        assert!(bent > 100, "{bent}");
    }

    /// A star: any of its corners may point inwards.
    fn star(rng: &mut Pcg64Mcg, middle: DVec2, corners: std::ops::Range<u32>, radii: std::ops::Range<f64>) -> Ring {
        let corners = rng.random_range(corners);
        let step = std::f64::consts::TAU / f64::from(corners);
        (0..corners)
            .map(|k| middle + DVec2::from_angle(step * f64::from(k)) * rng.random_range(radii.clone()))
            .collect()
    }

    #[test]
    fn a_strip_whose_middle_is_beyond_the_fence_has_a_line_on_its_side_inside() {
        let fenced = Obstacles::default().fenced(&rectangle(0.0, 0.0, 200.0, 100.0)).expect("room");
        let strip = |north: f64| Line { from: DVec2::new(-5.0, north), to: DVec2::new(205.0, north) };
        let inside = fenced.along_strip(&strip(50.0), 20.0);
        assert_eq!((inside.len(), inside[0].from.y), (1, 50.0));
        let aside = fenced.along_strip(&strip(102.0), 20.0);
        assert_eq!((aside.len(), aside[0].from.y), (1, 97.0), "a quarter of its width inwards");
        assert!(fenced.along_strip(&strip(115.0), 20.0).is_empty(), "no side of it is inside");
        assert!(Obstacles::default().along_strip(&strip(102.0), 20.0).len() == 1, "without a fence the middle");
    }

    #[test]
    fn lines_and_ways_inside_fences_by_seed_never_leave_them() {
        let mut rng = Pcg64Mcg::seed_from_u64(60);
        let (mut bent, mut cut, mut none) = (0, 0, 0);
        for _ in 0..60 {
            let fence = star(&mut rng, DVec2::ZERO, 5..16, 40.0..300.0);
            let holes: Vec<Ring> = (0..rng.random_range(0..4))
                .map(|_| {
                    let middle = DVec2::new(rng.random_range(-150.0..150.0), rng.random_range(-150.0..150.0));
                    star(&mut rng, middle, 3..9, 5.0..30.0)
                })
                .collect();
            let clearance = rng.random_range(1.0..10.0);
            let obstacles = Obstacles::new(&holes, clearance).and_then(|free| free.fenced(&fence)).expect("room");
            let keeps = |path: &[DVec2]| {
                let inside = path.iter().all(|p| polygon::contains(&fence, *p));
                let sides = fence.iter().zip(fence.iter().cycle().skip(1)).map(|(a, b)| vec![*a, *b]);
                let off = sides.map(|side| nearest_m(path, &side)).fold(f64::MAX, f64::min);
                assert!(inside && off >= FENCE_M - 1e-6, "{off} m from {fence:?}: {path:?}");
                holes.iter().for_each(|hole| assert!(nearest_m(path, hole) > clearance - 1e-6, "{path:?} {hole:?}"));
            };
            for _ in 0..20 {
                let [from, to] =
                    [0, 1].map(|_| DVec2::new(rng.random_range(-300.0..300.0), rng.random_range(-300.0..300.0)));
                let pieces = obstacles.clear(&Line { from, to });
                cut += pieces.len();
                pieces.iter().for_each(|piece| keeps(&[piece.from, piece.to]));
                let Some(first) = pieces.first() else { continue };
                let Some(p) = pieces.last().map(|piece| piece.to) else { continue };
                match obstacles.way(first.from, p) {
                    Some(bends) => {
                        bent += usize::from(!bends.is_empty());
                        let path: Vec<DVec2> = std::iter::once(first.from).chain(bends).chain([p]).collect();
                        keeps(&path);
                    }
                    // A neck too narrow, or holes from side to side.
                    None => {
                        none += 1;
                        let ground = obstacles.fence().expect("a fence").without(&obstacles.wide);
                        let of = |p: DVec2| ground.parts.iter().position(|part| nearest_m(&[p, p], &part[0]) < 0.01);
                        assert!(
                            ground.parts.len() > 1 && of(first.from) != of(p),
                            "{} {p} {fence:?} {holes:?}",
                            first.from
                        );
                    }
                }
                assert!(polygon::contains(&fence, from) || obstacles.way(from, p).is_none(), "it begins outside");
            }
        }
        assert!(bent > 60 && cut > 300 && none < 100, "{bent} {cut} {none}");
        let slit = rectangle(0.0, 0.0, 500.0, 4.0);
        assert!(Obstacles::default().fenced(&slit).expect_err("no room").to_string().contains("no room inside"));
    }
}

//! Who answers for which piece of ground.
//!
//! Inside a region its aircraft does. Beyond all regions the nearest one does, so that the border of the scene, which
//! the outer aircraft see beyond their own polygons, belongs to somebody. A model without a region gets the hull of
//! the points its cameras look at. Near a border a polygon says little: there the ground is of whoever saw it best.

use std::collections::HashMap;

use geometry::polygon::hull;
use glam::{DVec2, DVec3};
use models::formats::model::ModelHeader;
use serde::{Deserialize, Serialize};
use uplink::polygon;

use super::member::{Bounds, Member};
use super::visibility::Visibility;

/// Distances closer than this count as equal, metres: corners that two polygons share differ by rounding.
const TIE_M: f64 = 1e-6;
/// Squares of ground along a middling region, and how many of them make a coarse one.
const SQUARES: f64 = 16.0;
const COARSE: f64 = 64.0;
/// Squares across the strip along a border in which it is asked who saw the ground best.
const STRIP_SQUARES: f64 = 8.0;
/// By so much another aircraft must have seen the ground of a region better than its own: the same ground should not change hands
/// for a picture more or less.
const CLEARLY: f64 = 1.25;

/// Corners of a region in a file, far more than any has.
const MOST_CORNERS: usize = 1 << 20;

/// The part of the ground one aircraft answers for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Region {
    /// Corners in order, metres east and north; 1 or 2 are allowed (a point, a line).
    pub corners: Vec<DVec2>,
    /// Given by the mission, not derived from the views.
    pub declared: bool,
    /// Its pictures; the nearer camera decides between derived regions that overlap.
    visibility: Visibility,
}

impl Region {
    /// A region of the mission.
    pub fn declared(corners: Vec<DVec2>) -> Self {
        Self { corners, declared: true, visibility: Visibility::default() }
    }

    /// The declared region of a model, or the hull of what its cameras look at on ground of this height. None when there is
    /// neither.
    pub fn of(header: &ModelHeader, ground: f64) -> Option<Self> {
        let visibility = Visibility::new(header.views.iter().map(|(_, v)| *v), ground);
        if header.region.len() >= 3 {
            let corners = header.region.iter().map(|c| DVec2::from(*c)).collect();
            return Some(Self { corners, declared: true, visibility });
        }
        let looked_at = header.views.iter().map(|(_, v)| look_at(v.pose.center, v.pose.forward(), ground));
        let corners = hull(looked_at.collect());
        (!corners.is_empty()).then_some(Self { corners, declared: false, visibility })
    }

    /// Whether a plan may have it.
    pub fn is_usable(&self) -> bool {
        (1..=MOST_CORNERS).contains(&self.corners.len()) && self.corners.iter().all(|p| p.is_finite())
    }

    /// Whether the point lies inside or on the border (even-odd rule, so concave polygons work).
    pub fn contains(&self, p: DVec2) -> bool {
        self.distance(p) <= TIE_M
    }

    /// Metres to the region; 0 inside.
    pub fn distance(&self, p: DVec2) -> f64 {
        polygon::distance(&self.corners, p)
    }
}

/// Every piece of ground has exactly one owner.
#[derive(Clone, Debug)]
pub struct Partition {
    /// In the order of the models.
    pub regions: Vec<Option<Region>>,
    /// Side of the squares of ground for which it is known which regions may be the nearest.
    square_m: f64,
    /// Ground no farther than this from another region may be that one's.
    border_m: f64,
}

impl Partition {
    /// The partition of these models' regions; within `border_m` of a border the ground is of whoever saw it best.
    pub fn new(members: &[Member], border_m: f32) -> Self {
        Self::of(members.iter().map(|m| Region::of(&m.header, m.middle().z)).collect(), border_m.into())
    }

    /// The partition of these regions.
    pub fn of(regions: Vec<Option<Region>>, border_m: f64) -> Self {
        let side = |r: &Region| r.corners.iter().fold(Bounds::EMPTY, |b, c| b.around(*c)).span().max_element();
        let mut sides: Vec<f64> = regions.iter().flatten().map(side).collect();
        sides.sort_by(f64::total_cmp);
        let middling = sides.get(sides.len() / 2).copied().unwrap_or(1.0);
        Self { regions, square_m: (middling / SQUARES).max(1e-3), border_m }
    }

    /// To ask for owners of many points.
    pub fn owners(&self) -> Owners<'_> {
        Owners { partition: self, near: [HashMap::new(), HashMap::new()], seen: HashMap::new() }
    }

    /// Index of the model among `candidates`, in rising order, that answers for a point; 0 when none of them has a region.
    fn owner(&self, p: DVec2, candidates: impl Iterator<Item = usize>) -> usize {
        let mut best: Option<(usize, f64, &Region)> = None;
        for i in candidates {
            let Some(region) = &self.regions[i] else { continue };
            let distance = region.distance(p);
            let wins = match best {
                None => true,
                Some((_, least, _)) if distance < least - TIE_M => true,
                Some((_, least, _)) if distance > least + TIE_M => false,
                // On a common border, or where regions overlap: what the mission says before what we derived, then
                // the nearer camera, then the earlier model.
                Some((_, _, other)) if region.declared != other.declared => region.declared,
                Some((_, _, other)) => {
                    !region.declared && region.visibility.to_camera(p) < other.visibility.to_camera(p)
                }
            };
            if wins {
                best = Some((i, distance, region));
            }
        }
        best.map_or(0, |b| b.0)
    }
}

/// Answers for many points: looks at the few regions that may be the nearest in a point's square of ground, so that a point
/// costs what its neighbourhood costs, however many aircraft there are.
#[derive(Debug)]
pub struct Owners<'a> {
    partition: &'a Partition,
    /// By square, the regions that may own a point of it: squares of [`Partition::square_m`], and of [`COARSE`] times that,
    /// in which those of the small ones are looked for.
    near: [HashMap<(i64, i64), Vec<usize>>; 2],
    /// By square of the strips along borders and model: how well it saw the middle.
    seen: HashMap<((i64, i64), usize), f64>,
}

impl Owners<'_> {
    /// Index of the model that answers for a point; 0 when no model has a region.
    pub fn owner(&mut self, p: DVec2) -> usize {
        let Self { partition, near: [few, several], seen } = self;
        let (fine, coarse) = (partition.square_m, partition.square_m * COARSE);
        let middle = |side: f64| ((p / side).floor() + 0.5) * side;
        let of = |i: usize| Some((i, partition.regions[i].as_ref()?));
        let few = few.entry(square_of(p, fine)).or_insert_with(|| {
            let all = (0..partition.regions.len()).filter_map(of);
            let several = several
                .entry(square_of(p, coarse))
                .or_insert_with(|| nearest(all, middle(coarse), coarse, partition.border_m));
            nearest(several.iter().copied().filter_map(of), middle(fine), fine, partition.border_m)
        });
        let owner = partition.owner(p, few.iter().copied());
        let region = |model: usize| partition.regions.get(model).and_then(Option::as_ref);
        let Some(own) = region(owner).filter(|_| partition.border_m > 0.0 && few.len() > 1) else { return owner };
        let (reach, side) = (own.distance(p) + partition.border_m, partition.border_m / STRIP_SQUARES);
        let mut seen = |model: usize, of: &Region| {
            let middle = ((p / side).floor() + 0.5) * side;
            *seen.entry((square_of(p, side), model)).or_insert_with(|| of.visibility.pixels_per_m2(middle))
        };
        let (mut best, mut most) = (owner, None);
        for rival in few.iter().copied().filter(|i| *i != owner) {
            let Some(of) = region(rival).filter(|r| r.distance(p) <= reach) else { continue };
            let least = most.unwrap_or_else(|| CLEARLY * seen(owner, own));
            most = Some(least);
            if seen(rival, of) > least {
                (best, most) = (rival, Some(seen(rival, of)));
            }
        }
        best
    }
}

fn square_of(p: DVec2, side: f64) -> (i64, i64) {
    ((p.x / side).floor() as i64, (p.y / side).floor() as i64)
}

/// Regions that may own a point of the square of this side around `middle`, in their order: the nearest, and those no farther
/// than `border_m` beyond it.
pub fn nearest<'a>(
    among: impl Iterator<Item = (usize, &'a Region)>,
    middle: DVec2,
    side: f64,
    border_m: f64,
) -> Vec<usize> {
    let distances: Vec<(usize, f64)> = among.map(|(i, region)| (i, region.distance(middle))).collect();
    let least = distances.iter().map(|d| d.1).fold(f64::INFINITY, f64::min);
    // From the middle to any point of the square, both distances change by half its diagonal at most.
    let reach = least + border_m + side * std::f64::consts::SQRT_2 + 2.0 * TIE_M;
    distances.into_iter().filter(|d| d.1 <= reach).map(|d| d.0).collect()
}

/// Where the optical axis meets the ground, no farther off than three times the height; below the camera when it looks up.
fn look_at(center: DVec3, forward: DVec3, ground: f64) -> DVec2 {
    let height = center.z - ground;
    let reach = if forward.z < -1e-6 && height > 0.0 { height / -forward.z } else { 0.0 };
    let offset = forward.truncate() * reach;
    center.truncate() + offset.clamp_length_max(3.0 * height.max(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::nadir;

    fn region(corners: &[[f64; 2]], declared: bool) -> Region {
        Region {
            corners: corners.iter().map(|c| DVec2::from(*c)).collect(),
            declared,
            visibility: Visibility::default(),
        }
    }

    /// Pictures taken straight down from these places, 20 m above the ground.
    fn over(places: Vec<[f64; 2]>) -> Visibility {
        Visibility::new(places.into_iter().map(|[x, y]| nadir(x, y, 20.0)), 0.0)
    }

    fn owner(partition: &Partition, p: DVec2) -> usize {
        partition.owners().owner(p)
    }

    #[test]
    fn the_owner_found_among_the_regions_near_by_is_the_owner_among_all() {
        let mut random = 7u64;
        let mut next = |to: f64| {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (random >> 33) as f64 / (1u64 << 31) as f64 * to
        };
        let mut regions = Vec::new();
        for i in 0..60 {
            let (x, y, w, h) = (next(2000.0), next(2000.0), 20.0 + next(200.0), 20.0 + next(200.0));
            let mut region = region(&[[x, y], [x + w, y], [x + 0.5 * w, y + 0.3 * h], [x, y + h]], i % 3 > 0);
            region.visibility = over((0..4).map(|_| [x + next(w), y + next(h)]).collect());
            regions.push((i % 10 > 0).then_some(region));
        }
        let partition = Partition::of(regions, 0.0);
        let mut owners = partition.owners();
        for _ in 0..20_000 {
            let p = DVec2::new(next(6000.0) - 2000.0, next(6000.0) - 2000.0);
            assert_eq!(owners.owner(p), partition.owner(p, 0..60), "{p}");
        }
        let few: usize = owners.near[0].values().map(Vec::len).sum();
        assert!(few < 12 * owners.near[0].len(), "{few} candidates in {} squares", owners.near[0].len());
    }

    #[test]
    fn a_concave_region_does_not_own_its_notch() {
        // An L: the square 0..2 without its upper right quarter.
        let l = region(&[[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 1.0], [1.0, 2.0], [0.0, 2.0]], true);
        assert!(l.contains(DVec2::new(0.5, 1.5)) && l.contains(DVec2::new(1.5, 0.5)));
        assert!(!l.contains(DVec2::new(1.5, 1.5)));
        assert!((l.distance(DVec2::new(1.5, 1.5)) - 0.5).abs() < 1e-12);
        // Either direction of travel describes the same region.
        let mut reversed = l.clone();
        reversed.corners.reverse();
        for p in [[0.5, 1.5], [1.5, 1.5], [-1.0, 3.0]] {
            assert_eq!(l.distance(p.into()), reversed.distance(p.into()));
        }
    }

    #[test]
    fn a_point_on_the_common_border_has_exactly_one_owner() {
        let west = region(&[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], true);
        let east = region(&[[1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 1.0]], true);
        let p = Partition::of(vec![Some(west), Some(east)], 0.0);
        for y in [0.0, 0.5, 1.0, 7.0] {
            assert_eq!(owner(&p, DVec2::new(1.0, y)), 0);
        }
        assert_eq!(owner(&p, DVec2::new(0.999, 0.5)), 0);
        assert_eq!(owner(&p, DVec2::new(1.001, 0.5)), 1);
    }

    #[test]
    fn ground_beyond_all_regions_belongs_to_the_nearest() {
        let west = region(&[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], true);
        let east = region(&[[3.0, 0.0], [4.0, 0.0], [4.0, 1.0], [3.0, 1.0]], true);
        let p = Partition::of(vec![Some(west), Some(east)], 0.0);
        assert_eq!(owner(&p, DVec2::new(-100.0, 0.5)), 0);
        assert_eq!(owner(&p, DVec2::new(100.0, 0.5)), 1);
        assert_eq!(owner(&p, DVec2::new(1.9, 0.5)), 0);
        assert_eq!(owner(&p, DVec2::new(2.1, 0.5)), 1);
    }

    #[test]
    fn declared_regions_come_before_derived_ones_and_none_owns_nothing() {
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let p = Partition::of(vec![None, Some(region(&square, false)), Some(region(&square, true))], 0.0);
        assert_eq!(owner(&p, DVec2::new(0.5, 0.5)), 2);
        assert_eq!(owner(&Partition::of(vec![None, None], 0.0), DVec2::ZERO), 0);
    }

    #[test]
    fn overlapping_derived_regions_are_split_by_the_nearer_camera() {
        let mut a = region(&[[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [0.0, 1.0]], false);
        let mut b = region(&[[1.0, 0.0], [4.0, 0.0], [4.0, 1.0], [1.0, 1.0]], false);
        (a.visibility, b.visibility) = (over(vec![[1.0, 0.5]]), over(vec![[3.0, 0.5]]));
        let p = Partition::of(vec![Some(a), Some(b)], 0.0);
        assert_eq!(owner(&p, DVec2::new(1.9, 0.5)), 0);
        assert_eq!(owner(&p, DVec2::new(2.1, 0.5)), 1);
    }

    #[test]
    fn near_a_border_the_ground_is_of_whoever_saw_it_clearly_better() {
        let mut west = region(&[[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]], true);
        let mut east = region(&[[40.0, 0.0], [80.0, 0.0], [80.0, 40.0], [40.0, 40.0]], true);
        // West's last line lies on the border and east's first one 16 m beyond it: from there a picture reaches 12.8 m.
        (west.visibility, east.visibility) = (
            over(vec![[38.0, 16.0], [38.0, 20.0], [38.0, 24.0]]),
            over(vec![[56.0, 16.0], [56.0, 20.0], [56.0, 24.0]]),
        );
        let of = |border_m: f64| Partition::of(vec![Some(west.clone()), Some(east.clone())], border_m);
        let at = |x: f64| DVec2::new(x, 20.0);
        assert_eq!(owner(&of(0.0), at(42.0)), 1, "a border is a border without a strip");
        assert_eq!(owner(&of(8.0), at(42.0)), 0, "only west saw it");
        assert_eq!(owner(&of(8.0), at(46.5)), 1, "both saw it alike");
        assert_eq!(owner(&of(1.0), at(42.0)), 1, "beyond the strip");
        assert_eq!(owner(&of(8.0), at(39.0)), 0);
        assert_eq!(owner(&of(8.0), DVec2::new(42.0, 4.0)), 1, "nobody saw it");
    }

    #[test]
    fn a_model_of_one_camera_has_a_point_for_its_region() {
        assert_eq!(region(&[[1.0, 2.0]], false).distance(DVec2::new(1.0, 5.0)), 3.0);
    }

    #[test]
    fn a_camera_that_looks_at_the_horizon_does_not_claim_it() {
        let far = look_at(DVec3::new(0.0, 0.0, 50.0), DVec3::new(1.0, 0.0, -1e-4), 0.0);
        assert_eq!(far, DVec2::new(150.0, 0.0));
        assert_eq!(look_at(DVec3::new(5.0, 5.0, 50.0), DVec3::Z, 0.0), DVec2::new(5.0, 5.0));
    }
}

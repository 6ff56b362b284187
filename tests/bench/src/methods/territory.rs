//! Who flies where: the data set's own regions, or as many as wanted with equally many pictures each.

use glam::DVec2;
use ground::region::Region;
use survey::dataset::Dataset;

use runtime::error::JobError;

/// Ground around the outermost cameras that still belongs to their region, metres: a region has an area even where all cameras are
/// in one line.
const RIM_M: f64 = 1.0;

/// One aircraft's region, a rectangle of ground, and its pictures.
#[derive(Clone, Debug, PartialEq)]
pub struct Territory {
    /// Its name.
    pub name: String,
    /// South-western corner, metres.
    pub low: DVec2,
    /// North-eastern corner.
    pub high: DVec2,
    /// Training pictures that its aircraft took.
    pub own: Vec<usize>,
    /// Held-out pictures taken there.
    pub held_out: Vec<usize>,
}

impl Territory {
    /// As the ground's merging sees it.
    pub fn region(&self) -> Region {
        let (low, high) = (self.low, self.high);
        Region::declared(vec![low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)])
    }
}

/// The data set's regions, or a balanced partition into `wanted`.
///
/// # Errors
/// A list that the data set does not have; fewer pictures than regions.
pub fn divide(set: &Dataset, split: &str, wanted: Option<usize>, usual: usize) -> Result<Vec<Territory>, JobError> {
    let (training, held_out) = (set.select(split, None)?, set.select("test", None)?);
    let held_out: Vec<usize> = held_out.into_iter().filter(|i| !training.contains(i)).collect();
    for (name, list) in [(split, &training), ("test", &held_out)] {
        if list.is_empty() {
            return Err(JobError::Request(format!("{}: its list {name:?} holds no pictures", set.root.display())));
        }
    }
    let at = |i: &usize| (*i, set.frames[*i].view.pose.center.truncate());
    let mut territories = if wanted.is_none() && !set.split.regions.is_empty() {
        of_data_set(set)
    } else {
        let n = wanted.unwrap_or(usual);
        if training.len() < 2 * n {
            let what =
                format!("{} training pictures are too few for {n} regions; give fewer --regions", training.len());
            return Err(JobError::Request(format!("{}: {what}", set.root.display())));
        }
        balanced(&training.iter().map(at).collect::<Vec<_>>(), n)
    };
    // A picture that no region lists was taken by the aircraft whose region is the nearest.
    let regions: Vec<Region> = territories.iter().map(Territory::region).collect();
    let nearest = |at: DVec2| {
        let distance = |r: &usize| regions[*r].distance(at);
        (0..regions.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0)
    };
    for (list, frames) in [(split, &training), ("test", &held_out)] {
        for (i, at) in frames.iter().map(at) {
            let listed = |t: &Territory| {
                let of_region = set.region(&t.name).filter(|_| wanted.is_none());
                of_region.and_then(|r| r.lists.get(list)).is_some_and(|l| l.contains(&i))
            };
            let owner = territories.iter().position(listed).or(territories.iter().position(|t| t.own.contains(&i)));
            let owner = &mut territories[owner.unwrap_or_else(|| nearest(at))];
            let into = if list == "test" { &mut owner.held_out } else { &mut owner.own };
            if !into.contains(&i) {
                into.push(i);
            }
        }
    }
    if let Some(empty) = territories.iter().find(|t| t.own.is_empty()) {
        let what = format!("region {} has no picture of the list {split:?}", empty.name);
        return Err(JobError::Request(format!("{}: {what}; give --regions to divide it anew", set.root.display())));
    }
    Ok(territories)
}

fn of_data_set(set: &Dataset) -> Vec<Territory> {
    let of = |r: &survey::dataset::FlownRegion| {
        let corners = r.polygon.iter().map(|c| DVec2::from(*c));
        let (low, high) = corners
            .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high): (DVec2, DVec2), c| (low.min(c), high.max(c)));
        Territory { name: r.name.clone(), low, high, own: Vec::new(), held_out: Vec::new() }
    };
    set.split.regions.iter().map(of).collect()
}

/// `n` rectangles that tile the ground below the cameras, with equally many of them, or one more, in each: cut in two across the longer
/// side, again and again.
pub fn balanced(cameras: &[(usize, DVec2)], n: usize) -> Vec<Territory> {
    let around = |(low, high): (DVec2, DVec2), (_, at): &(usize, DVec2)| (low.min(*at), high.max(*at));
    let (low, high) = cameras.iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), around);
    let mut territories = Vec::with_capacity(n);
    cut(cameras.to_vec(), [low - RIM_M, high + RIM_M], n.max(1), &mut territories);
    territories
}

fn cut(mut cameras: Vec<(usize, DVec2)>, [low, high]: [DVec2; 2], n: usize, into: &mut Vec<Territory>) {
    if n == 1 || cameras.len() < 2 {
        let mut own: Vec<usize> = cameras.into_iter().map(|c| c.0).collect();
        own.sort_unstable();
        into.push(Territory { name: into.len().to_string(), low, high, own, held_out: Vec::new() });
        return;
    }
    let axis = usize::from(high.y - low.y > high.x - low.x);
    cameras.sort_by(|a, b| a.1[axis].total_cmp(&b.1[axis]).then(a.0.cmp(&b.0)));
    let first = n / 2;
    // Rounded down or up, so that both halves have between ⌊len/n⌋ and ⌈len/n⌉ a region, and by induction all of their regions.
    let at = ((cameras.len() * first + n / 2) / n).clamp(1, cameras.len() - 1);
    let rest = cameras.split_off(at);
    let border = 0.5 * (cameras[at - 1].1[axis] + rest[0].1[axis]);
    let (mut low_of_rest, mut high_of_first) = (low, high);
    (low_of_rest[axis], high_of_first[axis]) = (border, border);
    cut(cameras, [low, high_of_first], first, into);
    cut(rest, [low_of_rest, high], n - first, into);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scattered(n: usize) -> Vec<(usize, DVec2)> {
        let mut random = 9u64;
        let mut next = |to: f64| {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> 33) as f64 / (1u64 << 31) as f64 * to
        };
        (0..n).map(|i| (i, DVec2::new(next(300.0), next(100.0)))).collect()
    }

    #[test]
    fn a_partition_is_balanced_covers_every_camera_once_and_tiles_the_ground() {
        for (cameras, n) in [(43, 3), (84, 6), (11, 6), (17, 5), (100, 7), (6, 6), (9, 1)] {
            let all = scattered(cameras);
            let parts = balanced(&all, n);
            assert_eq!(parts.len(), n);
            let mut seen: Vec<usize> = parts.iter().flat_map(|p| p.own.clone()).collect();
            seen.sort_unstable();
            assert_eq!(seen, (0..cameras).collect::<Vec<_>>(), "each once");
            let counts = parts.iter().map(|p| p.own.len());
            assert!(counts.clone().max().unwrap_or(0) - counts.min().unwrap_or(0) <= 1, "{cameras} in {n}");
            for part in &parts {
                let region = part.region();
                assert!(part.own.iter().all(|i| region.contains(all[*i].1)), "{part:?}");
            }
            let area = |low: DVec2, high: DVec2| (high - low).x * (high - low).y;
            let low = parts.iter().fold(DVec2::INFINITY, |l, p| l.min(p.low));
            let high = parts.iter().fold(DVec2::NEG_INFINITY, |h, p| h.max(p.high));
            let tiles: f64 = parts.iter().map(|p| area(p.low, p.high)).sum();
            assert!((tiles - area(low, high)).abs() < 1e-6 * tiles, "no gap, no overlap");
        }
    }

    #[test]
    fn cameras_in_one_line_or_at_one_place_still_make_regions_with_an_area() {
        let line: Vec<(usize, DVec2)> = (0..10).map(|i| (i, DVec2::new(5.0, i as f64))).collect();
        let place = vec![(0, DVec2::ZERO); 4];
        for (cameras, n) in [(line, 3), (place, 2)] {
            for part in balanced(&cameras, n) {
                assert!(part.high.x > part.low.x && part.high.y >= part.low.y && !part.own.is_empty(), "{part:?}");
            }
        }
    }
}

//! Which Gaussians of a scene are kept: those that are finite, and of more than there is room for the most important ones. Found in a
//! few readings of the scene, in memory that does not grow with it.

use crate::error::TrainError;
use models::cloud::GaussianCloud;

/// Reads a scene from its beginning to its end and gives it away in pieces, whole Gaussians each. It is called as often as the scene has
/// to be visited and must give the same Gaussians in the same order every time.
pub type Pieces<'a, E> = &'a dyn Fn(&mut dyn FnMut(&GaussianCloud) -> Result<(), E>) -> Result<(), E>;

/// What became of a cloud's Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LoadReport {
    /// Gaussians now trained.
    pub loaded: usize,
    /// Those with numbers that are not finite or a quaternion that cannot be normalised.
    pub dropped_non_finite: usize,
    /// Those beyond the plan's capacity; the least important (opacity × area) made way.
    pub dropped_over_capacity: usize,
}

/// Rows of a piece that are visited together: bounds the lists of their visitors.
const ROWS: usize = 16 << 10;
/// Weights are counted by half of their bits, then by the other half.
const HALF: usize = 1 << 16;

/// What is done with rows of a piece.
type Take<'a, E> = &'a mut dyn FnMut(&GaussianCloud, &[u32]) -> Result<(), E>;

/// A scene, and which of its Gaussians are kept.
pub(crate) struct Kept<'a, E> {
    pieces: Pieces<'a, E>,
    least: Option<Least>,
}

/// Of more Gaussians than there is room for: the weight of the last that finds some.
#[derive(Clone, Copy)]
struct Least {
    weight: u32,
    /// How many of just this weight are kept, the first ones.
    ties: u64,
}

impl<'a, E: From<TrainError>> Kept<'a, E> {
    /// The most important `capacity` Gaussians of `pieces`.
    pub fn new(pieces: Pieces<'a, E>, capacity: usize) -> Result<(Self, LoadReport), E> {
        let mut kept = Self { pieces, least: None };
        let (mut all, mut valid) = (0, 0);
        pieces(&mut |cloud| {
            all += cloud.len();
            valid += (0..cloud.len()).filter(|i| cloud.is_valid(*i)).count();
            Ok(())
        })?;
        if valid > capacity {
            let (high, above) = kept.bucket(capacity as u64, |weight| Some(weight >> 16))?;
            let room = capacity as u64 - above;
            let (low, above) = kept.bucket(room, |weight| (weight >> 16 == high).then_some(weight & 0xffff))?;
            kept.least = Some(Least { weight: high << 16 | low, ties: room - above });
        }
        let loaded = valid.min(capacity);
        let report = LoadReport { loaded, dropped_non_finite: all - valid, dropped_over_capacity: valid - loaded };
        Ok((kept, report))
    }

    /// Among the Gaussians that have a half of their weight counted, the half of the one with which `room` is used up, and how many have
    /// a larger one.
    fn bucket(&self, room: u64, half: impl Fn(u32) -> Option<u32>) -> Result<(u32, u64), E> {
        let mut counts = vec![0u64; HALF];
        self.each(&mut |cloud, rows| {
            let halves = rows.iter().filter_map(|row| half(weight(cloud, *row as usize)));
            halves.for_each(|half| counts[half as usize] += 1);
            Ok(())
        })?;
        let mut above = 0;
        for (half, count) in counts.iter().enumerate().rev() {
            if above + count >= room {
                return Ok((half as u32, above));
            }
            above += count;
        }
        Err(TrainError::SceneChanged.into())
    }

    /// Gives every Gaussian that is kept, in order: a piece and its rows, a bounded number of them at a time.
    pub fn each(&self, take: Take<'_, E>) -> Result<(), E> {
        let mut ties = self.least.map_or(0, |least| least.ties);
        let mut rows = Vec::with_capacity(ROWS);
        let mut is_kept = |cloud: &GaussianCloud, i: usize| {
            let Some(least) = self.least.filter(|_| cloud.is_valid(i)) else { return cloud.is_valid(i) };
            let weight = weight(cloud, i);
            let tied = weight == least.weight && ties > 0;
            ties -= u64::from(tied);
            tied || weight > least.weight
        };
        (self.pieces)(&mut |cloud| {
            for start in (0..cloud.len()).step_by(ROWS) {
                rows.clear();
                let end = cloud.len().min(start + ROWS);
                rows.extend((start..end).filter(|i| is_kept(cloud, *i)).map(|i| i as u32));
                take(cloud, &rows)?;
            }
            Ok(())
        })
    }
}

/// How important a Gaussian is (opacity × area), as a number of the same order as [`f32::total_cmp`] has.
fn weight(cloud: &GaussianCloud, i: usize) -> u32 {
    let s = cloud.log_scales[i];
    let area = s.iter().sum::<f32>() - s.iter().copied().fold(f32::INFINITY, f32::min);
    let bits = (area - (1.0 + (-cloud.opacity_logits[i]).exp()).ln()).to_bits();
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::cloud;

    /// The rows of a scene that are kept, read in pieces of so many.
    fn kept(scene: &GaussianCloud, capacity: usize, piece: usize) -> (Vec<u32>, LoadReport) {
        let pieces = |take: &mut dyn FnMut(&GaussianCloud) -> Result<(), TrainError>| {
            let rows: Vec<u32> = (0..scene.len() as u32).collect();
            rows.chunks(piece).try_for_each(|rows| take(&scene.rows(rows)))
        };
        let (kept, report) = Kept::<TrainError>::new(&pieces, capacity).unwrap();
        let (mut rows, mut first) = (Vec::new(), 0);
        kept.each(&mut |cloud, of_piece| {
            rows.extend(of_piece.iter().map(|row| first + row));
            first += cloud.len() as u32;
            Ok(())
        })
        .unwrap();
        (rows, report)
    }

    #[test]
    fn the_most_important_ones_are_kept_and_of_equal_ones_the_first_however_the_scene_is_read() {
        let mut scene = cloud(3, 500, 0);
        for i in (0..500).step_by(3) {
            (scene.log_scales[i], scene.opacity_logits[i]) = ([-1.0, -2.0, -3.0], 0.5);
        }
        scene.means[7][0] = f32::NAN;
        scene.opacity_logits[11] = -200.0;
        for capacity in [1, 40, 250, 498, 499, 600] {
            let mut sorted: Vec<usize> = (0..500).filter(|i| scene.is_valid(*i)).collect();
            let importance = |i: usize| {
                let s = scene.log_scales[i];
                let area = s.iter().sum::<f32>() - s.iter().copied().fold(f32::INFINITY, f32::min);
                area - (1.0 + (-scene.opacity_logits[i]).exp()).ln()
            };
            sorted.sort_by(|a, b| importance(*b).total_cmp(&importance(*a)).then(a.cmp(b)));
            sorted.truncate(capacity);
            sorted.sort_unstable();
            for piece in [500, 64, 1] {
                let (rows, report) = kept(&scene, capacity, piece);
                assert!(rows.iter().map(|i| *i as usize).eq(sorted.iter().copied()), "{capacity} in pieces of {piece}");
                let expected = (sorted.len(), 1, 499 - sorted.len());
                assert_eq!((report.loaded, report.dropped_non_finite, report.dropped_over_capacity), expected);
            }
        }
    }
}

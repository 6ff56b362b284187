//! What a rebuilt model keeps of the one trained so far.
//!
//! New key frames bring new ground. Where the trained model already stands its Gaussians are better than fresh ones;
//! elsewhere the fresh ones fill the gap. What a trained Gaussian covers takes no fresh one, so nothing is doubled.

use std::collections::{HashMap, HashSet};

use glam::{Quat, Vec3};
use models::cloud::GaussianCloud;
use vulkan::trainer::Trained;

/// Share of the trained Gaussians given up for new ground; beyond it holes would be left where they stood.
const MOST_GIVEN_UP: f64 = 0.4;

/// Side of the coarsest cells in those of the finest, a power of two: an octree's coarsest Gaussians.
const MOST_LEVEL: u8 = 5;
/// Opacity below 1/20 hides nothing: such a Gaussian does not claim its cell.
const HIDES_NOTHING: f32 = -2.94;

type Cell = [i32; 3];

/// Where trained Gaussians stand, each in cells of its own size.
pub struct Claims {
    /// Edge of the finest, metres.
    edge_m: f32,
    cells: HashSet<(u8, Cell)>,
    /// Which sizes there are.
    levels: [bool; MOST_LEVEL as usize + 1],
}

impl Claims {
    /// None yet; a fresh Gaussian is `edge_m` wide or more.
    pub fn new(edge_m: f32) -> Self {
        Self { edge_m, cells: HashSet::new(), levels: [false; MOST_LEVEL as usize + 1] }
    }

    fn cell(&self, level: u8, mean: Vec3) -> Cell {
        let edge = self.edge_m * f32::from(1u16 << level);
        mean.to_array().map(|v| (v / edge).floor().clamp(-1e9, 1e9) as i32)
    }

    /// A trained Gaussian: what it covers is its own.
    pub fn claim(&mut self, g: &Trained) {
        if g.opacity_logit <= HIDES_NOTHING {
            return;
        }
        let mut axes = [0usize, 1, 2];
        axes.sort_by(|a, b| g.log_scale[*b].total_cmp(&g.log_scale[*a]));
        let deviation = |k: usize| g.log_scale[axes[k]].exp();
        // Cells of its deviation's size, at its middle and around it at one deviation: those of an even ground, two deviations apart, leave no
        // gap between them and reach no further than they show.
        let level = (0..MOST_LEVEL).find(|l| deviation(1) <= self.edge_m * f32::from(1u16 << l)).unwrap_or(MOST_LEVEL);
        let mean = Vec3::from_array(g.mean);
        self.levels[usize::from(level)] = true;
        self.cells.insert((level, self.cell(level, mean)));
        if 2.0 * deviation(0) <= self.edge_m {
            return;
        }
        let [w, x, y, z] = g.rotation;
        let rotation = Quat::from_xyzw(x, y, z, w);
        // A splinter claims no more than a disc four times as long as wide.
        let aside = [0, 1].map(|k| {
            let mut along = Vec3::ZERO;
            along[axes[k]] = deviation(k).min(4.0 * deviation(1));
            rotation * along
        });
        for (a, b) in [-1.0, 0.0, 1.0].into_iter().flat_map(|a| [-1.0, 0.0, 1.0].map(|b| (a, b))) {
            let at = mean + a * aside[0] + b * aside[1];
            if at.is_finite() {
                self.cells.insert((level, self.cell(level, at)));
            }
        }
    }

    /// Whether a trained Gaussian stands there.
    pub fn hold(&self, mean: [f32; 3]) -> bool {
        let mean = Vec3::from_array(mean);
        (0..=MOST_LEVEL).filter(|l| self.levels[usize::from(*l)]).any(|l| self.cells.contains(&(l, self.cell(l, mean))))
    }
}

fn trained(cloud: &GaussianCloud, i: usize) -> Trained {
    Trained {
        sensitivity: 0.0,
        mean: cloud.means[i],
        log_scale: cloud.log_scales[i],
        rotation: cloud.rotations[i],
        opacity_logit: cloud.opacity_logits[i],
    }
}

/// How many Gaussians each square of ground takes.
pub struct Room {
    /// Metres.
    side: f64,
    most: u32,
    held: HashMap<[i64; 2], u32>,
}

impl Room {
    /// At most so many in each square of `side` metres.
    pub fn new((side, most): (f64, u32)) -> Self {
        Self { side, most, held: HashMap::new() }
    }

    fn held(&mut self, mean: [f32; 3]) -> &mut u32 {
        let square = [0, 1].map(|k| (f64::from(mean[k]) / self.side).floor() as i64);
        self.held.entry(square).or_default()
    }

    /// One stands there already.
    pub fn count(&mut self, mean: [f32; 3]) {
        *self.held(mean) += 1;
    }

    /// Takes one more, where there is room for it.
    pub fn take(&mut self, mean: [f32; 3]) -> bool {
        let most = self.most;
        let held = self.held(mean);
        let taken = *held < most;
        *held += u32::from(taken);
        taken
    }
}

/// `trained` plus those of `fresh` that stand where no trained Gaussian does (see [`Claims`]; the finest cells are `edge_m` wide) and
/// where `ground` has room, at most `capacity` in all. Where that is too few for both, new ground gets what it has in `fresh`, whose Gaussians are spread evenly,
/// and the trained ones that cover least go; when more would go than [`MOST_GIVEN_UP`], everything starts anew. Returns how
/// many fresh ones there are.
pub fn carry_over(
    trained_so_far: &mut GaussianCloud,
    fresh: &GaussianCloud,
    edge_m: f32,
    capacity: usize,
    mut ground: Room,
) -> usize {
    let cloud = trained_so_far;
    if cloud.is_empty() || edge_m.is_nan() || edge_m <= 0.0 {
        cloud.clone_from(fresh);
        return cloud.len();
    }
    let mut claims = Claims::new(edge_m);
    for i in 0..cloud.len() {
        claims.claim(&trained(cloud, i));
        ground.count(cloud.means[i]);
    }
    let mut new = fresh.clone();
    new.retain(|i| !claims.hold(fresh.means[i]) && ground.take(fresh.means[i]));
    let room = capacity.saturating_sub(new.len());
    if cloud.len() > room {
        if (room as f64) < (1.0 - MOST_GIVEN_UP) * cloud.len() as f64 {
            cloud.clone_from(fresh);
            return cloud.len();
        }
        let keep = cloud.most_covering(room);
        cloud.retain(|i| keep[i]);
    }
    cloud.extend(&new);
    new.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn anywhere() -> Room {
        Room::new((1.0, u32::MAX))
    }

    fn cloud(xs: &[f32]) -> GaussianCloud {
        let mut c = GaussianCloud::with_capacity(0, xs.len());
        for x in xs {
            c.push([*x, 0.0, 0.0], [-3.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.0; 3]);
        }
        c
    }

    #[test]
    fn covered_ground_keeps_its_trained_gaussians_and_new_ground_gets_fresh_ones() {
        let mut trained = cloud(&[0.1, 1.1]);
        assert_eq!(carry_over(&mut trained, &cloud(&[0.2, 1.9, 2.5, 7.0]), 1.0, 100, anywhere()), 2);
        assert_eq!(trained, cloud(&[0.1, 1.1, 2.5, 7.0]));
    }

    #[test]
    fn new_ground_gets_its_share_of_the_cap_and_an_empty_model_takes_everything() {
        let mut trained = cloud(&[0.1, 0.2, 0.3, 0.4, 0.5]);
        trained.log_scales[1] = [-5.0; 3];
        assert_eq!(carry_over(&mut trained, &cloud(&[0.3, 7.0]), 1.0, 5, anywhere()), 1);
        assert_eq!(trained, cloud(&[0.1, 0.3, 0.4, 0.5, 7.0]), "the one that covers least made room");
        // More new ground than known: the known one would be left with holes.
        assert_eq!(carry_over(&mut trained, &cloud(&[0.3, 9.0, 10.0, 11.0]), 1.0, 5, anywhere()), 4);
        assert_eq!(trained, cloud(&[0.3, 9.0, 10.0, 11.0]));
        let mut empty = cloud(&[]);
        assert_eq!(carry_over(&mut empty, &cloud(&[5.0, 6.0]), 1.0, 3, anywhere()), 2);
    }

    #[test]
    fn transparent_gaussians_do_not_claim_their_cell() {
        let mut trained = cloud(&[0.1]);
        trained.opacity_logits[0] = -6.0;
        assert_eq!(carry_over(&mut trained, &cloud(&[0.2]), 1.0, 10, anywhere()), 1);
    }

    #[test]
    fn coarse_ground_is_known_ground_and_no_gap_is_left_at_its_rim() {
        // Discs of an even ground, 0.8 m apart as an octree lays them; fresh ones every 0.1 m.
        let mut coarse = GaussianCloud::with_capacity(0, 64);
        for i in 0..64 {
            let mean = [0.8 * (i % 8) as f32 + 0.4, 0.8 * (i / 8) as f32 + 0.4, 0.0];
            coarse.push(mean, [0.4f32.ln(), 0.4f32.ln(), 0.01f32.ln()], [1.0, 0.0, 0.0, 0.0], 2.0, &[0.0; 3]);
        }
        let mut fine = GaussianCloud::with_capacity(0, 10_000);
        for i in 0..10_000 {
            let mean = [0.1 * (i % 100) as f32 + 0.05, 0.1 * (i / 100) as f32 + 0.05, 0.0];
            fine.push(mean, [-3.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.0; 3]);
        }
        let mut all = coarse.clone();
        let new = carry_over(&mut all, &fine, 0.2, 20_000, anywhere());
        let within = |m: &[f32; 3], side: f32| m[0] < side && m[1] < side;
        let fresh = &all.means[64..];
        assert!(fresh.iter().all(|m| !within(m, 6.2)), "what stands there is kept: {new}");
        let beyond = fine.means.iter().filter(|m| !within(m, 7.2)).count();
        assert_eq!(fresh.iter().filter(|m| !within(m, 7.2)).count(), beyond, "and nothing is left open beside it");
    }

    #[test]
    fn ground_that_has_its_share_takes_no_more() {
        let mut trained = cloud(&[0.1, 0.3, 5.1]);
        // Squares of a metre for two: the first is full, the second has one.
        let fresh = cloud(&[0.9, 5.5, 5.9, 8.0]);
        assert_eq!(carry_over(&mut trained, &fresh, 0.1, 100, Room::new((1.0, 2))), 2);
        assert_eq!(trained, cloud(&[0.1, 0.3, 5.1, 5.5, 8.0]));
    }
}

//! Promises of the merge, on clouds small enough to count.

use super::*;
use crate::testing::{carpet, model, united};

const WEST: [[f64; 2]; 4] = [[-50.0, -50.0], [0.0, -50.0], [0.0, 50.0], [-50.0, 50.0]];
const EAST: [[f64; 2]; 4] = [[0.0, -50.0], [50.0, -50.0], [50.0, 50.0], [0.0, 50.0]];

#[test]
fn two_overlapping_carpets_become_one_of_the_same_density() {
    // Both saw everything; each keeps its half and the ground beyond it.
    let all = carpet([-80.0, -80.0], [80.0, 80.0], 1.0);
    let models = [model("west", &WEST, all.clone()), model("east", &EAST, all.clone())];
    let merged = united(&models, usize::MAX);
    assert_eq!(merged.cloud.len(), all.len());
    assert_eq!(merged.source.len(), all.len());
    let wrong = merged.cloud.means.iter().zip(&merged.source).filter(|(m, s)| (m[0] > 0.0) != (**s == 1));
    assert_eq!(wrong.count(), 0);
    assert_eq!(merged.kept[0].own + merged.kept[0].foreign, all.len());
    assert_eq!(merged.kept[0].fill + merged.kept[1].fill, 0);
}

#[test]
fn a_place_the_owner_missed_is_filled_by_the_neighbour_who_saw_it() {
    let east_all = carpet([-80.0, -80.0], [80.0, 80.0], 1.0);
    let mut west = carpet([-80.0, -80.0], [10.0, 80.0], 1.0);
    // The western aircraft missed a yard of 20 m inside its own region.
    let means = west.means.clone();
    west.retain(|i| !((-40.0..-20.0).contains(&means[i][0]) && (-10.0..10.0).contains(&means[i][1])));
    let models = [model("west", &WEST, west), model("east", &EAST, east_all.clone())];
    let merged = united(&models, usize::MAX);
    let in_yard = merged.cloud.means.iter().filter(|m| (-36.0..-24.0).contains(&m[0]) && (-6.0..6.0).contains(&m[1]));
    assert_eq!(in_yard.count(), 12 * 12);
    assert!(merged.kept[1].fill >= 12 * 12 && merged.kept[1].fill <= 20 * 20);
    assert!(merged.cloud.len() <= east_all.len());
}

#[test]
fn a_missing_aircraft_leaves_its_ground_to_those_who_saw_it() {
    let models = [model("west", &WEST, carpet([-80.0, -80.0], [80.0, 80.0], 1.0))];
    let merged = united(&models, usize::MAX);
    assert_eq!(merged.cloud.len(), 160 * 160);
}

#[test]
fn the_budget_drops_what_covers_least_and_says_so() {
    let mut cloud = carpet([-40.0, -40.0], [-20.0, -20.0], 1.0);
    for i in 0..100 {
        cloud.log_scales[i] = [-9.0; 3];
    }
    let models = [model("west", &WEST, cloud)];
    let merged = united(&models, 300);
    assert_eq!((merged.cloud.len(), merged.source.len(), merged.kept[0].over_budget), (300, 300, 100));
    assert!(merged.cloud.log_scales.iter().all(|s| s[0] > -9.0));
}

#[test]
fn empty_and_single_point_models_merge() {
    let empty = GaussianCloud::with_capacity(0, 0);
    let models = [model("a", &WEST, empty.clone()), model("b", &[], empty)];
    assert_eq!(united(&models, 10).cloud.len(), 0);
    let one = carpet([0.0, 0.0], [1.0, 1.0], 1.0);
    assert_eq!(one.len(), 1);
    let models = [model("a", &[], one)];
    assert_eq!(united(&models, 10).cloud.len(), 1);
}

#[test]
fn lower_sh_degrees_are_padded() {
    let mut high = carpet([10.0, 0.0], [20.0, 10.0], 1.0);
    high.raise_sh_degree(2);
    let models = [model("west", &WEST, carpet([-20.0, 0.0], [-10.0, 10.0], 1.0)), model("east", &EAST, high)];
    let merged = united(&models, usize::MAX);
    assert_eq!(merged.cloud.sh_degree, 2);
    assert_eq!(merged.cloud.sh.len(), 200 * merged.cloud.sh_stride());
}

//! Whose ground overlaps: the only pairs of models that are ever looked at together.

use crate::member::Bounds;

/// Share of the smaller ground that both must show.
const LEAST_SHARE: f64 = 0.05;
/// Neighbours that a model chooses, those with most ground in common: models of the same place, however many, cost so many
/// fits each and no more.
const MOST: usize = 8;

/// Pairs (lower index first, in order) of which at least one chooses the other. The choice depends on the set, not on its
/// order: a model that joins brings edges of its own and never a new one between others.
pub fn neighbours(grounds: &[Bounds]) -> Vec<(usize, usize)> {
    let mut by_west: Vec<usize> = (0..grounds.len()).filter(|&i| area(&grounds[i]) > 0.0).collect();
    by_west.sort_by(|&a, &b| grounds[a].low.x.total_cmp(&grounds[b].low.x));
    let mut shared: Vec<Vec<(f64, usize)>> = vec![Vec::new(); grounds.len()];
    for (k, &a) in by_west.iter().enumerate() {
        for &b in by_west[k + 1..].iter().take_while(|&&b| grounds[b].low.x < grounds[a].high.x) {
            let m2 = grounds[a].shared_m2(&grounds[b]);
            if m2 >= LEAST_SHARE * area(&grounds[a]).min(area(&grounds[b])) {
                shared[a].push((m2, b));
                shared[b].push((m2, a));
            }
        }
    }
    let mut pairs = Vec::new();
    for (a, mut others) in shared.into_iter().enumerate() {
        others.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
        pairs.extend(others.iter().take(MOST).map(|&(_, b)| (a.min(b), a.max(b))));
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

fn area(ground: &Bounds) -> f64 {
    let span = ground.span();
    span.x * span.y
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    fn square(x: f64, y: f64, side: f64) -> Bounds {
        Bounds { low: DVec2::new(x, y), high: DVec2::new(x + side, y + side) }
    }

    #[test]
    fn a_field_of_aircraft_has_edges_between_neighbours_only() {
        // 20 × 20 squares of 120 m, 100 m apart.
        let grounds: Vec<Bounds> =
            (0..400).map(|i| square(f64::from(i % 20) * 100.0, f64::from(i / 20) * 100.0, 120.0)).collect();
        let pairs = neighbours(&grounds);
        // Beside and above each other; the corners share too little.
        assert_eq!(pairs.len(), 2 * 20 * 19);
        assert!(pairs.iter().all(|&(a, b)| b - a == 1 || b - a == 20));
    }

    #[test]
    fn many_models_of_one_place_choose_a_bounded_number_of_neighbours() {
        let grounds: Vec<Bounds> = (0..500).map(|i| square(f64::from(i) * 0.01, 0.0, 100.0)).collect();
        assert!(neighbours(&grounds).len() <= 500 * MOST);
    }

    #[test]
    fn who_joins_brings_no_edge_between_others() {
        let grounds: Vec<Bounds> =
            (0..60).map(|i| square(f64::from(i * 37 % 60) * 9.0, f64::from(i * 23 % 60) * 5.0, 100.0)).collect();
        let before = neighbours(&grounds[..59]);
        assert!(neighbours(&grounds).iter().all(|pair| pair.1 == 59 || before.contains(pair)));
    }

    #[test]
    fn models_that_show_nothing_have_no_neighbours() {
        assert!(neighbours(&[Bounds::EMPTY, square(0.0, 0.0, 10.0), Bounds::EMPTY]).is_empty());
    }
}

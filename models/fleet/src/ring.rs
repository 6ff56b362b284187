//! Ground as one polygon, as a mission holds a region: holes and further parts hang on slits without a width.

use glam::DVec2;

use crate::ground::{Ground, Ring};

/// A corner this near to the line between its neighbours is none, metres: a mission's regions are written in millimetres.
const STRAIGHT_M: f64 = 1e-3;

/// All of `ground` as one ring: inside of it by the even-odd rule lies what lies in the ground.
pub fn ring(ground: &Ground) -> Ring {
    let mut rings = ground.rings().map(bent).filter(|r| r.len() >= 3);
    let mut whole = rings.next().unwrap_or_default();
    let mut open: Vec<Ring> = rings.collect();
    while !open.is_empty() {
        let Some((at, k, from)) = nearest(&whole, &open) else { break };
        let ring = open.swap_remove(at);
        // There along the slit, around, and back.
        let around = (0..=ring.len()).map(|n| ring[(from + n) % ring.len()]).chain([whole[k]]);
        whole.splice(k + 1..k + 1, around.collect::<Vec<DVec2>>());
    }
    whole
}

/// The corners at which a ring changes its direction.
fn bent(ring: &Ring) -> Ring {
    let mut kept: Ring = Vec::with_capacity(ring.len());
    for (k, p) in ring.iter().enumerate() {
        let before = kept.last().unwrap_or(&ring[ring.len() - 1]);
        // The last corner's neighbour is the first that was kept: of two corners in one place one must stay.
        let after = *ring.get(k + 1).or(kept.first()).unwrap_or(p);
        let way = after - *before;
        let off = (*p - *before).perp_dot(way).abs() / way.length().max(1e-9);
        if off > STRAIGHT_M || (*p - *before).dot(after - *p) < 0.0 {
            kept.push(*p);
        }
    }
    kept
}

/// The ring, the corner of the whole and the ring's corner that are nearest to each other.
fn nearest(whole: &Ring, open: &[Ring]) -> Option<(usize, usize, usize)> {
    let pairs = open.iter().enumerate().flat_map(|(at, ring)| {
        ring.iter().enumerate().flat_map(move |(from, p)| {
            whole.iter().enumerate().map(move |(k, q)| (p.distance_squared(*q), at, k, from))
        })
    });
    pairs.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, at, k, from)| (at, k, from))
}

#[cfg(test)]
mod tests {
    use geometry::polygon;

    use super::*;
    use crate::ground::tests::rectangle;

    #[test]
    fn one_ring_holds_what_two_parts_with_holes_hold() {
        let ground = Ground::of(vec![
            rectangle(0.0, 0.0, 100.0, 100.0),
            rectangle(20.0, 20.0, 10.0, 10.0),
            rectangle(60.0, 60.0, 10.0, 10.0),
            rectangle(150.0, 0.0, 50.0, 50.0),
        ]);
        assert_eq!(ground.rings().count(), 4);
        let whole = ring(&ground);
        assert!((polygon::signed_area(&whole) - ground.area_m2()).abs() < 1e-6);
        for k in 0..1000 {
            let p = DVec2::new(f64::from(k % 37) * 6.1 - 5.0, f64::from(k / 37) * 4.3 - 3.0);
            assert_eq!(polygon::contains(&whole, p), ground.contains(p), "{p}");
        }
        assert!(ring(&Ground::default()).is_empty());
        let mut square = rectangle(0.0, 0.0, 100.0, 100.0);
        square.insert(1, DVec2::new(50.0, 0.0004));
        assert_eq!(bent(&square), rectangle(0.0, 0.0, 100.0, 100.0));
        // The first corner once more at the end.
        square.push(DVec2::new(0.0, 0.0002));
        assert!((polygon::signed_area(&bent(&square)) - 1e4).abs() < 0.1 && bent(&square).len() == 4);
    }
}

//! Promises of the pose graph, on fields of models whose true places are known.

use super::*;

/// As of a model whose origin is known.
const BY_GPS: f64 = 0.005;

/// Models in a square field, each off by its own error, and links between neighbours that see the truth.
struct Field {
    side: usize,
    nodes: Vec<Node>,
    /// What is wrong with each.
    errors: Vec<Similarity>,
    links: Vec<Link>,
}

fn wobble(i: usize, k: usize) -> f64 {
    (((i * 7 + k) as f64 * 12.9898).sin() * 43_758.545_3).fract()
}

impl Field {
    /// Scales are wrong by up to 0.6 times what they are known to.
    fn new(side: usize, scale_sigma: f64) -> Self {
        let middle = |i: usize| DVec3::new((i % side) as f64 * 100.0, (i / side) as f64 * 100.0, 0.0);
        let nodes: Vec<Node> =
            (0..side * side).map(|i| Node { middle: middle(i), scale_sigma, reach_m: 70.0, earlier: None }).collect();
        let errors = (0..side * side).map(|i| {
            let scale = 1.0 + 0.6 * scale_sigma * wobble(i, 6);
            let rotation = DQuat::from_rotation_z(0.05 * wobble(i, 3)) * DQuat::from_rotation_x(0.01 * wobble(i, 4));
            let shift = DVec3::new(wobble(i, 0), wobble(i, 1), wobble(i, 2)) * 3.0;
            Similarity { scale, rotation, translation: middle(i) + shift - scale * (rotation * middle(i)) }
        });
        let mut field = Self { side, errors: errors.collect(), nodes, links: Vec::new() };
        for i in 0..side * side {
            for j in [i + 1, i + side] {
                if j < side * side && (j != i + 1 || j % side != 0) {
                    field.link(i, j, DVec3::ZERO);
                }
            }
        }
        field
    }

    /// Six places half-way between two models; the second one's are `off`.
    fn link(&mut self, a: usize, b: usize, off: DVec3) {
        let half_way = 0.5 * (self.nodes[a].middle + self.nodes[b].middle);
        let places = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y, DVec3::Z, -DVec3::Z].map(|d| {
            let truth = half_way + d * DVec3::new(30.0, 25.0, 4.0);
            (self.errors[a].apply(truth), self.errors[b].apply(truth + off))
        });
        self.links.push(Link { a, b, places, sigma_m: 0.05, limit_m: 0.5 });
    }

    /// The greatest distance of neighbours' places after settling, metres.
    fn worst_gap(&self, settled: &Settled, honest: usize) -> f64 {
        let apart = |l: &Link| {
            let c = &settled.corrections;
            l.places.iter().map(|(a, b)| c[l.a].apply(*a).distance(c[l.b].apply(*b))).fold(0.0, f64::max)
        };
        self.links[..honest].iter().map(apart).fold(0.0, f64::max)
    }
}

#[test]
fn loops_close_to_millimetres_and_telemetry_holds_the_whole() {
    let field = Field::new(6, BY_GPS);
    let settled = settle(&field.nodes, &field.links);
    assert!(settled.holds.iter().all(|h| *h));
    let gap = field.worst_gap(&settled, field.links.len());
    assert!(gap < 0.03, "{gap} m");
    // What all have in common only telemetry says: the mean of 36 errors, not one model's.
    let moved = |i: usize| settled.corrections[i].apply(field.errors[i].apply(field.nodes[i].middle));
    let off: DVec3 = (0..36).map(|i| moved(i) - field.nodes[i].middle).sum::<DVec3>() / 36.0;
    assert!(off.length() < 1.2, "{off}");
}

#[test]
fn one_false_edge_is_set_aside_and_bends_nothing() {
    let mut field = Field::new(6, BY_GPS);
    let honest = field.links.len();
    let without = settle(&field.nodes, &field.links);
    for (a, b) in [(14, 15), (0, field.side), (7, 21)] {
        field.links.truncate(honest);
        field.link(a, b, DVec3::new(7.0, -5.0, 1.0));
        let settled = settle(&field.nodes, &field.links);
        assert_eq!(settled.holds.iter().position(|h| !h), Some(honest), "{a}–{b}");
        assert!(settled.holds[..honest].iter().all(|h| *h));
        for (i, node) in field.nodes.iter().enumerate() {
            let at = |s: &Settled| s.corrections[i].apply(node.middle);
            assert!(at(&settled).distance(at(&without)) < 0.02, "{a}–{b} moved {i}");
        }
    }
}

#[test]
fn a_model_without_neighbours_stays_where_its_telemetry_puts_it() {
    let mut field = Field::new(3, BY_GPS);
    field.links.retain(|l| l.a != 8 && l.b != 8);
    let settled = settle(&field.nodes, &field.links);
    assert!(settled.corrections[8].apply(field.nodes[8].middle).distance(field.nodes[8].middle) < 1e-9);
    assert!(settle(&[], &[]).corrections.is_empty());
}

/// GPS leaves the size of a small flight uncertain by parts of a thousand: rigid motions alone left neighbours apart by half a
/// pixel at the ends of their border.
#[test]
fn scales_are_brought_together_whether_gps_measured_them_or_nobody_did() {
    for (scale_sigma, most) in [(BY_GPS, 1e-3), (0.05, 4e-3)] {
        let field = Field::new(4, scale_sigma);
        let settled = settle(&field.nodes, &field.links);
        assert!(field.worst_gap(&settled, field.links.len()) < 0.05);
        let scales: Vec<f64> = field.errors.iter().zip(&settled.corrections).map(|(e, c)| e.scale * c.scale).collect();
        let spread =
            |of: &[f64]| of.iter().fold(f64::MIN, |h, s| h.max(*s)) - of.iter().fold(f64::MAX, |l, s| l.min(*s));
        let wrong: Vec<f64> = field.errors.iter().map(|e| e.scale).collect();
        assert!(spread(&wrong) > 4.0 * most && spread(&scales) < most, "{wrong:?} {scales:?}");
    }
}

#[test]
fn a_scale_without_neighbours_stays_what_gps_says() {
    let field = Field::new(3, BY_GPS);
    let alone = settle(&field.nodes, &[]);
    assert!(alone.corrections.iter().all(|c| c.scale == 1.0));
    // Of all together only telemetry says how large they are.
    let settled = settle(&field.nodes, &field.links);
    let mean = |of: &dyn Fn(usize) -> f64| (0..9).map(of).sum::<f64>() / 9.0;
    let (wrong, left) =
        (mean(&|i| field.errors[i].scale), mean(&|i| field.errors[i].scale * settled.corrections[i].scale));
    assert!((left - wrong).abs() < 5e-4, "{wrong} {left}");
}

#[test]
fn of_a_thousand_aircraft_one_false_edge_is_found_and_neighbours_meet() {
    // Where nothing is optimised a tenth of them take as long.
    let mut field = Field::new(if cfg!(debug_assertions) { 10 } else { 32 }, BY_GPS);
    let honest = field.links.len();
    field.link(50, 51, DVec3::new(7.0, -5.0, 1.0));
    let settled = settle(&field.nodes, &field.links);
    assert_eq!(settled.holds.iter().position(|h| !h), Some(honest));
    assert!(settled.holds[..honest].iter().all(|h| *h));
    let gap = field.worst_gap(&settled, honest);
    assert!(gap < 0.05, "{gap} m");
}

#[test]
fn an_edge_beyond_all_telemetry_is_set_aside_at_once_and_moves_nothing() {
    let mut field = Field::new(2, BY_GPS);
    let honest = field.links.len();
    let without = settle(&field.nodes, &field.links);
    for off in [1e5, 1e200, f64::NAN] {
        field.links.truncate(honest);
        field.link(0, 3, DVec3::splat(off));
        let settled = settle(&field.nodes, &field.links);
        assert_eq!(settled.holds, [vec![true; honest], vec![false]].concat());
        for (i, node) in field.nodes.iter().enumerate() {
            let at = |s: &Settled| s.corrections[i].apply(node.middle);
            assert!(at(&settled).distance(at(&without)) < 1e-6, "{off}");
        }
    }
}

/// Models that lie more than two centimetres from where they were, anywhere on their ground.
fn moved(field: &Field, settled: &Settled) -> usize {
    let corners = [DVec3::new(50.0, 50.0, 0.0), DVec3::new(-50.0, 50.0, 0.0)];
    let is_moved = |(node, now): (&Node, &Similarity)| {
        let at = |p: DVec3| node.earlier.is_some_and(|e| e.apply(p).distance(now.apply(p)) > STAYS_M);
        corners.iter().any(|c| at(node.middle + *c) || at(node.middle - *c))
    };
    field.nodes.iter().zip(&settled.corrections).filter(|pair| is_moved(*pair)).count()
}

#[test]
fn who_joins_takes_the_place_that_its_neighbours_leave_it() {
    for joins in [0, 14, 35] {
        let mut field = Field::new(6, BY_GPS);
        let before: Vec<Link> = field.links.iter().filter(|l| l.a != joins && l.b != joins).copied().collect();
        let earlier = settle(&field.nodes, &before);
        let free = settle(&field.nodes, &field.links);
        for (i, node) in field.nodes.iter_mut().enumerate().filter(|(i, _)| *i != joins) {
            node.earlier = Some(earlier.corrections[i]);
        }
        let settled = settle(&field.nodes, &field.links);
        let gaps = [&free, &settled].map(|s| field.worst_gap(s, field.links.len()));
        assert!(gaps[1] < gaps[0] + 2.0 * STAYS_M, "{joins}: {gaps:?} m");
        let moved = [&free, &settled].map(|s| moved(&field, s));
        assert!(moved[0] >= 20 && moved[1] <= 4, "{joins}: {moved:?} models moved");
    }
}

#[test]
fn what_was_settled_wrongly_is_let_go() {
    let mut field = Field::new(5, BY_GPS);
    let free = settle(&field.nodes, &field.links);
    for (i, node) in field.nodes.iter_mut().enumerate() {
        // One half was never registered, the other half is where it belongs.
        node.earlier = Some(if i < 12 { Similarity::IDENTITY } else { free.corrections[i] });
    }
    let settled = settle(&field.nodes, &field.links);
    assert!(settled.holds.iter().all(|h| *h));
    let gaps = [&free, &settled].map(|s| field.worst_gap(s, field.links.len()));
    assert!(gaps[1] < gaps[0] + 2.0 * STAYS_M, "{gaps:?} m");
}

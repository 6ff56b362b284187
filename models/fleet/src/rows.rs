//! Strips of ground side by side, each as wide as survey lines lie apart.

use glam::DVec2;

use crate::ground::{Ground, Ring};

/// More strips than this are wider ones, and are not planned.
pub const MOST_ROWS: f64 = 4000.0;
/// Gaps of a strip shorter than this are flown through, in widths of the strip: turning around takes longer.
const GAP: f64 = 1.0;

/// Where the strips of an area lie: along `along`, the first at `low` across.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Unit vector along the strips.
    pub along: DVec2,
    /// Lower edge of the first strip.
    pub low: f64,
    /// Width of a strip, metres.
    pub width: f64,
    /// How many there are.
    pub count: usize,
}

impl Lattice {
    /// Strips of equal width over all of `ground`, no wider than `widest`.
    pub fn over(ground: &Ground, along: DVec2, widest: f64) -> Self {
        let across = along.perp();
        let reach = ground.rings().flatten().map(|p| p.dot(across));
        let (low, high) = reach.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let count = ((high - low) / widest - 1e-6).ceil().clamp(1.0, MOST_ROWS);
        Self { along, low, width: (high - low) / count, count: count as usize }
    }

    /// A place along and across, in metres east and north.
    pub fn place(&self, along: f64, across: f64) -> DVec2 {
        self.along * along + self.along.perp() * across
    }

    /// Middle of a strip across.
    pub fn middle(&self, row: usize) -> f64 {
        self.low + (row as f64 + 0.5) * self.width
    }

    /// The corners of a stretch of a strip, a part of its neighbours' edges.
    pub fn corners(&self, row: usize, [from, to]: [f64; 2]) -> Ring {
        let [low, high] = [row, row + 1].map(|k| self.low + k as f64 * self.width);
        let corners = [[from, low], [to, low], [to, high], [from, high]];
        corners.map(|[x, y]| self.place(x, y)).to_vec()
    }
}

/// The stretches of each strip that hold ground, from lower to higher.
pub type Rows = Vec<Vec<[f64; 2]>>;

/// What of each strip `ground` takes up. Stretches nearer to each other than a strip is wide are one.
pub fn rows(ground: &Ground, lattice: &Lattice) -> Rows {
    let across = lattice.along.perp();
    let turned = |p: &DVec2| DVec2::new(p.dot(lattice.along), p.dot(across));
    let rings: Vec<Vec<DVec2>> = ground.rings().map(|ring| ring.iter().map(turned).collect()).collect();
    let mut edges: Vec<[DVec2; 2]> = Vec::new();
    for ring in &rings {
        for (a, b) in ring.iter().zip(ring.iter().cycle().skip(1)) {
            if a.y != b.y {
                edges.push(if a.y < b.y { [*a, *b] } else { [*b, *a] });
            }
        }
    }
    // Between two neighbouring levels no side begins or ends: trapezoids.
    let mut levels: Vec<f64> = rings.iter().flatten().map(|p| p.y).collect();
    levels.extend((0..=lattice.count).map(|k| lattice.low + k as f64 * lattice.width));
    levels.sort_by(f64::total_cmp);
    levels.dedup_by(|a, b| *a - *b < 1e-9);
    let mut found: Rows = vec![Vec::new(); lattice.count];
    let mut crossed: Vec<(f64, f64, f64)> = Vec::new();
    for pair in levels.windows(2) {
        let [low, high] = [pair[0], pair[1]];
        let middle = 0.5 * (low + high);
        let row = ((middle - lattice.low) / lattice.width).max(0.0) as usize;
        let Some(row) = found.get_mut(row) else { continue };
        crossed.clear();
        for [a, b] in edges.iter().filter(|[a, b]| a.y < middle && b.y > middle) {
            let at = |y: f64| a.x + (b.x - a.x) * ((y - a.y) / (b.y - a.y)).clamp(0.0, 1.0);
            crossed.push((at(middle), at(low), at(high)));
        }
        crossed.sort_by(|a, b| a.0.total_cmp(&b.0));
        for sides in crossed.chunks_exact(2) {
            let [(_, a, b), (_, c, d)] = [sides[0], sides[1]];
            row.push([a.min(b), c.max(d)]);
        }
    }
    found.into_iter().map(|row| merged(row, GAP * lattice.width)).collect()
}

fn merged(mut stretches: Vec<[f64; 2]>, gap: f64) -> Vec<[f64; 2]> {
    stretches.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let mut row: Vec<[f64; 2]> = Vec::new();
    for [from, to] in stretches {
        match row.last_mut() {
            Some(last) if from <= last[1] + gap => last[1] = last[1].max(to),
            _ => row.push([from, to]),
        }
    }
    row
}

/// The ground that these stretches hold: parts of `all` of its strips. Where a stretch ends because the ground does, it is taken a little
/// further, so that its end adds no corners to the ground's side.
pub fn held(ground: &Ground, lattice: &Lattice, all: &Rows, rows: &Rows) -> Ground {
    let stretches = rows.iter().zip(all).enumerate().flat_map(|(k, (row, whole))| {
        row.iter().map(move |[from, to]| {
            // Stretches of one strip are more than GAP widths apart.
            let beyond = 0.4 * GAP * lattice.width;
            let begins = whole.iter().any(|s| s[0] == *from);
            let ends = whole.iter().any(|s| s[1] == *to);
            let stretch = [if begins { from - beyond } else { *from }, if ends { to + beyond } else { *to }];
            lattice.corners(k, stretch)
        })
    });
    ground.common(&Ground::of(stretches.collect()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::tests::rectangle;

    #[test]
    fn strips_hold_all_of_the_ground_and_gaps_that_are_worth_a_turn() {
        let ground =
            Ground::new(rectangle(0.0, 0.0, 100.0, 40.0), &[rectangle(30.0, 12.0, 40.0, 16.0)]).expect("ground");
        let lattice = Lattice::over(&ground, DVec2::X, 10.0);
        assert_eq!((lattice.count, lattice.width, lattice.middle(1)), (4, 10.0, 15.0));
        let all = rows(&ground, &lattice);
        assert_eq!(all[0], [[0.0, 100.0]]);
        // The strip from 10 to 20 is whole below 12: nothing of it may be missing.
        assert_eq!(all[1], [[0.0, 100.0]]);
        let narrow = Lattice::over(&ground, DVec2::X, 4.0);
        let all = rows(&ground, &narrow);
        assert_eq!(all[3], [[0.0, 30.0], [70.0, 100.0]]);
        assert!((held(&ground, &narrow, &all, &all).area_m2() - ground.area_m2()).abs() < 1e-3);
        assert_eq!(held(&ground, &narrow, &all, &all).rings().map(Vec::len).collect::<Vec<_>>(), [4, 4]);
        // Along the other side of a slanted triangle, stretches reach as far as the ground does anywhere in the strip.
        let triangle =
            Ground::new([[0.0, 0.0], [100.0, 0.0], [0.0, 40.0]].map(DVec2::from).to_vec(), &[]).expect("ground");
        assert_eq!(rows(&triangle, &Lattice::over(&triangle, DVec2::X, 20.0)), [[[0.0, 100.0]], [[0.0, 50.0]]]);
    }
}

//! Survey lines along the strips of a region, in flying order.

use glam::DVec2;

use crate::pace::Pace;
use crate::rows::{Lattice, Rows};

/// Regions of this few parts are begun at each of their corners, and the quickest flight is taken; others at the nearest.
const FEW_PARTS: usize = 4;

/// A straight line with pictures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// Where it begins.
    pub from: DVec2,
    /// Where it ends.
    pub to: DVec2,
}

impl Line {
    /// Metres.
    pub fn length(&self) -> f64 {
        self.from.distance(self.to)
    }

    fn reversed(self) -> Self {
        Self { from: self.to, to: self.from }
    }
}

/// Lines side by side that are flown to and fro.
type Part = Vec<Line>;

/// Corner of a part: whether the last line comes first, and whether lines are begun at their ends.
type Entry = (bool, bool);
const ENTRIES: [Entry; 4] = [(false, false), (false, true), (true, false), (true, true)];

/// The lines over these strips, each longer than the ground by `beyond` metres at both ends, in the quickest order found from `home`
/// and back.
pub fn lines(rows: &Rows, lattice: &Lattice, beyond: f64, home: DVec2, pace: &Pace) -> Vec<Line> {
    let parts = parts(rows, lattice, beyond);
    let starts: Vec<(usize, Entry)> = match parts.len() {
        0 => return Vec::new(),
        1..=FEW_PARTS => (0..parts.len()).flat_map(|k| ENTRIES.map(|entry| (k, entry))).collect(),
        _ => nearest(&parts, &vec![false; parts.len()], home).into_iter().collect(),
    };
    let flown = starts.into_iter().map(|start| in_order(&parts, start));
    let seconds = |lines: &Vec<Line>| path_s(lines, home, pace);
    flown.min_by(|a, b| seconds(a).total_cmp(&seconds(b))).unwrap_or_default()
}

/// Seconds from `home` along all lines and back.
pub fn path_s(lines: &[Line], home: DVec2, pace: &Pace) -> f64 {
    let corners: Vec<DVec2> =
        std::iter::once(home).chain(lines.iter().flat_map(|l| [l.from, l.to])).chain([home]).collect();
    pace.path_s(&corners)
}

/// Stretches of neighbouring strips that follow each other without a branch (boustrophedon decomposition: Choset 2000).
fn parts(rows: &Rows, lattice: &Lattice, beyond: f64) -> Vec<Part> {
    let touches = |a: &[f64; 2], b: &[f64; 2]| a[0] < b[1] && b[0] < a[1];
    let line = |row: usize, s: &[f64; 2]| {
        let place = |x: f64| lattice.place(x, lattice.middle(row));
        Line { from: place(s[0] - beyond), to: place(s[1] + beyond) }
    };
    let (mut parts, mut before): (Vec<Part>, Vec<usize>) = (Vec::new(), Vec::new());
    for (k, row) in rows.iter().enumerate() {
        let below = match k {
            0 => &[][..],
            k => &rows[k - 1],
        };
        let mut now = Vec::with_capacity(row.len());
        for stretch in row {
            let mut under = below.iter().enumerate().filter(|(_, b)| touches(b, stretch));
            let alone = match (under.next(), under.next()) {
                (Some((i, b)), None) => (row.iter().filter(|s| touches(b, s)).count() == 1).then(|| before[i]),
                _ => None,
            };
            let part = alone.unwrap_or_else(|| {
                parts.push(Vec::new());
                parts.len() - 1
            });
            parts[part].push(line(k, stretch));
            now.push(part);
        }
        before = now;
    }
    parts
}

fn entered(part: &Part, (last_first, from_end): Entry) -> impl Iterator<Item = Line> {
    let lines = (0..part.len()).map(move |k| part[if last_first { part.len() - 1 - k } else { k }]);
    lines.enumerate().map(move |(k, line)| if (k % 2 == 1) ^ from_end { line.reversed() } else { line })
}

fn in_order(parts: &[Part], start: (usize, Entry)) -> Vec<Line> {
    let mut flown = vec![false; parts.len()];
    let mut lines: Vec<Line> = Vec::new();
    let mut next = Some(start);
    while let Some((k, entry)) = next {
        flown[k] = true;
        lines.extend(entered(&parts[k], entry));
        next = lines.last().and_then(|last| nearest(parts, &flown, last.to));
    }
    lines
}

fn nearest(parts: &[Part], flown: &[bool], here: DVec2) -> Option<(usize, Entry)> {
    let open = (0..parts.len()).filter(|k| !flown[*k]);
    let entries = open.flat_map(|k| ENTRIES.map(|entry| (k, entry)));
    let far =
        |(k, entry): &(usize, Entry)| entered(&parts[*k], *entry).next().map_or(f64::MAX, |l| l.from.distance(here));
    entries.min_by(|a, b| far(a).total_cmp(&far(b)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::Ground;
    use crate::ground::tests::rectangle;
    use crate::rows::rows;

    #[test]
    fn lines_are_flown_to_and_fro_around_a_hole_and_none_is_left() {
        let ground =
            Ground::new(rectangle(0.0, 0.0, 100.0, 80.0), &[rectangle(30.0, 20.0, 40.0, 40.0)]).expect("ground");
        let lattice = Lattice::over(&ground, DVec2::X, 10.0);
        let pace = Pace::new(8.0, 0.0, 15.0).expect("a pace");
        let flown = lines(&rows(&ground, &lattice), &lattice, 5.0, DVec2::new(-20.0, 0.0), &pace);
        // Two strips below, two above, four on each side.
        assert_eq!(flown.len(), 12);
        assert!((flown.iter().map(Line::length).sum::<f64>() - (4.0 * 110.0 + 8.0 * 40.0)).abs() < 1e-6);
        let ways: f64 = flown.windows(2).map(|w| w[0].to.distance(w[1].from)).sum();
        assert!(ways < 320.0, "{ways}");
        assert!(flown[0].from.distance(DVec2::new(-5.0, 5.0)) < 1e-6, "begins near home: {:?}", flown[0]);
        assert!(lines(&Vec::new(), &lattice, 5.0, DVec2::ZERO, &pace).is_empty());
    }
}

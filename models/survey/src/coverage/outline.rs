//! From squares of a grid to the polygons around them.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec2;

use super::Grid;

/// A polygon with holes; rings are not closed (the first corner is not repeated).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Polygon {
    /// Counter-clockwise.
    pub(super) outside: Vec<DVec2>,
    /// Clockwise.
    pub(super) holes: Vec<Vec<DVec2>>,
}

/// Corner of squares: column and row of the square to its north-east.
type Corner = (usize, usize);

/// East, north, west, south: steps of the walk, each a left turn from the one before.
const STEPS: [(isize, isize); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];

/// One polygon for every part of `squares` that hangs together by edges.
pub(super) fn polygons(squares: &[u32], grid: &Grid) -> Vec<Polygon> {
    let mut left: BTreeSet<(usize, usize)> = squares.iter().map(|&i| grid.place(i as usize)).collect();
    let mut found = Vec::new();
    while let Some(first) = left.pop_first() {
        let (mut part, mut open) = (BTreeSet::from([first]), vec![first]);
        while let Some(at) = open.pop() {
            for next in STEPS.iter().filter_map(|step| moved(at, *step)).filter(|next| left.remove(next)) {
                part.insert(next);
                open.push(next);
            }
        }
        found.extend(around(&part, grid));
    }
    found
}

fn moved((x, y): Corner, (dx, dy): (isize, isize)) -> Option<Corner> {
    Some((x.checked_add_signed(dx)?, y.checked_add_signed(dy)?))
}

/// The polygon around squares that hang together: walks along their outer edges with the squares on the left.
fn around(part: &BTreeSet<(usize, usize)>, grid: &Grid) -> Option<Polygon> {
    let mut edges: BTreeMap<Corner, [bool; 4]> = BTreeMap::new();
    for &(x, y) in part {
        let lower = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)];
        // The edge in direction k has its own square on the left and the neighbour to the right of k on the other side.
        for (k, from) in lower.into_iter().enumerate() {
            let beyond = moved((x, y), STEPS[(k + 3) % 4]);
            if beyond.is_none_or(|b| !part.contains(&b)) {
                edges.entry(from).or_default()[k] = true;
            }
        }
    }
    let mut polygon = Polygon { outside: Vec::new(), holes: Vec::new() };
    while let Some((&start, out)) = edges.first_key_value() {
        let first = out.iter().position(|e| *e)?;
        let (mut at, mut heading, mut ring) = (start, first, vec![start]);
        let mut twice_area = 0.0;
        loop {
            let out = edges.get_mut(&at)?;
            out[heading] = false;
            if !out.contains(&true) {
                edges.remove(&at);
            }
            let next = moved(at, STEPS[heading])?;
            twice_area += at.0 as f64 * next.1 as f64 - next.0 as f64 * at.1 as f64;
            at = next;
            // Where two squares touch at a corner only, turning right keeps a hole and what surrounds it apart.
            let out = edges.get(&at).copied().unwrap_or_default();
            let turns = [(heading + 3) % 4, heading, (heading + 1) % 4];
            let turn = turns.into_iter().find(|&k| out[k] || (at == start && k == first))?;
            if at == start && turn == first {
                break;
            }
            if turn != heading {
                ring.push(at);
            }
            heading = turn;
        }
        let place = |(x, y): Corner| grid.corner + grid.side_m * DVec2::new(x as f64, y as f64);
        let ring: Vec<DVec2> = ring.into_iter().map(place).collect();
        if twice_area > 0.0 { polygon.outside = ring } else { polygon.holes.push(ring) }
    }
    Some(polygon)
}

#[cfg(test)]
mod tests {
    use geometry::polygon::signed_area;

    use super::*;

    const GRID: Grid = Grid { corner: DVec2::new(100.0, 200.0), side_m: 2.0, columns: 5, rows: 4 };

    fn drawn(rows: [&str; 4]) -> Vec<Polygon> {
        let squares = rows.iter().rev().flat_map(|r| r.bytes()).enumerate().filter(|(_, b)| *b == b'#');
        polygons(&squares.map(|(i, _)| i as u32).collect::<Vec<_>>(), &GRID)
    }

    #[test]
    fn a_block_of_squares_has_four_corners_counter_clockwise() {
        let [p] = drawn([".....", ".###.", ".###.", "....."]).try_into().expect("one");
        assert_eq!((p.outside.len(), p.holes.len(), signed_area(&p.outside)), (4, 0, 24.0));
    }

    #[test]
    fn squares_that_touch_at_a_corner_are_two_polygons() {
        let two = drawn([".....", "..#..", ".#...", "....."]);
        assert_eq!(two.iter().map(|p| signed_area(&p.outside)).collect::<Vec<_>>(), [4.0, 4.0]);
    }

    #[test]
    fn a_hole_is_clockwise_and_stays_apart_from_the_outside_that_it_touches() {
        let [p] = drawn([".....", "##...", "#.#..", "###.."]).try_into().expect("one");
        assert_eq!((signed_area(&p.outside), p.holes.len()), (32.0, 1));
        assert_eq!(signed_area(&p.holes[0]), -4.0);
        let total: f64 = signed_area(&p.outside) + signed_area(&p.holes[0]);
        assert_eq!(total, 28.0, "seven squares");
    }

    #[test]
    fn every_set_of_squares_keeps_its_area() {
        // All sets of a 3 × 3 block.
        for set in 0..512u32 {
            let squares: Vec<u32> = (0..9).filter(|k| set >> k & 1 == 1).map(|k| k % 3 + k / 3 * 5).collect();
            let found = polygons(&squares, &GRID);
            let total: f64 =
                found.iter().flat_map(|p| p.holes.iter().chain([&p.outside])).map(|r| signed_area(r)).sum();
            assert_eq!(total, 4.0 * squares.len() as f64, "{set:b}");
            assert!(
                found.iter().all(|p| signed_area(&p.outside) > 0.0 && p.holes.iter().all(|h| signed_area(h) < 0.0)),
                "{set:b}"
            );
        }
    }
}

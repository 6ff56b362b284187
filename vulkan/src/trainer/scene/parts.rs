//! Rectangles of a picture's blocks.

use super::cell::{Blocks, SIDE};

/// The rectangles that are halved from the whole picture down to the block (x, y), the largest first.
pub(super) fn parts_around(x: u8, y: u8) -> impl Iterator<Item = Blocks> {
    let around = |at: u8, side: u8| [at / side * side, at / side * side + side];
    [(8, 8), (4, 8), (4, 4), (2, 4), (2, 2), (1, 2), (1, 1)]
        .into_iter()
        .map(move |(w, h)| Blocks { x: around(x, w), y: around(y, h) })
}

/// The largest rectangle all of whose bits are in `mask`; `None` when it has none.
pub(super) fn largest_rectangle(mask: u64) -> Option<Blocks> {
    let row = |y: u8| (mask >> (SIDE * y)) as u8;
    let mut best: Option<Blocks> = None;
    for top in 0..SIDE {
        let mut columns = u8::MAX;
        for bottom in top..SIDE {
            columns &= row(bottom);
            let Some(x) = longest_run(columns) else { break };
            let part = Blocks { x, y: [top, bottom + 1] };
            if best.is_none_or(|b| part.count() > b.count()) {
                best = Some(part);
            }
        }
    }
    best
}

/// The longest run of ones, from its first to one past its last bit.
fn longest_run(bits: u8) -> Option<[u8; 2]> {
    let mut best = None;
    let mut from = 0;
    for at in 0..=SIDE {
        if at == SIDE || bits >> at & 1 == 0 {
            if at > from && best.is_none_or(|[a, b]: [u8; 2]| at - from > b - a) {
                best = Some([from, at]);
            }
            from = at + 1;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_rectangle_is_found_wherever_it_lies() {
        assert_eq!(largest_rectangle(0), None);
        assert_eq!(largest_rectangle(u64::MAX), Some(Blocks::WHOLE));
        let part = Blocks { x: [2, 7], y: [3, 5] };
        let one_more = Blocks { x: [0, 1], y: [0, 8] };
        assert_eq!(largest_rectangle(part.mask() | one_more.mask()), Some(part));
        let hole = !(1 << 9);
        assert_eq!(largest_rectangle(hole), Some(Blocks { x: [2, 8], y: [0, 8] }).filter(|b| b.count() == 48));
    }

    #[test]
    fn parts_halve_from_the_whole_picture_down_to_the_block() {
        let parts: Vec<Blocks> = parts_around(5, 2).collect();
        assert_eq!((parts[0], parts[6]), (Blocks::WHOLE, Blocks { x: [5, 6], y: [2, 3] }));
        assert!(parts.windows(2).all(|p| p[0].count() == 2 * p[1].count() && p[0].mask() & p[1].mask() == p[1].mask()));
    }
}

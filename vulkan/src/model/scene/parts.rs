//! Rectangles of a picture's blocks.

use super::cell::{Blocks, SIDE};

/// The part around the block (x, y) in which at most `room` Gaussians show, and how many do, as `seen` counts them. It grows by a side
/// at a time, the one whose blocks add the fewest Gaussians each.
///
/// # Errors
/// How many show in the block alone, where that is more than there is room for.
pub(super) fn grown_around(
    (x, y): (u8, u8),
    room: usize,
    seen: impl Fn(Blocks) -> usize,
) -> Result<(Blocks, usize), usize> {
    let mut part = Blocks { x: [x, x + 1], y: [y, y + 1] };
    let mut needed = seen(part);
    if needed > room {
        return Err(needed);
    }
    loop {
        let larger = part.larger().map(|p| (p, seen(p))).filter(|(_, needed)| *needed <= room);
        let each = |p: &(Blocks, usize)| (p.1 - needed) as f32 / (p.0.count() - part.count()) as f32;
        match larger.min_by(|a, b| each(a).total_cmp(&each(b))) {
            Some(best) => (part, needed) = best,
            None => return Ok((part, needed)),
        }
    }
}

impl Blocks {
    /// This part and one more row or column.
    fn larger(self) -> impl Iterator<Item = Self> {
        let Self { x: [left, right], y: [top, bottom] } = self;
        let sides = [
            (left > 0).then(|| Self { x: [left - 1, right], ..self }),
            (right < SIDE).then(|| Self { x: [left, right + 1], ..self }),
            (top > 0).then(|| Self { y: [top - 1, bottom], ..self }),
            (bottom < SIDE).then(|| Self { y: [top, bottom + 1], ..self }),
        ];
        sides.into_iter().flatten()
    }
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
    fn a_part_grows_to_where_little_shows_and_no_further_than_there_is_room() {
        // One Gaussian a block, in the columns from 4 on ten.
        let seen = |part: Blocks| {
            let columns = (part.x[0]..part.x[1]).map(|x| if x < 4 { 1 } else { 10 }).sum::<usize>();
            columns * usize::from(part.y[1] - part.y[0])
        };
        assert_eq!(grown_around((1, 6), 32, seen), Ok((Blocks { x: [0, 4], y: [0, 8] }, 32)));
        assert_eq!(grown_around((1, 6), 1000, seen), Ok((Blocks::WHOLE, 352)));
        assert_eq!(grown_around((5, 5), 9, seen), Err(10));
        let (part, needed) = grown_around((7, 0), 47, seen).unwrap();
        assert!(part.mask() >> 7 & 1 == 1 && needed <= 47 && needed == seen(part), "{part:?} {needed}");
        assert!(part.larger().all(|p| seen(p) > 47), "{part:?}");
    }

    #[test]
    fn what_shows_nowhere_is_no_hindrance() {
        assert_eq!(grown_around((3, 3), 0, |_| 0), Ok((Blocks::WHOLE, 0)));
    }
}

//! Rows of spherical harmonics as indices of a palette: a tree of cuts, each across the direction in which the worst cell
//! varies most, then k-means within families of neighbouring leaves. The same rows give the same palette; the time grows
//! with rows · log(palette), the memory is three words a row beside the rows themselves.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use rayon::prelude::*;

/// Leaves that are one another's neighbours: a row is compared with so many entries, not with 65,536; at degree 3 they are 11 KiB,
/// which a processor has near.
const FAMILY: usize = 64;
/// Rounds of k-means within a family; what they leave costs sheffield_cross 0.04 dB (81e2322).
const ROUNDS: usize = 6;

/// What rows were replaced by.
pub(super) struct Palette {
    /// Entries, one after another, each as long as a row.
    pub entries: Vec<f32>,
    /// Entry of each row.
    pub labels: Vec<u32>,
}

/// A cell of the tree: rows `from..to` of the order.
struct Cell {
    from: usize,
    to: usize,
    mean: Vec<f32>,
    axis: usize,
    error: f64,
    halves: Option<(usize, usize)>,
}

/// The worst cell first, of equal ones the older.
#[derive(PartialEq)]
struct Worst(f64, usize);

impl Eq for Worst {}

impl PartialOrd for Worst {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Worst {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.total_cmp(&other.0).then(other.1.cmp(&self.1))
    }
}

impl Palette {
    /// At most `size` entries for `count` rows of `width` numbers.
    pub(super) fn of<'a>(count: usize, width: usize, size: usize, row: &(impl Fn(usize) -> &'a [f32] + Sync)) -> Self {
        let mut order: Vec<u32> = (0..count as u32).collect();
        let cells = cut(&mut order, width, size, row);
        let mut families = Vec::new();
        gather(&cells, 0, &mut families);
        let refined: Vec<(Vec<f32>, Vec<u32>)> = families
            .par_iter()
            .map(|leaves| {
                let (from, to) = (cells[leaves[0]].from, cells[leaves[leaves.len() - 1]].to);
                let mut entries: Vec<f32> = leaves.iter().flat_map(|l| cells[*l].mean.iter().copied()).collect();
                let labels = refine(&mut entries, &order[from..to], width, row);
                (entries, labels)
            })
            .collect();
        let mut palette = Self { entries: Vec::new(), labels: vec![0; count] };
        let mut at = 0;
        for (entries, labels) in refined {
            let first = (palette.entries.len() / width) as u32;
            for label in labels {
                palette.labels[order[at] as usize] = first + label;
                at += 1;
            }
            palette.entries.extend(entries);
        }
        palette
    }
}

/// Cuts the worst cell until there are `size` leaves or nothing varies; sorts `order` so that each cell is one run of it.
fn cut<'a>(order: &mut [u32], width: usize, size: usize, row: &impl Fn(usize) -> &'a [f32]) -> Vec<Cell> {
    let mut cells = vec![measure(order, (0, order.len()), width, row)];
    let mut heap = BinaryHeap::from([Worst(cells[0].error, 0)]);
    let mut leaves = 1;
    while leaves < size {
        let Some(Worst(error, i)) = heap.pop() else { break };
        if error <= 0.0 {
            break;
        }
        let (from, to, axis) = (cells[i].from, cells[i].to, cells[i].axis);
        let at = cells[i].mean[axis];
        let mut middle = from;
        for k in from..to {
            if row(order[k] as usize)[axis] < at {
                order.swap(k, middle);
                middle += 1;
            }
        }
        if middle == from || middle == to {
            // What varies here is below the mean's last digit.
            continue;
        }
        let first = cells.len();
        for half in [(from, middle), (middle, to)] {
            let cell = measure(order, half, width, row);
            heap.push(Worst(cell.error, cells.len()));
            cells.push(cell);
        }
        cells[i].halves = Some((first, first + 1));
        leaves += 1;
    }
    cells
}

/// Mean, squared error and the axis that holds most of it.
fn measure<'a>(order: &[u32], (from, to): (usize, usize), width: usize, row: &impl Fn(usize) -> &'a [f32]) -> Cell {
    let mut sums = vec![(0.0f64, 0.0f64); width];
    for i in &order[from..to] {
        for (s, v) in sums.iter_mut().zip(row(*i as usize)) {
            s.0 += f64::from(*v);
            s.1 += f64::from(*v) * f64::from(*v);
        }
    }
    let n = ((to - from) as f64).max(1.0);
    let errors: Vec<f64> = sums.iter().map(|(s, q)| (q - s * s / n).max(0.0)).collect();
    let axis = (0..width).fold(0, |best, k| if errors[k] > errors[best] { k } else { best });
    // A single row has none, whatever rounding says.
    let error = if to - from > 1 { errors.iter().sum() } else { 0.0 };
    Cell { from, to, mean: sums.iter().map(|s| (s.0 / n) as f32).collect(), axis, error, halves: None }
}

/// The leaves below `cell` from left to right, in runs of at most [`FAMILY`] that one cell spans.
fn gather(cells: &[Cell], root: usize, families: &mut Vec<Vec<usize>>) {
    // A stack of our own: degenerate rows make a tree as deep as it has leaves.
    let mut below = vec![0usize; cells.len()];
    for i in (0..cells.len()).rev() {
        below[i] = cells[i].halves.map_or(1, |(a, b)| below[a] + below[b]);
    }
    let mut stack = vec![(root, false)];
    while let Some((i, inside)) = stack.pop() {
        let starts = !inside && below[i] <= FAMILY;
        if starts {
            families.push(Vec::new());
        }
        match (cells[i].halves, families.last_mut()) {
            (None, Some(family)) => family.push(i),
            (Some((a, b)), _) => stack.extend([(b, inside || starts), (a, inside || starts)]),
            (None, None) => {}
        }
    }
}

/// K-means of the rows `members` from `entries` on; the entry of each member.
fn refine<'a>(entries: &mut [f32], members: &[u32], width: usize, row: &impl Fn(usize) -> &'a [f32]) -> Vec<u32> {
    let mut labels = vec![0u32; members.len()];
    for round in 0..ROUNDS {
        for (label, member) in labels.iter_mut().zip(members) {
            *label = nearest(entries, width, row(*member as usize));
        }
        if round + 1 == ROUNDS || entries.len() == width {
            break;
        }
        let mut sums = vec![0.0f64; entries.len()];
        let mut counts = vec![0u32; entries.len() / width];
        for (label, member) in labels.iter().zip(members) {
            let k = *label as usize;
            counts[k] += 1;
            for (s, v) in sums[k * width..].iter_mut().zip(row(*member as usize)) {
                *s += f64::from(*v);
            }
        }
        for (i, entry) in entries.iter_mut().enumerate().filter(|(i, _)| counts[i / width] > 0) {
            *entry = (sums[i] / f64::from(counts[i / width])) as f32;
        }
    }
    labels
}

fn nearest(entries: &[f32], width: usize, row: &[f32]) -> u32 {
    let mut best = (f32::INFINITY, 0);
    for (k, entry) in entries.chunks_exact(width).enumerate() {
        let d: f32 = entry.iter().zip(row).map(|(a, b)| (a - b) * (a - b)).sum();
        if d < best.0 {
            best = (d, k as u32);
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};

    use super::*;

    fn rows(n: usize, width: usize) -> Vec<f32> {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(7);
        (0..n * width).map(|_| rng.random_range(-1.0f32..1.0).powi(3)).collect()
    }

    fn error(rows: &[f32], width: usize, palette: &Palette) -> f64 {
        let replaced = |i: usize| &palette.entries[palette.labels[i / width] as usize * width + i % width];
        (0..rows.len()).map(|i| f64::from(rows[i] - replaced(i)).powi(2)).sum()
    }

    #[test]
    fn rows_that_fit_the_palette_come_back_as_they_are() {
        let rows = rows(50, 9);
        let palette = Palette::of(50, 9, 64, &|i| &rows[9 * i..9 * i + 9]);
        assert_eq!(error(&rows, 9, &palette), 0.0);
        let same = Palette::of(20, 3, 8, &|_| &[0.5, -0.25, 0.0]);
        assert_eq!((same.entries, same.labels), (vec![0.5, -0.25, 0.0], vec![0; 20]));
        assert!(Palette::of(0, 9, 64, &|i| &rows[i..]).labels.is_empty());
    }

    #[test]
    fn four_times_the_palette_leaves_less_error_and_the_same_rows_the_same_palette() {
        let rows = rows(4000, 9);
        let of = |size| Palette::of(4000, 9, size, &|i| &rows[9 * i..9 * i + 9]);
        let (few, many) = (of(64), of(256));
        assert!(few.entries.len() <= 64 * 9 && many.entries.len() <= 256 * 9);
        assert!(error(&rows, 9, &many) < 0.85 * error(&rows, 9, &few));
        let again = of(256);
        assert_eq!((again.entries, again.labels), (many.entries, many.labels));
    }

    #[test]
    fn rows_that_lie_on_a_line_cannot_exhaust_the_stack() {
        // Each cut takes one row off: the tree is as deep as it can be.
        let rows: Vec<f32> = (0..3000).map(|i| 1.5f32.powi(i % 200) * (1.0 + i as f32)).collect();
        let palette = Palette::of(3000, 1, 2048, &|i| &rows[i..=i]);
        assert_eq!(palette.labels.len(), 3000);
    }
}

//! Costs summed along eight paths to each cell, with penalties where the depth changes from one cell to the next.

use super::features::Features;
use super::volume::Volume;
use super::{PLANES, Smoothness, UNIT};

/// How fast the penalty of a large step falls with the step in luminance, and the least of it, in small steps.
const EDGE: f32 = 8.0;
const LEAST: f32 = 1.5;
/// More than any sum along a path.
const NEVER: i16 = 16_000;

/// Costs of a cell along a path, with a guard on each side.
#[derive(Clone, Copy, Debug)]
struct Path {
    costs: [i16; PLANES + 2],
    least: i16,
}

const FRESH: Path = Path { costs: [0; PLANES + 2], least: 0 };

impl Path {
    /// One cell further, whose costs are `own`, with the penalties of a small and of a large step. All sums of eight paths stay below 2¹⁵.
    fn step(&self, own: &[u8; PLANES], [small, large]: [i16; 2], sums: &mut [i16; PLANES]) -> Self {
        let mut next = Self { costs: [NEVER; PLANES + 2], least: NEVER };
        let jump = self.least.wrapping_add(large);
        let mut least = NEVER;
        for d in 0..PLANES {
            let stay = self.costs[d + 1];
            let step = self.costs[d].min(self.costs[d + 2]).wrapping_add(small);
            let cost = stay.min(step).min(jump).wrapping_sub(self.least).wrapping_add(i16::from(own[d]));
            next.costs[d + 1] = cost;
            least = least.min(cost);
            sums[d] = sums[d].wrapping_add(cost);
        }
        next.least = least;
        next
    }

    /// Where a path begins.
    fn begin(own: &[u8; PLANES], sums: &mut [i16; PLANES]) -> Self {
        let mut next = Self { costs: [NEVER; PLANES + 2], least: NEVER };
        for d in 0..PLANES {
            let cost = i16::from(own[d]);
            next.costs[d + 1] = cost;
            next.least = next.least.min(cost);
            sums[d] = sums[d].wrapping_add(cost);
        }
        next
    }
}

/// Sums of all cells and planes, and the paths at work.
#[derive(Debug, Default)]
pub struct Paths {
    pub sums: Vec<[i16; PLANES]>,
    row: Vec<[u8; PLANES]>,
    /// Paths that come from the row before, one of three directions each, there and here.
    before: [Vec<Path>; 3],
    here: [Vec<Path>; 3],
}

impl Smoothness {
    /// What a small and a large step cost between cells of two luminances.
    fn penalties(&self, a: f32, b: f32) -> [i16; 2] {
        let large = self.large_step / (1.0 + EDGE * (a - b).abs());
        [self.small_step, large.max(LEAST * self.small_step)].map(|penalty| (UNIT as f32 * penalty) as i16)
    }
}

impl Paths {
    pub fn planned_bytes(cells: u64, across: u64) -> u64 {
        let planes = PLANES as u64;
        cells * 2 * planes + across * (planes + 6 * size_of::<Path>() as u64)
    }

    #[cfg(test)]
    pub fn held_bytes(&self) -> u64 {
        let paths = self.before.iter().chain(&self.here).map(Vec::capacity).sum::<usize>();
        (2 * PLANES * self.sums.capacity() + PLANES * self.row.capacity() + size_of::<Path>() * paths) as u64
    }

    /// Down the picture and up again: along each row, and from the row before straight and across.
    pub fn run(&mut self, volume: &Volume, features: &Features, smoothness: Smoothness) {
        let (w, h) = volume.size();
        self.sums.clear();
        self.sums.resize(w * h, [0; PLANES]);
        self.row.resize(w, [0; PLANES]);
        for paths in self.before.iter_mut().chain(&mut self.here) {
            paths.clear();
            paths.resize(w, FRESH);
        }
        let line = |y: usize| &features.luminance[y * w..][..w];
        for back in [false, true] {
            for k in 0..h {
                let y = if back { h - 1 - k } else { k };
                volume.row(y, &mut self.row);
                let above = (k > 0).then(|| line(if back { y + 1 } else { y - 1 }));
                let sums = &mut self.sums[y * w..][..w];
                along(back, &self.row, line(y), smoothness, sums);
                for (side, (before, here)) in self.before.iter().zip(&mut self.here).enumerate() {
                    for x in 0..w {
                        // From the left, from straight above, from the right.
                        let from = (x + side).checked_sub(1).filter(|from| *from < w);
                        here[x] = match (above, from) {
                            (Some(above), Some(from)) => before[from].step(
                                &self.row[x],
                                smoothness.penalties(line(y)[x], above[from]),
                                &mut sums[x],
                            ),
                            _ => Path::begin(&self.row[x], &mut sums[x]),
                        };
                    }
                }
                std::mem::swap(&mut self.before, &mut self.here);
            }
        }
    }
}

/// Along a row, from its left end or, `back`, from its right end.
fn along(back: bool, row: &[[u8; PLANES]], line: &[f32], smoothness: Smoothness, sums: &mut [[i16; PLANES]]) {
    let w = row.len();
    let mut path = FRESH;
    for i in 0..w {
        let x = if back { w - 1 - i } else { i };
        path = if i == 0 {
            Path::begin(&row[x], &mut sums[x])
        } else {
            let from = if back { x + 1 } else { x - 1 };
            path.step(&row[x], smoothness.penalties(line[x], line[from]), &mut sums[x])
        };
    }
}

//! Positions: a grid as fine as the Gaussians of one size class need, its occupied cells in Morton order as the counts of a
//! binary tree. Which Gaussian is which costs nothing: they are a set.

use super::coder::{Coder, Counts, Garbled};
use glam::{DVec3, Vec3};

/// Bits of a grid coordinate.
const AXIS_BITS: u32 = 21;
/// Nodes with at most so many Gaussians have counts of their own.
const SMALL: u32 = 12;
/// A larger node's left share in so many steps, the rest evenly.
const STEPS: u32 = 16;

/// The box that all grids begin in: a corner and an edge, metres.
#[derive(Clone, Copy, Debug)]
pub struct GridBounds {
    pub corner: DVec3,
    pub edge: f64,
}

impl GridBounds {
    /// Four times the box that holds all but the outermost thousandth of each side: what lies beyond is not worth a finer
    /// grid for all others.
    pub fn of(means: &[Vec3]) -> Self {
        let (mut low, mut high) = (Vec3::ZERO, Vec3::ZERO);
        for axis in 0..3 {
            let mut values: Vec<f32> = means.iter().map(|m| m[axis]).collect();
            if values.is_empty() {
                continue;
            }
            values.sort_unstable_by(f32::total_cmp);
            let out = (values.len() / 1000).max(1).min(values.len() / 3);
            (low[axis], high[axis]) = (values[out], values[values.len() - 1 - out]);
        }
        let middle = (low.as_dvec3() + high.as_dvec3()) / 2.0;
        let edge = 2.0 * f64::from((high - low).max_element()) + 1e-3;
        // As the decoder will see it.
        let rounded = |v: f64| f64::from(v as f32);
        let edge = rounded(edge);
        Self { corner: (middle - edge / 2.0).map(rounded), edge }
    }

    pub fn code(self, coder: &mut impl Coder) -> Result<Self, Garbled> {
        let c = self.corner;
        let corner = DVec3::new(
            f64::from(coder.f32(c.x as f32)?),
            f64::from(coder.f32(c.y as f32)?),
            f64::from(coder.f32(c.z as f32)?),
        );
        let edge = f64::from(coder.f32(self.edge as f32)?);
        if corner.is_finite() && edge.is_finite() && edge > 0.0 { Ok(Self { corner, edge }) } else { Err(Garbled) }
    }

    pub fn holds(&self, mean: Vec3) -> bool {
        let inside = (mean.as_dvec3() - self.corner) / self.edge;
        inside.cmpge(DVec3::ZERO).all() && inside.cmplt(DVec3::ONE).all()
    }

    /// A grid of cells of at least `step` metres. It begins at a multiple of its step, whatever the bounds are: what was rounded once comes
    /// back as it is.
    pub fn grid(&self, step: f64) -> Grid {
        // What lies before the bounds' corner takes one more.
        let step = step.max(self.edge / f64::from((1u32 << AXIS_BITS) - 2));
        let corner = (self.corner / step).floor() * step;
        let last = (self.edge / step) as u32 + 1;
        Grid { corner, step, axis_bits: 32 - last.leading_zeros() }
    }

    /// Where a position comes in the order that attributes are coded in.
    pub fn rank(&self, position: DVec3) -> u64 {
        let cell = (position - self.corner) / self.edge * f64::from(1u32 << (AXIS_BITS - 1));
        interleave(cell.to_array().map(|v| v.clamp(0.0, f64::from((1u32 << AXIS_BITS) - 1)) as u32))
    }
}

/// One size class's grid.
#[derive(Clone, Copy, Debug)]
pub struct Grid {
    corner: DVec3,
    step: f64,
    axis_bits: u32,
}

impl Grid {
    /// Bits of a cell's Morton code.
    pub fn bits(&self) -> u32 {
        3 * self.axis_bits
    }

    /// The Morton code of the cell that holds `mean`.
    pub fn cell(&self, mean: Vec3) -> u64 {
        interleave(((mean.as_dvec3() - self.corner) / self.step).to_array().map(|v| v as u32))
    }

    /// The middle of a cell.
    pub fn center(&self, cell: u64) -> DVec3 {
        self.corner + (DVec3::from(separate(cell).map(f64::from)) + 0.5) * self.step
    }
}

/// x's bits above y's above z's.
fn interleave(cell: [u32; 3]) -> u64 {
    cell.into_iter().fold(0, |code, v| code << 1 | spread(v))
}

fn separate(code: u64) -> [u32; 3] {
    [2, 1, 0].map(|axis| gather(code >> axis))
}

/// Two zeros between the lower 21 bits.
fn spread(v: u32) -> u64 {
    let mut v = u64::from(v) & 0x1f_ffff;
    for (shift, mask) in [
        (32, 0x1f_0000_0000_ffff),
        (16, 0x1f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ] {
        v = (v | v << shift) & mask;
    }
    v
}

fn gather(v: u64) -> u32 {
    let mut v = v & 0x1249_2492_4924_9249;
    for (shift, mask) in [
        (2, 0x10c3_0c30_c30c_30c3),
        (4, 0x100f_00f0_0f00_f00f),
        (8, 0x1f_0000_ff00_00ff),
        (16, 0x1f_0000_0000_ffff),
        (32, 0x1f_ffff),
    ] {
        v = (v | v >> shift) & mask;
    }
    v as u32
}

/// Counts of the tree's nodes, shared by all classes.
pub struct Tree {
    small: Vec<Counts>,
    large: Counts,
}

impl Tree {
    pub fn new() -> Self {
        let small = (0..=SMALL).map(|n| Counts::even(n as usize + 1)).collect();
        Self { small, large: Counts::even(STEPS as usize) }
    }

    /// Codes `n` sorted cells of `bits` bits; an encoder gives them, a decoder none.
    pub fn code(&mut self, coder: &mut impl Coder, cells: &[u64], n: u32, bits: u32) -> Result<Vec<u64>, Garbled> {
        let mut out = Vec::with_capacity(n as usize);
        if n > 0 {
            self.node(coder, cells, n, bits, 0, &mut out)?;
        }
        Ok(out)
    }

    fn node(
        &mut self,
        coder: &mut impl Coder,
        cells: &[u64],
        n: u32,
        bits: u32,
        prefix: u64,
        out: &mut Vec<u64>,
    ) -> Result<(), Garbled> {
        if bits == 0 {
            out.extend(std::iter::repeat_n(prefix, n as usize));
            return Ok(());
        }
        if n == 1 {
            let low = (1 << bits) - 1;
            let rest = coder.bits(bits, cells.first().map_or(0, |c| c & low))?;
            out.push(prefix << bits | rest);
            return Ok(());
        }
        let left = cells.partition_point(|c| c >> (bits - 1) & 1 == 0);
        let taken = self.split(coder, n, left as u32)?;
        let (lower, upper) = cells.split_at(left);
        if taken > 0 {
            self.node(coder, lower, taken, bits - 1, prefix << 1, out)?;
        }
        if taken < n {
            self.node(coder, upper, n - taken, bits - 1, prefix << 1 | 1, out)?;
        }
        Ok(())
    }

    /// How many of `n` are in the lower half.
    fn split(&mut self, coder: &mut impl Coder, n: u32, left: u32) -> Result<u32, Garbled> {
        if n <= SMALL {
            return coder.symbol(&mut self.small[n as usize], left);
        }
        let all = u64::from(n) + 1;
        let from = |step: u32| (u64::from(step) * all).div_ceil(u64::from(STEPS)) as u32;
        let step = (u64::from(left) * u64::from(STEPS) / all) as u32;
        let step = coder.symbol(&mut self.large, step)?;
        Ok(from(step) + coder.even(from(step + 1) - from(step), left.saturating_sub(from(step)))?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::delivery::coder::{Decoder, Encoder};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn morton_codes_hold_every_coordinate(cell in proptest::array::uniform3(0u32..1 << 21)) {
            prop_assert_eq!(separate(interleave(cell)), cell);
        }

        #[test]
        fn the_tree_gives_the_sorted_cells_back(mut cells in proptest::collection::vec(0u64..1 << 12, 0..300)) {
            cells.sort_unstable();
            let mut encoder = Encoder::new();
            Tree::new().code(&mut encoder, &cells, cells.len() as u32, 12).unwrap();
            let mut decoder = Decoder::new(encoder.finish());
            prop_assert_eq!(Tree::new().code(&mut decoder, &[], cells.len() as u32, 12).unwrap(), cells);
        }
    }
}

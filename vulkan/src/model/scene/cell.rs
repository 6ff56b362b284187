//! Cells of ground on the device: how far a Gaussian reaches, and where in a picture a cell may show.

use glam::{Vec2, Vec3};
use models::camera::View;

use crate::constants::{ALPHA_MIN, LOW_PASS};
use crate::layout::{FLAG_ORTHOGRAPHIC, Frame};
use crate::model::parameters::Geometry;

/// Rounding of the bounds below: a hundredth of a pixel, as `project` adds, and as much again.
const ROUNDING_PX: f32 = 0.02;

/// How far from its mean a Gaussian is blended at most, metres: where its alpha falls below [`ALPHA_MIN`], were it opaque.
pub(crate) fn reach_of(g: &Geometry) -> f32 {
    let widest = g.log_scale.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    // What `project` would clamp by depth, too, stays finite here.
    standard_deviations() * widest.min(80.0).exp()
}

fn standard_deviations() -> f32 {
    (-2.0 * ALPHA_MIN.ln()).sqrt()
}

/// Box around the means of a cell's Gaussians, and how far the widest reaches beyond.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CellBounds {
    pub low: Vec3,
    pub high: Vec3,
    pub reach: f32,
}

impl CellBounds {
    pub const EMPTY: Self = Self { low: Vec3::INFINITY, high: Vec3::NEG_INFINITY, reach: 0.0 };

    pub fn add(&mut self, g: &Geometry) {
        let mean = Vec3::from(g.mean);
        // What is not finite shows nowhere.
        if !mean.is_finite() {
            return;
        }
        (self.low, self.high) = (self.low.min(mean), self.high.max(mean));
        self.reach = self.reach.max(reach_of(g));
    }

    pub fn centre(&self) -> Vec2 {
        0.5 * (self.low + self.high).truncate()
    }

    /// How far from a place on the ground the nearest of what the cell may show lies, metres.
    pub fn ground_distance(&self, place: Vec2) -> f32 {
        let (low, high) = (self.low.truncate() - self.reach, self.high.truncate() + self.reach);
        place.distance(place.clamp(low, high.max(low)))
    }

    /// The largest value of direction · p in the box.
    fn most(&self, direction: Vec3) -> f32 {
        (direction * self.low).max(direction * self.high).element_sum()
    }
}

/// Blocks along each side of a picture: the grain in which parts of pictures are trained.
pub(crate) const SIDE: u8 = 8;

/// A rectangle of a picture's 8 × 8 blocks: [first, one past the last].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Blocks {
    pub x: [u8; 2],
    pub y: [u8; 2],
}

impl Blocks {
    pub const WHOLE: Self = Self { x: [0, SIDE], y: [0, SIDE] };

    pub fn count(&self) -> u32 {
        u32::from(self.x[1] - self.x[0]) * u32::from(self.y[1] - self.y[0])
    }

    /// One bit per block, row by row.
    pub fn mask(&self) -> u64 {
        let row = ((1u64 << (self.x[1] - self.x[0])) - 1) << self.x[0];
        (self.y[0]..self.y[1]).fold(0, |mask, y| mask | row << (SIDE * y))
    }

    /// First pixel and pixels of [first, last) blocks along a side of `pixels`.
    pub fn pixels([first, last]: [u8; 2], pixels: u32) -> (u32, u32) {
        let at = |block: u8| (u64::from(block) * u64::from(pixels) / u64::from(SIDE)) as u32;
        (at(first), at(last) - at(first))
    }
}

/// A camera as it decides which blocks of its picture a cell may show in: exact where it says no.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Frustum {
    axes: [Vec3; 3],
    shift: Vec3,
    perspective: bool,
    near: f32,
    /// Boundaries between blocks: x/z and y/z, or metres where rays are parallel.
    edges: [[f32; SIDE as usize + 1]; 2],
    /// Factor of a cell's reach along x and y.
    slant: [f32; 2],
    /// What the low-pass adds around every Gaussian, in the unit of the edges.
    blur: [f32; 2],
}

impl Frustum {
    /// Of a whole picture.
    pub fn of(camera: &View) -> Self {
        let mut frame: Frame = bytemuck::Zeroable::zeroed();
        frame.look(camera);
        Self::new(&frame, [0, 0], frame.size)
    }

    /// Of the region that `frame` shows.
    pub fn of_region(frame: &Frame) -> Self {
        Self::new(frame, frame.region_origin, frame.region)
    }

    /// Of a window of so many pixels from `origin` on of the picture that `frame` shows.
    fn new(frame: &Frame, origin: [u32; 2], size: [u32; 2]) -> Self {
        let row = |i: usize| Vec3::from_slice(&frame.view_rows[i][..3]);
        let perspective = !frame.has(FLAG_ORTHOGRAPHIC);
        let edge = |axis: usize, block: usize| {
            let pixel = origin[axis] as f32 + size[axis] as f32 * block as f32 / f32::from(SIDE);
            (pixel - frame.principal_point[axis]) / frame.focal[axis]
        };
        let blur = standard_deviations() * LOW_PASS.sqrt() + ROUNDING_PX;
        Self {
            axes: [row(0), row(1), row(2)],
            shift: Vec3::new(frame.view_rows[0][3], frame.view_rows[1][3], frame.view_rows[2][3]),
            perspective,
            near: frame.near,
            edges: [0, 1].map(|axis| std::array::from_fn(|block| edge(axis, block))),
            // |a| = f/z · |(1, -ratio) · axes| ≤ f/z · scale · √(1 + ratio²), with the ratio clamped (`projection.glsl`).
            slant: [0, 1].map(|axis| {
                let ratio = frame.max_ratio[axis].abs().max(frame.min_ratio[axis].abs());
                if perspective { (1.0 + ratio * ratio).sqrt() } else { 1.0 }
            }),
            blur: [0, 1].map(|axis| blur / frame.focal[axis]),
        }
    }

    /// The blocks in which Gaussians of a cell may show; `None` when none of them can.
    pub fn blocks(&self, bounds: &CellBounds) -> Option<Blocks> {
        let [x, y] = [0, 1].map(|axis| self.along(axis, bounds));
        match (x, y) {
            (Some(x), Some(y)) if self.is_in_front(bounds) => Some(Blocks { x, y }),
            _ => None,
        }
    }

    /// Whether Gaussians of a cell may show in a part: quicker than [`Self::blocks`].
    pub fn shows_in(&self, part: Blocks, bounds: &CellBounds) -> bool {
        let along = |axis: usize, [first, end]: [u8; 2]| {
            self.beyond(axis, bounds, -1.0, usize::from(end)) && self.beyond(axis, bounds, 1.0, usize::from(first))
        };
        along(0, part.x) && along(1, part.y) && self.is_in_front(bounds)
    }

    fn is_in_front(&self, bounds: &CellBounds) -> bool {
        bounds.most(self.axes[2]) + self.shift.z >= self.near
    }

    /// First block and one past the last along an axis.
    fn along(&self, axis: usize, bounds: &CellBounds) -> Option<[u8; 2]> {
        let beyond = |side: f32, edge: u8| self.beyond(axis, bounds, side, usize::from(edge));
        if !beyond(-1.0, SIDE) || !beyond(1.0, 0) {
            return None;
        }
        let first = (0..SIDE).find(|b| beyond(-1.0, b + 1))?;
        let last = (0..SIDE).rev().find(|b| beyond(1.0, *b))?;
        (first <= last).then_some([first, last + 1])
    }

    /// Whether something of a cell lies on that side, -1 or 1, of the plane through the camera and a boundary between blocks.
    fn beyond(&self, axis: usize, bounds: &CellBounds, side: f32, edge: usize) -> bool {
        let (reach, edge) = (bounds.reach * self.slant[axis], self.edges[axis][edge]);
        let (per_depth, constant) =
            if self.perspective { (self.blur[axis] - side * edge, 0.0) } else { (0.0, self.blur[axis] - side * edge) };
        let direction = side * self.axes[axis] + per_depth * self.axes[2];
        let shift = side * self.shift[axis] + per_depth * self.shift.z;
        // Sums of large numbers lose bits: a millionth of them is given away.
        let lost = 1e-6 * (shift.abs() + bounds.low.abs().max(bounds.high.abs()).max_element() + reach);
        bounds.most(direction) + shift + constant + reach + lost > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use models::ground_cell::{CellKey, Grid, MOST_LEVEL};

    fn gaussian(mean: [f32; 3], log_scale: f32) -> Geometry {
        let mut g: Geometry = bytemuck::Zeroable::zeroed();
        (g.mean, g.log_scale) = (mean, [log_scale, log_scale - 1.0, -9.0]);
        g
    }

    #[test]
    fn a_gaussian_belongs_to_the_cell_under_it_and_a_large_one_to_a_coarser_cell() {
        let grid = Grid { side: 10.0 };
        let of = |mean: [f32; 3], log_scale| grid.key(mean, reach_of(&gaussian(mean, log_scale)));
        assert_eq!(of([-0.1, 25.0, 3.0], -1.0), CellKey { level: 0, y: 2, x: -1 });
        assert_eq!(of([-0.1, 25.0, 3.0], 1.0), CellKey { level: 2, y: 0, x: -1 });
        assert_eq!(of([5e9, 0.0, 0.0], 40.0).level, MOST_LEVEL);
        let home = CellKey { level: 0, y: 2, x: -1 };
        assert!(grid.holds(home, [4.9, 15.1, 0.0], 5.0) && !grid.holds(home, [5.1, 25.0, 0.0], 1.0));
        assert!(!grid.holds(home, [f32::NAN, 25.0, 0.0], 1.0) && !grid.holds(home, [0.0, 25.0, 0.0], 5.1));
    }

    #[test]
    fn a_large_gaussian_is_near_to_wherever_it_reaches() {
        let mut bounds = CellBounds::EMPTY;
        bounds.add(&gaussian([10.0, 0.0, 0.0], 0.0));
        bounds.add(&gaussian([14.0, 2.0, 0.0], 0.0));
        let reach = reach_of(&gaussian([0.0; 3], 0.0));
        assert_eq!([Vec2::new(12.0, 1.0), Vec2::new(14.0 + reach, 2.0)].map(|p| bounds.ground_distance(p)), [0.0; 2]);
        assert!((bounds.ground_distance(Vec2::ZERO) - (10.0 - reach)).abs() < 1e-5);
    }

    #[test]
    fn a_rectangle_of_blocks_has_its_bits_and_its_pixels() {
        let part = Blocks { x: [1, 3], y: [0, 2] };
        assert_eq!((part.count(), part.mask()), (4, 0x0606));
        assert_eq!(Blocks::WHOLE.mask(), u64::MAX);
        assert_eq!([Blocks::pixels([0, 8], 101), Blocks::pixels([3, 5], 101)], [(0, 101), (37, 26)]);
    }
}

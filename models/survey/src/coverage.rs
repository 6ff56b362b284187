//! Which ground the pictures of a flight have seen: how often, from how different directions, and how well heights there can
//! be known. Squares of ground in memory that is fixed when the map is made; nothing is allocated per picture. The same map
//! decides in flight whether a picture is still wanted, and says afterwards what is missing ([`gaps`]) and how to get it
//! ([`reflight`]).
//!
//! Ground is seen where it lies in the picture and the ray comes down steeply enough; what stands in between (houses, ridges)
//! is not asked. World: metres, z up, of any size; everything kept is relative to the map's own corner.

use config::coverage::CoverageSettings;
use config::error::{Error, ErrorKind};
use glam::{DVec2, DVec3};

mod cell;
mod frustum;
pub mod gaps;
pub mod geojson;
mod ground;
mod outline;
pub mod raster;
pub mod reflight;
mod region;

use cell::Cell;
pub use cell::CellReport;
use frustum::{Frustum, Seen};
pub use ground::Heights;
pub use region::CoverageRegion;

use models::camera::View;

/// Most squares of a map: 256 by 256, 3.4 MiB in all.
pub const MAX_CELLS: usize = 1 << 16;
/// Squares across a region of average shape at least, however small it is.
const FINEST: f64 = 8.0;

/// Why there is no map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CoverageError {
    /// Fewer than three corners, corners that are no numbers, or nothing between them.
    #[error("the region has no area that could be covered; give three or more corners in order")]
    NoArea,
}

impl Error for CoverageError {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Input
    }
}

/// How well a square is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum State {
    /// In no picture.
    Unseen,
    /// In too few pictures, or in enough that look from too alike directions.
    Thin,
    /// As the settings want it.
    Covered,
}

/// Squares of ground and what is known of them.
#[derive(Clone, Debug)]
pub struct CoverageMap {
    rules: CoverageSettings,
    grid: Grid,
    /// Row by row from the south-west.
    cells: Vec<Cell>,
    /// Height of the ground at each square's middle above `base_m`, and the extremes of it.
    ground: Vec<f32>,
    base_m: f64,
    extremes: [f64; 2],
    /// Squares whose middle lies in the region.
    inside: usize,
    pictures: u32,
    dropped: u32,
}

/// Where the squares lie. Square (column, row) spans `side_m` east and north from
/// `corner + side_m · (column, row)`; a raster of it has row 0 in the south.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// South-west corner, metres east and north.
    pub corner: DVec2,
    /// Side of a square, metres.
    pub side_m: f64,
    /// Squares from west to east.
    pub columns: usize,
    /// Squares from south to north.
    pub rows: usize,
}

impl Grid {
    /// The grid over a box, its squares no smaller than `side_m` and no more than [`MAX_CELLS`].
    fn over(low: DVec2, high: DVec2, side_m: f64) -> Self {
        let size = high - low;
        let across = |side: f64| (size / side).ceil().max(DVec2::ONE);
        let mut side_m = side_m.max((size.x * size.y / MAX_CELLS as f64).sqrt());
        // Rounding up at both edges, and slender boxes, may take a few squares more than fit.
        while across(side_m).x * across(side_m).y > MAX_CELLS as f64 {
            side_m *= 1.05;
        }
        let count = across(side_m);
        // What the squares are larger than the box is shared by both sides.
        let corner = low - 0.5 * (count * side_m - size);
        Self { corner, side_m, columns: count.x as usize, rows: count.y as usize }
    }

    /// Middle of a square, metres east and north.
    pub fn middle(&self, column: usize, row: usize) -> DVec2 {
        self.corner + self.side_m * DVec2::new(column as f64 + 0.5, row as f64 + 0.5)
    }

    /// Area of a square, m².
    pub fn cell_m2(&self) -> f64 {
        self.side_m * self.side_m
    }

    fn place(&self, index: usize) -> (usize, usize) {
        (index % self.columns, index / self.columns)
    }
}

impl CoverageMap {
    /// A map of `region` that no picture has seen, over flat ground at height `ground_m`.
    ///
    /// # Errors
    /// [`CoverageError::NoArea`].
    pub fn new(region: &CoverageRegion, ground_m: f64, rules: CoverageSettings) -> Result<Self, CoverageError> {
        let (low, high) = region.bounds();
        let finest = region.area_m2().sqrt() / FINEST;
        let grid = Grid::over(low, high, f64::from(rules.cell_m).min(finest));
        let count = grid.columns * grid.rows;
        let within = |i: usize| {
            let (column, row) = grid.place(i);
            region.contains(grid.middle(column, row))
        };
        let cells: Vec<Cell> = (0..count).map(|i| Cell::new(within(i))).collect();
        let inside = cells.iter().filter(|c| c.is_inside()).count();
        if inside == 0 || !ground_m.is_finite() {
            return Err(CoverageError::NoArea);
        }
        let (ground, extremes) = (vec![0.0; count], [ground_m; 2]);
        Ok(Self { rules, grid, cells, ground, base_m: ground_m, extremes, inside, pictures: 0, dropped: 0 })
    }

    /// Puts the ground at this height at (east, north), metres; what is not finite stays as it was. Pictures seen before
    /// are forgotten.
    #[must_use]
    pub fn over(mut self, height_m: impl Fn(DVec2) -> f64) -> Self {
        for i in 0..self.ground.len() {
            let (column, row) = self.grid.place(i);
            let above = (height_m(self.grid.middle(column, row)) - self.base_m) as f32;
            if above.is_finite() {
                self.ground[i] = above;
            }
        }
        let (low, high) = self.ground.iter().fold((f32::MAX, f32::MIN), |(l, h), &g| (l.min(g), h.max(g)));
        self.extremes = [low, high].map(|g| self.base_m + f64::from(g));
        self.cells.iter_mut().for_each(Cell::forget);
        (self.pictures, self.dropped) = (0, 0);
        self
    }

    /// Notes what a picture sees; one without a usable lens and pose is only counted.
    pub fn add(&mut self, view: &View) {
        match Frustum::of(view, Seen::Whole) {
            Some(frustum) => {
                self.pictures += 1;
                self.note(&frustum);
            }
            None => self.dropped += 1,
        }
    }

    fn note(&mut self, frustum: &Frustum) {
        for i in self.in_reach(frustum) {
            if let Some(ray) = frustum.ray(self.point(i)) {
                self.cells[i].add(&ray);
            }
        }
    }

    /// Whether a picture would bring something to ground that is not covered yet.
    pub fn wants(&self, view: &View) -> bool {
        let Some(frustum) = Frustum::of(view, Seen::Whole) else { return false };
        self.in_reach(&frustum).any(|i| self.gain(i, &frustum) > 0)
    }

    /// The squares, in the region or not, that may be in sight.
    fn in_reach(&self, frustum: &Frustum) -> impl Iterator<Item = usize> + use<> {
        let (low, high) = frustum.bounds(self.extremes);
        let Grid { corner, side_m, columns, rows } = self.grid;
        let (low, high) = ((low - corner) / side_m, (high - corner) / side_m);
        let within = |v: f64, count: usize| v.clamp(0.0, count as f64) as usize;
        let (from, to) = (within(low.x.floor(), columns), within(high.x.ceil(), columns));
        let rows = within(low.y.floor(), rows)..within(high.y.ceil(), rows);
        rows.flat_map(move |row| (from..to).map(move |column| row * columns + column))
    }

    /// What a square gains by a picture: a picture that it lacks, a direction that it lacks.
    fn gain(&self, i: usize, frustum: &Frustum) -> u32 {
        let cell = &self.cells[i];
        if !cell.is_inside() || cell.is_covered(&self.rules) {
            return 0;
        }
        frustum.ray(self.point(i)).map_or(0, |ray| cell.gain(&ray, &self.rules))
    }

    /// Middle of a square on the ground.
    fn point(&self, i: usize) -> DVec3 {
        let (column, row) = self.grid.place(i);
        self.grid.middle(column, row).extend(self.base_m + f64::from(self.ground[i]))
    }

    /// Where the squares lie.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// What is known of a square; `None` outside of the region. With [`CoverageMap::grid`] this is all a raster needs.
    pub fn cell(&self, column: usize, row: usize) -> Option<CellReport> {
        let inside = column < self.grid.columns && row < self.grid.rows;
        inside.then(|| self.cell_at(row * self.grid.columns + column)).flatten()
    }

    fn cell_at(&self, i: usize) -> Option<CellReport> {
        let cell = &self.cells[i];
        cell.is_inside().then(|| cell.report(&self.rules))
    }

    /// Share of the region that is covered, 0..1.
    pub fn covered_share(&self) -> f64 {
        let covered = self.cells.iter().filter(|c| c.is_inside() && c.is_covered(&self.rules)).count();
        covered as f64 / self.inside as f64
    }

    /// Pictures taken in, and pictures left out for a lens or a pose that is no number.
    pub fn pictures(&self) -> (u32, u32) {
        (self.pictures, self.dropped)
    }

    /// Area of the region as the map sees it, m².
    pub fn area_m2(&self) -> f64 {
        self.inside as f64 * self.grid.cell_m2()
    }

    /// What counts as covered.
    pub fn rules(&self) -> &CoverageSettings {
        &self.rules
    }

    /// Height of the ground the map was made with, metres: where the aircraft took off, unless somebody said otherwise.
    pub fn base_m(&self) -> f64 {
        self.base_m
    }
}

#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;

//! The pixels of a map and the view from above that each block of them is drawn with.

use std::num::NonZeroU32;

use glam::{DMat3, DQuat, DVec2, DVec3};

use super::OrthoError;
use super::crs::Crs;
use models::camera::{OrthographicView, Pose};

/// Side of the blocks that a map is drawn and stored in, pixels.
pub const BLOCK: u32 = 512;
/// Pixels around a block that are drawn with it, so that what depends on its surroundings has no seams.
pub const MARGIN: u32 = 16;
/// Side of what is drawn of a block, pixels.
pub const DRAWN: u32 = BLOCK + 2 * MARGIN;
/// Longest side of a map, pixels.
pub const MAX_SIDE: u32 = 1 << 18;

/// A north-up raster. Its edges are whole multiples of the pixel size, so that maps of one place at one pixel size lie on
/// the same grid.
pub struct Grid {
    crs: Crs,
    /// West edge, map metres.
    west: f64,
    /// North edge, map metres.
    north: f64,
    gsd: f64,
    columns: NonZeroU32,
    rows: NonZeroU32,
}

/// A rectangle of a grid's pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns, at most [`BLOCK`].
    pub width: u32,
    /// Rows, at most [`BLOCK`].
    pub height: u32,
}

/// A block as it is drawn: `DRAWN` × `DRAWN` pixels, of which the block's begin at `MARGIN`; those outside of the map are included.
#[derive(Clone, Copy, Debug)]
pub struct BlockView {
    /// The camera.
    pub view: OrthographicView,
    /// Height of the camera's plane on the map's vertical scale: depth is counted down from it.
    pub top_m: f64,
}

impl Grid {
    /// The raster of pixels of `gsd` metres that covers `bounds` (lowest and highest easting and northing, map metres).
    ///
    /// # Errors
    /// [`OrthoError::Request`] for bounds that hold nothing, a pixel size that is none, and too many pixels.
    pub fn new(crs: Crs, bounds: [DVec2; 2], gsd: f64) -> Result<Self, OrthoError> {
        let refused = |what: String| Err(OrthoError::Request(what));
        if !(gsd.is_finite() && gsd > 0.0) {
            return refused(format!("a pixel of {gsd} m; it must be positive"));
        }
        let [low, high] = bounds;
        if !(low.is_finite() && high.is_finite() && low.x < high.x && low.y < high.y) {
            let of = |p: DVec2| format!("{:.1}, {:.1}", p.x, p.y);
            return refused(format!("the bounds {} to {} hold no ground", of(low), of(high)));
        }
        let (first, last) = ((low / gsd).floor(), (high / gsd).ceil());
        let size = last - first;
        let most = f64::from(MAX_SIDE);
        let side = |n: f64| NonZeroU32::new(n as u32).filter(|_| n <= most);
        let (Some(columns), Some(rows)) = (side(size.x), side(size.y)) else {
            return refused(format!(
                "{:.0} × {:.0} pixels of {gsd} m are more than {MAX_SIDE} on a side; take larger pixels or smaller bounds",
                size.x, size.y
            ));
        };
        Ok(Self { crs, west: first.x * gsd, north: last.y * gsd, gsd, columns, rows })
    }

    /// Its reference system.
    pub fn crs(&self) -> &Crs {
        &self.crs
    }

    /// Columns and rows.
    pub fn size(&self) -> [u32; 2] {
        [self.columns.get(), self.rows.get()]
    }

    /// Side of a pixel, map metres.
    pub fn gsd(&self) -> f64 {
        self.gsd
    }

    /// Easting of the west edge and northing of the north edge, map metres.
    pub fn corner(&self) -> [f64; 2] {
        [self.west, self.north]
    }

    /// Lower and upper corner of the ground it covers, model metres east and north.
    ///
    /// # Errors
    /// [`OrthoError::Outside`] where the projection has no answer.
    pub fn bounds(&self) -> Result<[DVec2; 2], OrthoError> {
        let [columns, rows] = self.size().map(f64::from);
        let mut bounds = [DVec2::INFINITY, DVec2::NEG_INFINITY];
        let ground = self.crs.to_map(DVec3::ZERO)?.z;
        for corner in [(0.0, 0.0), (columns, 0.0), (0.0, rows), (columns, rows)] {
            let at = self.crs.to_enu(self.place(corner.into()).extend(ground))?.truncate();
            bounds = [bounds[0].min(at), bounds[1].max(at)];
        }
        Ok(bounds)
    }

    /// All blocks, row by row from the north.
    pub fn blocks(&self) -> impl Iterator<Item = Block> + use<> {
        let [columns, rows] = self.size();
        let starts = move |n: u32| (0..n.div_ceil(BLOCK)).map(|i| i * BLOCK);
        starts(rows).flat_map(move |y| {
            starts(columns).map(move |x| Block { x, y, width: BLOCK.min(columns - x), height: BLOCK.min(rows - y) })
        })
    }

    /// Easting and northing of a pixel position (0.5, 0.5 is the middle of the north-western pixel).
    pub fn place(&self, pixel: DVec2) -> DVec2 {
        DVec2::new(self.west + pixel.x * self.gsd, self.north - pixel.y * self.gsd)
    }

    /// Pixel position of a map place.
    pub fn pixel(&self, place: DVec2) -> DVec2 {
        DVec2::new(place.x - self.west, self.north - place.y) / self.gsd
    }

    /// How a block is seen from `up` metres above the model's origin.
    ///
    /// The view looks along the vertical of the block's own middle, and its axes are the map's there (meridian convergence
    /// and scale of the projection included). Within a block the map is taken as affine and the Earth as flat: at pixels of
    /// 0.1 m that is wrong by less than 0.3 mm.
    ///
    /// # Errors
    /// [`OrthoError::Outside`] where the reference system ends.
    pub fn look(&self, block: Block, up: f64) -> Result<BlockView, OrthoError> {
        let half = 0.5 * f64::from(BLOCK);
        let middle = self.place(DVec2::new(f64::from(block.x) + half, f64::from(block.y) + half));
        // Twice, for the height on the map's scale of a plane that is given in the model's.
        let height = self.crs.to_map(self.crs.to_enu(middle.extend(up))?.with_z(up))?.z;
        let center = self.crs.to_enu(middle.extend(height))?;
        let reach = half * self.gsd;
        let along = |step: DVec2| -> Result<DVec3, OrthoError> {
            let ahead = self.crs.to_enu((middle + step).extend(height))?;
            Ok((ahead - self.crs.to_enu((middle - step).extend(height))?) / (2.0 * half))
        };
        let (east, south) = (along(DVec2::new(reach, 0.0))?, along(DVec2::new(0.0, -reach))?);
        let x = east.normalize();
        let y = (south - south.dot(x) * x).normalize();
        let rotation = DQuat::from_mat3(&DMat3::from_cols(x, y, x.cross(y)));
        let view = OrthographicView {
            width: DRAWN,
            height: DRAWN,
            pixels_per_metre: [1.0 / east.length(), 1.0 / south.length()],
            pose: Pose { rotation, center },
        };
        Ok(BlockView { view, top_m: height })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::geodesy::Geodetic;

    fn sheffield() -> Crs {
        Crs::utm(Geodetic { lat_deg: 53.38, lon_deg: -1.47, alt_m: 60.0 }).unwrap()
    }

    fn grid(crs: Crs, gsd: f64) -> Grid {
        let middle = crs.to_map(DVec3::new(40.0, -700.0, 0.0)).unwrap().truncate();
        Grid::new(crs, [middle - 150.0, middle + DVec2::new(210.0, 90.0)], gsd).unwrap()
    }

    #[test]
    fn blocks_cover_every_pixel_once() {
        let grid = grid(Crs::local(), 0.25);
        let [columns, rows] = grid.size();
        assert_eq!([columns, rows], [1440, 960]);
        let mut seen = vec![0u8; (columns * rows) as usize];
        for b in grid.blocks() {
            for y in b.y..b.y + b.height {
                (b.x..b.x + b.width).for_each(|x| seen[(y * columns + x) as usize] += 1);
            }
        }
        assert!(seen.iter().all(|n| *n == 1));
    }

    #[test]
    fn a_block_shows_each_point_in_the_pixel_that_the_projection_says() {
        let up = 55.0;
        let grid = grid(sheffield(), 0.1);
        let mut worst = 0.0f64;
        for block in grid.blocks() {
            let BlockView { view, top_m } = grid.look(block, up).unwrap();
            for (u, v, z) in [(3.0, 500.0, 0.0), (511.5, 0.5, 30.0), (200.0, 300.0, -12.0)] {
                let pixel = DVec2::new(f64::from(block.x) + u, f64::from(block.y) + v);
                let world = grid.crs().to_enu(grid.place(pixel).extend(60.0 + z)).unwrap();
                let c = view.pose.rotation.conjugate() * (world - view.pose.center);
                let drawn =
                    [0, 1].map(|k| c[k] * view.pixels_per_metre[k] + f64::from(DRAWN) / 2.0 - f64::from(MARGIN));
                worst = worst.max((drawn[0] - u).abs()).max((drawn[1] - v).abs());
                assert!((top_m - c.z - (60.0 + z)).abs() < 1e-3, "height {} of {}", top_m - c.z, 60.0 + z);
            }
            assert!((view.pose.center.z - up).abs() < 1e-3);
        }
        assert!(worst < 3e-3, "{worst} pixels");
    }

    #[test]
    fn maps_of_one_place_share_their_grid() {
        let (a, b) = (grid(sheffield(), 0.1), grid(sheffield(), 0.1));
        let low = a.place(DVec2::new(7.3, 400.2));
        let c = Grid::new(sheffield(), [low, low + 50.0], 0.1).unwrap();
        let shift = b.pixel(DVec2::from(c.corner()));
        assert!((shift - shift.round()).length() < 1e-4, "{shift}");
    }

    #[test]
    fn what_makes_no_map_is_refused() {
        let (low, high) = (DVec2::ZERO, DVec2::splat(10.0));
        for (bounds, gsd) in [
            ([low, high], 0.0),
            ([low, high], f64::NAN),
            ([low, high], 1e-6),
            ([high, low], 1.0),
            ([low, low], 1.0),
            ([low, DVec2::new(f64::INFINITY, 1.0)], 1.0),
            ([DVec2::NAN, high], 1.0),
        ] {
            assert!(matches!(Grid::new(Crs::local(), bounds, gsd), Err(OrthoError::Request(_))), "{bounds:?} {gsd}");
        }
    }
}

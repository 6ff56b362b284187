//! Heights of a part of a map, in memory.

use std::path::{Path, PathBuf};

use geometry::geodesy::EnuFrame;
use glam::DVec2;
use models::formats::FormatError;
use survey::coordinates::Reference;
use survey::ortho::height_raster::Raster;

use crate::MeasureError;

/// Pixels held at most where little else is: a gigabyte of them.
pub const MOST_PIXELS: u64 = 1 << 28;

/// A map may stretch lengths by this much: UTM does by a thousandth.
const MOST_STRETCH: f64 = 0.002;

/// Heights in rows from north to south, metres. A pixel is an area; its height is that of its middle.
#[derive(Clone, Debug, PartialEq)]
pub struct Heights {
    /// Map coordinates of the north-western corner.
    corner: DVec2,
    /// Step from a pixel to the next: east, and south (negative).
    pixel: DVec2,
    size: [usize; 2],
    /// NaN where there is no height.
    values: Vec<f32>,
}

/// A height between pixels, and the weights of those.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Around {
    pub height: f64,
    pub pixels: [([usize; 2], f64); 4],
}

/// A map of heights on disk.
pub struct HeightMap {
    path: PathBuf,
    raster: Raster,
}

impl HeightMap {
    /// Opens a GeoTIFF of one channel.
    ///
    /// # Errors
    /// It cannot be read, does not say where it lies, or a metre of it is none on the ground.
    pub fn open(path: &Path) -> Result<Self, MeasureError> {
        let map = Self { path: path.to_owned(), raster: Raster::open(path)? };
        if let Some(code) = map.epsg() {
            let bad = |what: String| FormatError::invalid(path, what);
            let [low, high] = map.bounds();
            let stretch = stretch(code, low.midpoint(high)).map_err(bad)?;
            if (stretch - 1.0).abs() > MOST_STRETCH {
                return Err(bad(format!(
                    "a unit of EPSG:{code} is {stretch:.3} m on the ground here; gdalwarp -t_srs with the place's UTM zone brings it into metres"
                ))
                .into());
            }
        }
        Ok(map)
    }

    /// The standard deviations of its heights: `NAME_sigma.tif` beside `NAME.tif`, as a map of ours has them. `None` where there is none.
    ///
    /// # Errors
    /// It cannot be read, or its pixels are not those of the heights.
    pub fn sigmas(&self) -> Result<Option<Self>, MeasureError> {
        let Some(name) = self.path.file_stem() else { return Ok(None) };
        let beside = self.path.with_file_name(format!("{}_sigma.tif", name.to_string_lossy()));
        if !beside.is_file() {
            return Ok(None);
        }
        let sigmas = Self::open(&beside)?;
        let pixels = |map: &Self| (map.raster.place(), map.raster.size(), map.epsg());
        match pixels(&sigmas) == pixels(self) {
            true => Ok(Some(sigmas)),
            false => Err(FormatError::invalid(
                &beside,
                format!("its pixels are not those of {}; draw the map again, or move it away", self.path.display()),
            )
            .into()),
        }
    }

    /// EPSG code of its reference system; `None`: metres of its own.
    pub fn epsg(&self) -> Option<u16> {
        self.raster.epsg()
    }

    /// Side of a pixel, metres: the mean of both.
    pub fn gsd(&self) -> f64 {
        let (_, pixel) = self.raster.place();
        (pixel.x * -pixel.y).sqrt()
    }

    /// The lower and the upper corner of all of it.
    pub fn bounds(&self) -> [DVec2; 2] {
        let (corner, pixel) = self.raster.place();
        let [w, h] = self.raster.size().map(f64::from);
        let other = corner + DVec2::new(w, h) * pixel;
        [corner.min(other), corner.max(other)]
    }

    /// The lower and the upper corner of what another map holds, too; `None` where it holds nothing of it.
    pub fn common(&self, other: &Self) -> Option<[DVec2; 2]> {
        let ([a, b], [c, d]) = (self.bounds(), other.bounds());
        let (low, high) = (a.max(c), b.min(d));
        low.cmplt(high).all().then_some([low, high])
    }

    /// Reads the part within `bounds` (lower and upper corner, map coordinates), of at most so many pixels; `None` where the map holds
    /// nothing of it.
    ///
    /// # Errors
    /// It cannot be read, or the part is larger than is held in memory.
    pub fn part(&mut self, [low, high]: [DVec2; 2], most_pixels: u64) -> Result<Option<Heights>, MeasureError> {
        let (corner, pixel) = self.raster.place();
        let size = self.raster.size();
        let [a, b] = [low, high].map(|p| (p - corner) / pixel);
        let range = |k: usize| {
            let [from, to] = [a.min(b)[k].floor(), a.max(b)[k].ceil()].map(|p| p.clamp(0.0, f64::from(size[k])));
            from as u32..to as u32
        };
        let window = [range(0), range(1)];
        let [w, h] = [0, 1].map(|k| (window[k].end - window[k].start) as usize);
        if w == 0 || h == 0 {
            return Ok(None);
        }
        if w as u64 * h as u64 > most_pixels {
            return Err(MeasureError::Request(format!(
                "{}: {w} × {h} pixels are more than are measured at once ({most_pixels}); draw smaller areas or a coarser map",
                self.path.display()
            )));
        }
        let from = DVec2::new(f64::from(window[0].start), f64::from(window[1].start));
        let mut values = vec![f32::NAN; w * h];
        let [x0, y0] = [window[0].start, window[1].start];
        self.raster.each(window, 1, |[x, y], z| values[(y - y0) as usize * w + (x - x0) as usize] = z as f32)?;
        Ok(Some(Heights { corner: corner + from * pixel, pixel, size: [w, h], values }))
    }
}

/// Metres on the ground to a unit of a reference system, at a place: the root of how it stretches areas.
fn stretch(code: u16, place: DVec2) -> Result<f64, String> {
    const STEP: f64 = 10.0;
    let reference = Reference::named(&format!("EPSG:{code}")).ok_or("names no reference system")??;
    let outside = || format!("lies outside of EPSG:{code}");
    let ground = |p: DVec2| reference.geodetic(p.extend(0.0)).ok_or_else(outside);
    let frame = EnuFrame::new(ground(place)?);
    let east = frame.to_enu(ground(place + STEP * DVec2::X)?).truncate();
    let north = frame.to_enu(ground(place + STEP * DVec2::Y)?).truncate();
    Ok(east.perp_dot(north).abs().sqrt() / STEP)
}

impl Heights {
    /// Of `values` in rows from north to south; `gsd` is the side of a pixel. `None` where their number is not that of the pixels.
    pub fn new(corner: DVec2, gsd: f64, size: [usize; 2], values: Vec<f32>) -> Option<Self> {
        let pixel = DVec2::new(gsd, -gsd);
        (values.len() == size[0] * size[1]).then_some(Self { corner, pixel, size, values })
    }

    /// All heights, higher by `by` metres.
    pub fn lifted(mut self, by: f64) -> Self {
        self.values.iter_mut().for_each(|z| *z += by as f32);
        self
    }

    /// Columns and rows.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// Side of a pixel, metres: the mean of both.
    pub fn gsd(&self) -> f64 {
        self.pixel_m2().sqrt()
    }

    /// Area of a pixel, m².
    pub fn pixel_m2(&self) -> f64 {
        self.pixel.x * -self.pixel.y
    }

    /// The height of a pixel.
    pub fn at(&self, x: usize, y: usize) -> Option<f64> {
        let inside = x < self.size[0] && y < self.size[1];
        inside.then(|| f64::from(self.values[y * self.size[0] + x])).filter(|z| z.is_finite())
    }

    /// Map coordinates of a place in pixels; a pixel's middle is at one half.
    pub fn place(&self, pixel: DVec2) -> DVec2 {
        self.corner + pixel * self.pixel
    }

    /// Map coordinates of the north-western corner, and the sides of a pixel, metres.
    pub(crate) fn corner(&self) -> (DVec2, DVec2) {
        (self.corner, self.pixel.abs())
    }

    /// A place in pixels.
    pub fn pixel(&self, place: DVec2) -> DVec2 {
        (place - self.corner) / self.pixel
    }

    /// The height at a place, between the four pixels around it; where one of them has none, the mean of those that have one, and
    /// `None` where none has.
    pub fn height(&self, place: DVec2) -> Option<f64> {
        self.around(place).map(|around| around.height)
    }

    /// The height at a place, and the pixels that it is a mean of.
    pub(crate) fn around(&self, place: DVec2) -> Option<Around> {
        let at = self.pixel(place) - 0.5;
        let (from, part) = (at.floor(), at - at.floor());
        let mut around = Around { height: 0.0, pixels: [([0; 2], 0.0); 4] };
        let mut weights = 0.0;
        for (k, (dx, dy)) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)].into_iter().enumerate() {
            let p = from + DVec2::new(dx, dy);
            let weight: f64 = (1.0 - (part.x - dx).abs()) * (1.0 - (part.y - dy).abs());
            if p.x < 0.0 || p.y < 0.0 || weight <= 0.0 {
                continue;
            }
            let pixel = [p.x as usize, p.y as usize];
            if let Some(z) = self.at(pixel[0], pixel[1]) {
                around.height += weight * z;
                around.pixels[k] = (pixel, weight);
                weights += weight;
            }
        }
        around.height /= weights;
        around.pixels.iter_mut().for_each(|(_, weight)| *weight /= weights);
        (weights > 0.0).then_some(around)
    }

    /// Other heights on these pixels; their number is that of the pixels.
    pub(crate) fn with_values(&self, values: Vec<f32>) -> Self {
        debug_assert_eq!(values.len(), self.values.len());
        Self { values, ..*self }
    }

    /// Other heights on a grid that begins at a corner of this one's pixels. `None` where their number is not that of the pixels.
    pub(crate) fn part_of(&self, corner: DVec2, size: [usize; 2], values: Vec<f32>) -> Option<Self> {
        let corner = self.place(corner);
        (values.len() == size[0] * size[1]).then_some(Self { corner, pixel: self.pixel, size, values })
    }

    /// The mean heights of squares of `side` pixels; those that hold none have none.
    pub fn coarser(&self, side: usize) -> Self {
        let side = side.max(1);
        let size = self.size.map(|s| s / side);
        let mean = |i: usize| {
            let (x0, y0) = (i % size[0] * side, i / size[0] * side);
            let all = (y0..y0 + side).flat_map(|y| (x0..x0 + side).filter_map(move |x| self.at(x, y)));
            let (sum, count) = all.fold((0.0, 0.0), |(sum, count), z| (sum + z, count + 1.0));
            // Zero over zero is no height.
            (sum / count) as f32
        };
        let values = (0..size[0] * size[1]).map(mean).collect();
        Self { corner: self.corner, pixel: self.pixel * side as f64, size, values }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;

    #[test]
    fn a_metre_of_utm_is_one_and_a_metre_of_web_mercator_is_none() {
        let utm = stretch(32_632, DVec2::new(500_000.0, 5_205_000.0)).unwrap();
        assert!((utm - 1.0).abs() < 5e-4, "{utm}");
        // 47° north: the cosine of the latitude.
        let web = stretch(3857, DVec2::new(1_000_000.0, 5_942_074.0)).unwrap();
        assert!((web - 47f64.to_radians().cos()).abs() < 5e-3, "{web}");
        let feet = stretch(2263, DVec2::new(985_000.0, 200_000.0)).unwrap();
        assert!((feet - 0.3048).abs() < 1e-3, "{feet}");
        assert!(stretch(1, DVec2::ZERO).is_err());
    }

    #[test]
    fn a_height_lies_between_those_around_it_and_holes_are_left_out() {
        let h = Heights::new(DVec2::new(100.0, 50.0), 2.0, [3, 2], vec![1.0, 3.0, 5.0, 1.0, 3.0, f32::NAN]).unwrap();
        assert_eq!(h.place(DVec2::new(0.5, 0.5)), DVec2::new(101.0, 49.0));
        assert_eq!(h.height(DVec2::new(101.0, 49.0)), Some(1.0));
        assert_eq!(h.height(DVec2::new(102.0, 48.0)), Some(2.0));
        assert_eq!(h.height(DVec2::new(105.0, 47.0)), None, "the pixel has none, and nothing else has weight there");
        assert!((h.height(DVec2::new(104.0, 48.0)).unwrap() - 11.0 / 3.0).abs() < 1e-9);
        assert_eq!(h.height(DVec2::new(0.0, 0.0)), None);
        assert!(Heights::new(DVec2::ZERO, 1.0, [2, 2], vec![0.0; 3]).is_none());
    }
}

/// Maps for tests.
#[cfg(test)]
pub(crate) mod testing {
    /// Errors of a standard deviation `sigma` that agree within a box of `2·blur + 1` pixels.
    pub fn rough([w, h]: [usize; 2], blur: usize, sigma: f64, seed: u64) -> Vec<f32> {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let mut uniform = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let (pw, ph) = (w + 2 * blur, h + 2 * blur);
        // Twelve uniform numbers add up to a normal one.
        let white: Vec<f64> = (0..pw * ph).map(|_| (0..12).map(|_| uniform()).sum::<f64>() - 6.0).collect();
        let side = 2 * blur + 1;
        let at = |x: usize, y: usize| {
            let rows = (y..y + side).flat_map(|r| white[r * pw + x..r * pw + x + side].iter());
            sigma * rows.sum::<f64>() / side as f64
        };
        (0..w * h).map(|i| at(i % w, i / w) as f32).collect()
    }
}

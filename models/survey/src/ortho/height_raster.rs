//! Heights of a reference raster: a GeoTIFF of one channel (ours, a laser scan's, another program's surface model), read chunk by
//! chunk where the model's ground lies.

use std::fs::File;
use std::io::BufReader;
use std::ops::Range;
use std::path::{Path, PathBuf};

use geometry::geodesy::Geodetic;
use glam::{DVec2, DVec3};
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

use super::crs::Crs;
use models::formats::{FormatError, one_line};
use models::picture::tiff::fits_its_tags;

/// Points taken at most, evenly spread: the error of heights does not grow truer with more.
const MOST_POINTS: f64 = 262_144.0;
/// Bytes of a strip or tile that is decoded at once, as its file's: no more than deflate can make of them, and not more than 2,896²
/// heights of 8 bytes.
const MOST_INFLATED: u64 = 1032;
const MOST_CHUNK: u64 = 64 << 20;
/// GeoTIFF 1.1, keys and values: what coordinates are, what a pixel is, the projected system, and "defined by the user".
const MODEL_TYPE: u16 = 1024;
const IN_DEGREES: u16 = 2;
const AROUND_EARTHS_MIDDLE: u16 = 3;
const RASTER_TYPE: u16 = 1025;
const PIXEL_IS_POINT: u16 = 2;
const PROJECTED: u16 = 3072;
const USER_DEFINED: u16 = 32767;
/// Units of the plane and of heights, and the metre.
const LINEAR_UNITS: u16 = 3076;
const VERTICAL_UNITS: u16 = 4099;
const METRE: u16 = 9001;
/// Heights that no place on Earth has, metres: a value that stands for none, and the file does not say so.
const HEIGHTS: Range<f64> = -12_000.0..10_000.0;

/// Reads the raster's heights in the model's frame, those within `bounds` (lower and upper corner, metres east and north) alone.
/// `origin` is the model's; a raster of a model without one lies in the model's own metres.
///
/// # Errors
/// The file cannot be read, is no raster of heights, or does not say where it lies in a way that is understood.
pub fn read(path: &Path, origin: Option<Geodetic>, bounds: [DVec2; 2]) -> Result<Vec<DVec3>, FormatError> {
    let bad = |what: String| FormatError::invalid(path, what);
    let mut raster = Raster::open(path)?;
    let crs = match (raster.epsg(), origin) {
        (Some(code), Some(origin)) => Crs::projected(code, origin).map_err(|e| bad(e.to_string()))?,
        (None, None) => Crs::local(),
        (Some(_), None) => return Err(bad("says where on Earth it lies, and the model has no origin there".into())),
        (None, Some(_)) => {
            return Err(bad(
                "names no projected reference system by its EPSG code; gdalwarp -t_srs EPSG:… gives it one".into(),
            ));
        }
    };
    let Some(window) = raster.placed.window(&crs, bounds, raster.size) else { return Ok(Vec::new()) };
    let inside: f64 = window.iter().map(|range| f64::from(range.end - range.start)).product();
    let step = (inside / MOST_POINTS).sqrt().ceil().max(1.0) as u32;
    let placed = raster.placed;
    let mut points = Vec::new();
    raster.each(window, step, |[x, y], z| {
        let place = placed.place(f64::from(x) + 0.5, f64::from(y) + 0.5);
        points.extend(crs.to_enu(place.extend(z)).ok().filter(|p| within(p.truncate(), bounds)));
    })?;
    Ok(points)
}

/// A raster of heights that is open for reading, chunk by chunk.
pub struct Raster {
    path: PathBuf,
    decoder: Decoder<BufReader<File>>,
    size: [u32; 2],
    placed: Placement,
}

impl Raster {
    /// Opens a GeoTIFF of one channel.
    ///
    /// # Errors
    /// The file cannot be read, is no raster of heights, or does not say where it lies.
    pub fn open(path: &Path) -> Result<Self, FormatError> {
        let failed = |e: std::io::Error| FormatError::io(path, "reading", e);
        if !fits_its_tags(path).map_err(failed)? {
            return Err(FormatError::invalid(path, "is a damaged TIFF (a tag is larger than the file)"));
        }
        let file = disk::regular::open(path).map_err(failed)?;
        let most = MOST_CHUNK.min(MOST_INFLATED * file.metadata().map_err(failed)?.len()) as usize;
        let mut limits = Limits::default();
        (limits.decoding_buffer_size, limits.intermediate_buffer_size) = (most, most);
        let damaged = |e| damaged(path, e);
        let mut decoder = Decoder::new(BufReader::new(file)).map_err(damaged)?.with_limits(limits);
        let (width, height) = decoder.dimensions().map_err(damaged)?;
        if decoder.colortype().map_err(damaged)?.num_samples() != 1 {
            return Err(FormatError::invalid(path, "has more than one channel; heights have one"));
        }
        let placed = Placement::read(&mut decoder, path)?;
        Ok(Self { path: path.to_owned(), decoder, size: [width, height], placed })
    }

    /// EPSG code of the projected reference system that it names.
    pub fn epsg(&self) -> Option<u16> {
        self.placed.epsg
    }

    /// Columns and rows.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// Map coordinates of the north-western corner, and the step from a pixel to the next: east, and south (negative).
    pub fn place(&self) -> (DVec2, DVec2) {
        (self.placed.corner, self.placed.pixel)
    }

    /// Gives the heights of every `step`-th column and row of a window, chunk by chunk; pixels without one are left out.
    ///
    /// # Errors
    /// The file cannot be read, is damaged, or stores what heights are not stored in.
    pub fn each(
        &mut self,
        [columns, rows]: [Range<u32>; 2],
        step: u32,
        mut take: impl FnMut([u32; 2], f64),
    ) -> Result<(), FormatError> {
        let (chunk_width, chunk_height) = self.decoder.chunk_dimensions();
        let (chunk_width, chunk_height) = (chunk_width.max(1), chunk_height.max(1));
        let across = self.size[0].div_ceil(chunk_width);
        for chunk_row in rows.start / chunk_height..rows.end.div_ceil(chunk_height) {
            for chunk_column in columns.start / chunk_width..columns.end.div_ceil(chunk_width) {
                let index = chunk_row * across + chunk_column;
                let (w, h) = self.decoder.chunk_data_dimensions(index);
                let chunk = self.decoder.read_chunk(index).map_err(|e| damaged(&self.path, e))?;
                let values = Values::of(chunk).ok_or_else(|| {
                    FormatError::invalid(&self.path, "its numbers are of a kind that heights are not stored in")
                })?;
                let (x0, y0) = (chunk_column * chunk_width, chunk_row * chunk_height);
                for y in (y0..y0 + h).filter(|y| rows.contains(y) && y % step == 0) {
                    for x in (x0..x0 + w).filter(|x| columns.contains(x) && x % step == 0) {
                        let at = (y - y0) as usize * w as usize + (x - x0) as usize;
                        let Some(z) = values.at(at).filter(|z| z.is_finite() && Some(*z) != self.placed.nothing) else {
                            continue;
                        };
                        if !HEIGHTS.contains(&z) {
                            let what =
                                format!("holds heights of {z} m; gdal_edit -a_nodata {z} says that they are none");
                            return Err(FormatError::invalid(&self.path, what));
                        }
                        take([x, y], z);
                    }
                }
            }
        }
        Ok(())
    }
}

fn damaged(path: &Path, e: tiff::TiffError) -> FormatError {
    FormatError::invalid(path, format!("no raster of heights ({})", one_line(e)))
}

fn within(p: DVec2, [low, high]: [DVec2; 2]) -> bool {
    p.cmpge(low).all() && p.cmple(high).all()
}

/// Where the pixels lie.
#[derive(Clone, Copy)]
struct Placement {
    epsg: Option<u16>,
    /// Map coordinates of the upper left corner of the first pixel, and from a pixel to the next, rows going down.
    corner: DVec2,
    pixel: DVec2,
    /// The height that stands for none.
    nothing: Option<f64>,
}

impl Placement {
    fn read(raster: &mut Decoder<BufReader<File>>, path: &Path) -> Result<Self, FormatError> {
        let bad = |what: &str| FormatError::invalid(path, what.to_owned());
        let numbers = |raster: &mut Decoder<_>, tag| raster.get_tag_f64_vec(tag).unwrap_or_default();
        let scale = numbers(raster, Tag::ModelPixelScaleTag);
        let tie = numbers(raster, Tag::ModelTiepointTag);
        let (&[sx, sy, ..], &[u, v, _, east, north, ..]) = (scale.as_slice(), tie.as_slice()) else {
            return Err(bad(
                "does not say where it lies by a corner and the size of a pixel (GeoTIFF); gdal_translate does",
            ));
        };
        let pixel = DVec2::new(sx, -sy);
        let corner = DVec2::new(east, north) - DVec2::new(u, v) * pixel;
        if !(corner.is_finite() && sx.is_finite() && sy.is_finite() && sx > 0.0 && sy > 0.0) {
            return Err(bad("its corner or the size of its pixels is no number to work with"));
        }
        let keys = raster.get_tag_u16_vec(Tag::GeoKeyDirectoryTag).unwrap_or_default();
        // Four words of a head, then four of each key: its number, where its value is (0: here), how many, the value.
        let key = |id: u16| keys.as_chunks::<4>().0.iter().skip(1).find(|k| k[0] == id && k[1] == 0).map(|k| k[3]);
        match key(MODEL_TYPE) {
            Some(IN_DEGREES) => return Err(bad("is in degrees; gdalwarp -t_srs EPSG:… brings it into metres")),
            Some(AROUND_EARTHS_MIDDLE) => {
                return Err(bad("is geocentric; gdalwarp -t_srs EPSG:… brings it into a plane"));
            }
            _ => {}
        }
        if [LINEAR_UNITS, VERTICAL_UNITS].iter().any(|id| key(*id).is_some_and(|unit| unit != METRE)) {
            return Err(bad(
                "its plane or its heights are not in metres; gdalwarp -t_srs EPSG:… and gdal_calc make them so",
            ));
        }
        let half = if key(RASTER_TYPE) == Some(PIXEL_IS_POINT) { 0.5 } else { 0.0 };
        let nothing = raster.get_tag_ascii_string(Tag::GdalNodata).ok();
        Ok(Self {
            epsg: key(PROJECTED).filter(|code| *code != USER_DEFINED),
            corner: corner - half * pixel,
            pixel,
            nothing: nothing.and_then(|text| text.trim_matches(['\0', ' ']).parse().ok()),
        })
    }

    fn place(&self, x: f64, y: f64) -> DVec2 {
        self.corner + DVec2::new(x, y) * self.pixel
    }

    /// Columns and rows that may lie within `bounds`; `None` where none do.
    fn window(&self, crs: &Crs, [low, high]: [DVec2; 2], size: [u32; 2]) -> Option<[Range<u32>; 2]> {
        let corners = [low, high, DVec2::new(low.x, high.y), DVec2::new(high.x, low.y)];
        let mut pixels = [DVec2::INFINITY, DVec2::NEG_INFINITY];
        for corner in corners {
            let at = (crs.to_map(corner.extend(0.0)).ok()?.truncate() - self.corner) / self.pixel;
            pixels = [pixels[0].min(at), pixels[1].max(at)];
        }
        let range = |k: usize| {
            let [from, to] = [pixels[0][k] - 1.0, pixels[1][k] + 1.0].map(|p| p.clamp(0.0, f64::from(size[k])));
            let range = from.floor() as u32..to.ceil() as u32;
            (!range.is_empty()).then_some(range)
        };
        Some([range(0)?, range(1)?])
    }
}

/// Heights as they are stored.
enum Values {
    F64(Vec<f64>),
    F32(Vec<f32>),
    I32(Vec<i32>),
    I16(Vec<i16>),
    U16(Vec<u16>),
}

impl Values {
    fn of(decoded: DecodingResult) -> Option<Self> {
        match decoded {
            DecodingResult::F64(v) => Some(Self::F64(v)),
            DecodingResult::F32(v) => Some(Self::F32(v)),
            DecodingResult::I32(v) => Some(Self::I32(v)),
            DecodingResult::I16(v) => Some(Self::I16(v)),
            DecodingResult::U16(v) => Some(Self::U16(v)),
            _ => None,
        }
    }

    fn at(&self, i: usize) -> Option<f64> {
        match self {
            Self::F64(v) => v.get(i).copied(),
            Self::F32(v) => v.get(i).copied().map(f64::from),
            Self::I32(v) => v.get(i).copied().map(f64::from),
            Self::I16(v) => v.get(i).copied().map(f64::from),
            Self::U16(v) => v.get(i).copied().map(f64::from),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use tiff::encoder::TiffEncoder;
    use tiff::encoder::colortype::{ColorType, Gray32Float, GrayI16, RGB8};

    use super::*;

    const EVERYWHERE: [DVec2; 2] = [DVec2::splat(-1e6), DVec2::splat(1e6)];

    /// Pixels of 2 m whose first corner lies at 100, 50.
    fn raster<C: ColorType>(folder: &Path, size: [u32; 2], values: &[C::Inner], is_point: bool) -> PathBuf
    where
        [C::Inner]: tiff::encoder::TiffValue,
    {
        let path = folder.join("reference.tif");
        let mut file = TiffEncoder::new(File::create(&path).unwrap()).unwrap();
        let mut image = file.new_image::<C>(size[0], size[1]).unwrap();
        image.encoder().write_tag(Tag::ModelPixelScaleTag, &[2.0, 2.0, 0.0][..]).unwrap();
        image.encoder().write_tag(Tag::ModelTiepointTag, &[0.0, 0.0, 0.0, 100.0, 50.0, 0.0][..]).unwrap();
        image.encoder().write_tag(Tag::GdalNodata, "-32768").unwrap();
        let kind = 1 + u16::from(is_point);
        image.encoder().write_tag(Tag::GeoKeyDirectoryTag, &[1u16, 1, 0, 1, RASTER_TYPE, 0, 1, kind][..]).unwrap();
        image.write_data(values).unwrap();
        path
    }

    #[test]
    fn whole_numbers_and_fractions_are_read_where_they_lie_and_nothing_where_nothing_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = raster::<GrayI16>(folder.path(), [2, 2], &[7, -32768, -3, 12], false);
        let points = read(&path, None, EVERYWHERE).unwrap();
        let expected = [[101.0, 49.0, 7.0], [101.0, 47.0, -3.0], [103.0, 47.0, 12.0]].map(DVec3::from);
        assert_eq!(points, expected);
        let inside = [DVec2::new(100.0, 40.0), DVec2::new(102.0, 48.0)];
        assert_eq!(read(&path, None, inside).unwrap(), [expected[1]]);
        assert_eq!(read(&path, None, [DVec2::splat(500.0), DVec2::splat(600.0)]).unwrap(), []);
        let path = raster::<Gray32Float>(folder.path(), [2, 1], &[7.25, f32::NAN], true);
        assert_eq!(read(&path, None, EVERYWHERE).unwrap(), [DVec3::new(100.0, 50.0, 7.25)]);
    }

    #[test]
    fn degrees_feet_and_heights_of_no_place_on_earth_are_refused_in_one_line() {
        let folder = tempfile::tempdir().unwrap();
        let write = |keys: &[[u16; 4]], value: i16| {
            let path = folder.path().join("reference.tif");
            let mut file = TiffEncoder::new(File::create(&path).unwrap()).unwrap();
            let mut image = file.new_image::<GrayI16>(2, 2).unwrap();
            image.encoder().write_tag(Tag::ModelPixelScaleTag, &[2.0, 2.0, 0.0][..]).unwrap();
            image.encoder().write_tag(Tag::ModelTiepointTag, &[0.0, 0.0, 0.0, 100.0, 50.0, 0.0][..]).unwrap();
            let head = [1, 1, 0, keys.len() as u16];
            let keys: Vec<u16> = head.into_iter().chain(keys.iter().flatten().copied()).collect();
            image.encoder().write_tag(Tag::GeoKeyDirectoryTag, &keys[..]).unwrap();
            image.write_data(&[7, 8, value, 9]).unwrap();
            path
        };
        for (keys, value, word) in [
            (&[[MODEL_TYPE, 0, 1, IN_DEGREES]][..], 7, "in degrees"),
            (&[[MODEL_TYPE, 0, 1, 3]][..], 7, "geocentric"),
            (&[[LINEAR_UNITS, 0, 1, 9003]][..], 7, "not in metres"),
            (&[[VERTICAL_UNITS, 0, 1, 9002]][..], 7, "not in metres"),
            (&[[MODEL_TYPE, 0, 1, 1], [LINEAR_UNITS, 0, 1, METRE]][..], -32767, "gdal_edit -a_nodata -32767"),
        ] {
            let said = read(&write(keys, value), None, EVERYWHERE).unwrap_err().to_string();
            assert!(said.contains(word) && !said.contains('\n'), "{said}");
        }
        assert_eq!(read(&write(&[[MODEL_TYPE, 0, 1, 1]], 7), None, EVERYWHERE).unwrap().len(), 4);
    }

    #[test]
    fn a_large_raster_is_thinned_out_evenly() {
        let folder = tempfile::tempdir().unwrap();
        let values: Vec<i16> = (0..1500 * 1000).map(|i| (i % 1500) as i16).collect();
        let path = raster::<GrayI16>(folder.path(), [1500, 1000], &values, false);
        let points = read(&path, None, EVERYWHERE).unwrap();
        assert!((100_000..=262_144).contains(&points.len()), "{}", points.len());
        assert!(points.iter().all(|p| (p.x - 101.0) / 2.0 == p.z));
        assert!(points.iter().any(|p| p.x > 3000.0 && p.y < -1900.0));
    }

    #[test]
    fn what_is_no_raster_of_heights_or_lies_nowhere_is_refused_in_one_line() {
        let folder = tempfile::tempdir().unwrap();
        let origin = Geodetic { lat_deg: 53.38, lon_deg: -1.47, alt_m: 60.0 };
        let refused = |path: &Path, origin: Option<Geodetic>, word: &str| {
            let said = read(path, origin, EVERYWHERE).unwrap_err().to_string();
            assert!(said.contains(word) && !said.contains('\n'), "{said}");
        };
        let path = raster::<RGB8>(folder.path(), [1, 1], &[1, 2, 3], false);
        refused(&path, None, "more than one channel");
        let path = raster::<GrayI16>(folder.path(), [40, 40], &[7; 1600], false);
        refused(&path, Some(origin), "EPSG");
        let whole = std::fs::read(&path).unwrap();
        std::fs::write(&path, &whole[..300]).unwrap();
        refused(&path, None, "reference.tif");
        std::fs::write(&path, b"no TIFF").unwrap();
        refused(&path, None, "no raster of heights");
        refused(&folder.path().join("missing.tif"), None, "missing.tif");
        image::GrayImage::new(4, 4).save(&path).unwrap();
        refused(&path, None, "does not say where it lies");
    }
}

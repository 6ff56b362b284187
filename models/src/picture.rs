//! Pictures from files: decoded once, at the smallest size that serves, the right way up, with bounds on what a file may
//! make us allocate.
//!
//! JPEG is scaled while it is decoded (each 8×8 block becomes 4×4, 2×2 or 1×1 pixels) by `jpeg-decoder`: a 12-megapixel
//! picture at quarter size costs a few megabytes, no full-size picture ever exists, and nothing but Rust is needed to build
//! it. (libjpeg-turbo is faster yet, but its crates want cmake and an assembler, which a board's two commands do not bring.)

pub mod crops;
mod mask;
pub mod tiff;
pub mod values;
pub mod webp;

use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use geometry::lens::Distortion;
use glam::DQuat;
use image::{DynamicImage, ImageFormat, ImageReader, Limits, RgbImage, imageops};
use jpeg_decoder::{Decoder, PixelFormat};

use crate::formats::reconstruction::{Focal, LensDescription};
use crate::formats::{one_line, shown};
use crate::mask::Mask;
use values::ValueRange;

/// Largest picture edge taken; 16384² × 3 bytes is also what a decoder may allocate at most.
const MAX_EDGE: u32 = 16_384;

/// Largest JPEG file taken, bytes: 16,384² pixels of a byte each, more than any camera writes.
const MAX_FILE: u64 = 256 << 20;

/// How a stored picture is turned to have the camera's top at its top (EXIF tag 274): mirrored first, then turned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Orientation {
    mirrored: bool,
    /// Quarter turns clockwise.
    turns: u8,
}

impl Orientation {
    /// EXIF's number; what is no number of EXIF's leaves the picture as it is.
    pub fn from_exif(tag: u32) -> Self {
        let (mirrored, turns) = match tag {
            2 => (true, 0),
            3 => (false, 2),
            4 => (true, 2),
            5 => (true, 3),
            6 => (false, 1),
            7 => (true, 1),
            8 => (false, 3),
            _ => (false, 0),
        };
        Self { mirrored, turns }
    }

    /// True when width and height change places.
    pub fn swaps(&self) -> bool {
        self.turns % 2 == 1
    }

    /// What leads back from the turned picture to the stored one.
    pub fn inverse(&self) -> Self {
        // A mirrored picture turned one way is the mirror image of one turned the other.
        Self { turns: if self.mirrored { self.turns } else { (4 - self.turns) % 4 }, ..*self }
    }

    /// The picture the right way up.
    pub fn apply(&self, image: RgbImage) -> RgbImage {
        let image = if self.mirrored { imageops::flip_horizontal(&image) } else { image };
        match self.turns {
            1 => imageops::rotate90(&image),
            2 => imageops::rotate180(&image),
            3 => imageops::rotate270(&image),
            _ => image,
        }
    }

    /// Where a place of the turned picture lies in the stored one, both as shares of width and height.
    pub fn stored_place(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        let [x, y] = match self.turns {
            1 => [v, 1.0 - u],
            2 => [1.0 - u, 1.0 - v],
            3 => [1.0 - v, u],
            _ => [u, v],
        };
        [if self.mirrored { 1.0 - x } else { x }, y]
    }

    /// Rotation camera → world of the camera whose top is the turned picture's.
    pub fn of_rotation(&self, rotation: DQuat) -> DQuat {
        (rotation * DQuat::from_rotation_z(-f64::from(self.turns) * std::f64::consts::FRAC_PI_2)).normalize()
    }

    /// The lens as the turned picture shows it.
    pub fn of_lens(&self, stored: &LensDescription) -> LensDescription {
        let mut lens = *stored;
        let d = &mut lens.distortion;
        // Tangential and prism terms are vectors (p2, p1) and (sx1, sy1) in the picture.
        let turn = |(x, y): (f64, f64)| (-y, x);
        if self.mirrored {
            (d.p2, d.sx1) = (-d.p2, -d.sx1);
            if let (Some((cx, _)), Some((w, _))) = (&mut lens.principal, lens.size) {
                *cx = f64::from(w) - *cx;
            }
        }
        for _ in 0..self.turns {
            let d: &mut Distortion = &mut lens.distortion;
            (d.p2, d.p1) = turn((d.p2, d.p1));
            (d.sx1, d.sy1) = turn((d.sx1, d.sy1));
            if let Focal::Pixels(fx, fy) = lens.focal {
                lens.focal = Focal::Pixels(fy, fx);
            }
            if let (Some((cx, cy)), Some((_, h))) = (lens.principal, lens.size) {
                lens.principal = Some((f64::from(h) - cy, cx));
            }
            lens.size = lens.size.map(|(w, h)| (h, w));
        }
        lens
    }
}

/// A picture is missing, unreadable or not what its description says.
#[derive(Debug, thiserror::Error)]
#[error("{}: {what}", shown(path))]
pub struct PictureError {
    /// The picture.
    pub path: PathBuf,
    /// What is wrong.
    pub what: String,
}

fn bad(path: &Path, what: impl Into<String>) -> PictureError {
    PictureError { path: path.to_owned(), what: what.into() }
}

/// Width and height as stored, from the head of the file.
///
/// # Errors
/// As [`decode`].
pub fn dimensions(path: &Path) -> Result<(u32, u32), PictureError> {
    if let Some(decoder) = webp::open(path)? {
        return Ok(decoder.dimensions());
    }
    open(path)?.into_dimensions().map_err(|e| bad(path, format!("cannot be decoded ({})", one_line(e))))
}

fn open(path: &Path) -> Result<ImageReader<BufReader<File>>, PictureError> {
    let failed = |e: std::io::Error| bad(path, format!("cannot be opened ({e}); is the picture folder complete?"));
    if !tiff::fits_its_tags(path).map_err(failed)? {
        return Err(bad(path, "is a damaged TIFF (a tag is larger than the file); copy it again"));
    }
    let file = disk::regular::open(path).map_err(failed)?;
    ImageReader::new(BufReader::new(file)).with_guessed_format().map_err(failed)
}

/// Bounds on what a decoder may allocate.
fn limits() -> Limits {
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_EDGE);
    limits.max_image_height = Some(MAX_EDGE);
    limits.max_alloc = Some(u64::from(MAX_EDGE) * u64::from(MAX_EDGE) * 3);
    limits
}

/// A JPEG, PNG, TIFF or WebP as 8-bit RGB, refused before decoding when it is too large.
///
/// # Errors
/// The file cannot be opened, is damaged, or is no picture.
pub fn decode(path: &Path) -> Result<RgbImage, PictureError> {
    decode_at_least(path, (u32::MAX, u32::MAX))
}

/// As [`decode`], at full size or a half, a quarter or an eighth of it: the smallest that is at least `wanted` in width and
/// height as stored, where the format allows it (JPEG).
///
/// # Errors
/// As [`decode`].
pub fn decode_at_least(path: &Path, wanted: (u32, u32)) -> Result<RgbImage, PictureError> {
    decode_shown(path, wanted, None).map(|(image, _)| image)
}

/// As [`decode_at_least`], with values of 16 bits shown in `range` (where it is given), and a mask of what is transparent, if anything is.
///
/// # Errors
/// As [`decode`].
pub fn decode_shown(
    path: &Path,
    wanted: (u32, u32),
    range: Option<ValueRange>,
) -> Result<(RgbImage, Option<Mask>), PictureError> {
    if let Some(bytes) = jpeg(path)? {
        let image = match scaled_jpeg(path, &bytes, wanted)? {
            Some(image) => image,
            None => {
                let mut reader = ImageReader::with_format(Cursor::new(bytes), ImageFormat::Jpeg);
                reader.limits(limits());
                reader.decode().map_err(|e| undecoded(path, e))?.into_rgb8()
            }
        };
        return Ok((image, None));
    }
    let image = decode_stored(path)?;
    let mask = match &image {
        DynamicImage::ImageRgba8(p) => transparent(p.dimensions(), |x, y| p.get_pixel(x, y).0[3] >= HALF),
        DynamicImage::ImageLumaA8(p) => transparent(p.dimensions(), |x, y| p.get_pixel(x, y).0[1] >= HALF),
        DynamicImage::ImageRgba16(p) => transparent(p.dimensions(), |x, y| p.get_pixel(x, y).0[3] >> 8 >= HALF.into()),
        DynamicImage::ImageLumaA16(p) => transparent(p.dimensions(), |x, y| p.get_pixel(x, y).0[1] >> 8 >= HALF.into()),
        _ => None,
    };
    let shown = range.unwrap_or(ValueRange::FULL).shown(&image);
    Ok((shown.unwrap_or_else(|| image.into_rgb8()), mask))
}

/// Pixels less opaque than this are left out.
const HALF: u8 = 128;

/// A mask of the pixels that are not `opaque`, where there is any.
fn transparent((width, height): (u32, u32), opaque: impl Fn(u32, u32) -> bool) -> Option<Mask> {
    let mask = Mask::from_fn(width, height, opaque);
    (mask.count() < width as usize * height as usize).then_some(mask)
}

fn undecoded(path: &Path, e: image::ImageError) -> PictureError {
    bad(path, format!("cannot be decoded ({}); copy it again", one_line(e)))
}

/// A picture that is no JPEG, with all of its values.
fn decode_stored(path: &Path) -> Result<DynamicImage, PictureError> {
    if let Some(mut decoder) = webp::open(path)? {
        return webp::decode(path, &mut decoder);
    }
    stored(path)?.decode().map_err(|e| undecoded(path, e))
}

/// What decodes a picture that is neither a JPEG nor a WebP, once the JPEGs within it are known to be whole.
fn stored(path: &Path) -> Result<ImageReader<BufReader<File>>, PictureError> {
    let mut reader = open(path)?;
    let unread = |e: std::io::Error| bad(path, format!("cannot be read ({e}); copy it again"));
    if reader.format() == Some(ImageFormat::Tiff)
        && let Some(flaw) = tiff::flaw(path).map_err(unread)?
    {
        return Err(cut(path, flaw));
    }
    reader.limits(limits());
    Ok(reader)
}

fn cut(path: &Path, flaw: &str) -> PictureError {
    bad(path, format!("is cut off or damaged ({flaw}); copy it again"))
}

/// The picture at another size, each pixel the mean of those it covers; one of that size already is returned as it is.
pub fn resized(image: RgbImage, (width, height): (u32, u32)) -> RgbImage {
    match image.dimensions() == (width, height) {
        true => image,
        false => image::imageops::resize(&image, width, height, image::imageops::FilterType::Triangle),
    }
}

/// A JPEG's bytes; `None` for another kind of file. A cut one is refused here, as decoders fill what is missing with grey.
fn jpeg(path: &Path) -> Result<Option<Vec<u8>>, PictureError> {
    let io = |e: std::io::Error| bad(path, format!("cannot be opened ({e}); is the picture folder complete?"));
    let mut file = disk::regular::open(path).map_err(io)?;
    let mut magic = [0; 3];
    if file.read_exact(&mut magic).is_err() || magic != [0xFF, 0xD8, 0xFF] {
        return Ok(None);
    }
    let size = file.metadata().map_err(io)?.len();
    if size > MAX_FILE {
        return Err(bad(path, format!("has {} MB; at most {} can be taken", size >> 20, MAX_FILE >> 20)));
    }
    // As a whole: the decoder asks byte by byte, which costs a third of its time through a reader's buffer.
    let mut bytes = Vec::with_capacity(size as usize);
    file.seek(SeekFrom::Start(0)).map_err(io)?;
    file.take(MAX_FILE).read_to_end(&mut bytes).map_err(io)?;
    match jpeg::flaw(&bytes) {
        None => Ok(Some(bytes)),
        Some(flaw) => Err(cut(path, flaw)),
    }
}

/// The picture reduced while it is decoded; `None` where less than half its size is not enough.
fn scaled_jpeg(path: &Path, bytes: &[u8], (width, height): (u32, u32)) -> Result<Option<RgbImage>, PictureError> {
    if width.max(height) > MAX_EDGE {
        return Ok(None);
    }
    let damaged = |e: jpeg_decoder::Error| bad(path, format!("cannot be decoded ({}); copy it again", one_line(e)));
    let mut decoder = Decoder::new(bytes);
    decoder.set_max_decoding_buffer_size(MAX_EDGE as usize * MAX_EDGE as usize * 3);
    decoder.read_info().map_err(damaged)?;
    let Some(info) = decoder.info() else { return Ok(None) };
    if u32::from(info.width).max(u32::from(info.height)) > MAX_EDGE {
        return Err(bad(
            path,
            format!("is {} x {}; at most {MAX_EDGE} pixels a side can be taken", info.width, info.height),
        ));
    }
    // Half of an odd width is rounded up.
    if width > u32::from(info.width).div_ceil(2) || height > u32::from(info.height).div_ceil(2) {
        return Ok(None);
    }
    // The decoder's own choice is content with one edge; both are wanted.
    let eighths = |n: u16, s: u32| (u32::from(n) * s).div_ceil(8);
    let smallest =
        [1, 2, 4].into_iter().find(|s| eighths(info.width, *s) >= width && eighths(info.height, *s) >= height);
    let scale = smallest.unwrap_or(4);
    let (w, h) =
        decoder.scale(eighths(info.width, scale) as u16, eighths(info.height, scale) as u16).map_err(damaged)?;
    let (w, h, pixels) = (u32::from(w), u32::from(h), decoder.decode().map_err(damaged)?);
    let rgb = match info.pixel_format {
        PixelFormat::RGB24 => pixels,
        PixelFormat::L8 => pixels.iter().flat_map(|v| [*v; 3]).collect(),
        PixelFormat::L16 => pixels.chunks_exact(2).flat_map(|v| [v[1]; 3]).collect(),
        PixelFormat::CMYK32 => {
            static SAID: std::sync::Once = std::sync::Once::new();
            SAID.call_once(|| tracing::info!("{}: a picture for print (CMYK), converted", path.display()));
            // The decoder undoes Adobe's inversion, which everybody's have in practice: 0 is no ink.
            let ink = |c: u8, k: u8| (u16::from(255 - c) * u16::from(255 - k) / 255) as u8;
            pixels.chunks_exact(4).flat_map(|p| [ink(p[0], p[3]), ink(p[1], p[3]), ink(p[2], p[3])]).collect()
        }
    };
    RgbImage::from_raw(w, h, rgb).map(Some).ok_or_else(|| bad(path, "is a damaged JPEG; copy it again"))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    #[test]
    fn every_orientation_puts_pixels_lens_and_axes_at_the_same_place() {
        let mut image = RgbImage::new(8, 6);
        image.put_pixel(1, 4, image::Rgb([255; 3]));
        let stored = LensDescription {
            size: Some((8, 6)),
            focal: Focal::Pixels(10.0, 11.0),
            principal: Some((3.5, 2.5)),
            distortion: Distortion { k1: 0.1, p1: 0.02, p2: -0.03, sx1: 0.01, sy1: 0.02, ..Distortion::default() },
        };
        let pixel = [1.5, 4.5];
        let ray = stored.lens((8, 6)).unproject(pixel).unwrap();
        for tag in [1, 3, 6, 8] {
            let orientation = Orientation::from_exif(tag);
            let turned = orientation.apply(image.clone());
            let at = turned.enumerate_pixels().find(|(_, _, p)| p.0[0] == 255).map(|(x, y, _)| (x, y)).unwrap();
            let lens = orientation.of_lens(&stored);
            assert_eq!(orientation.inverse().of_lens(&lens), stored, "{tag}");
            assert_eq!(lens.size, Some(turned.dimensions()), "{tag}");
            let (w, h) = (f64::from(turned.width()), f64::from(turned.height()));
            let place = orientation.stored_place([(f64::from(at.0) + 0.5) / w, (f64::from(at.1) + 0.5) / h]);
            assert_eq!([place[0] * 8.0, place[1] * 6.0], pixel, "{tag}");
            // The same ray of the world: the stored camera's axes and the turned one's.
            let [x, y] =
                lens.lens(turned.dimensions()).unproject([f64::from(at.0) + 0.5, f64::from(at.1) + 0.5]).unwrap();
            let world = orientation.of_rotation(DQuat::IDENTITY) * glam::DVec3::new(x, y, 1.0);
            assert!(world.distance(glam::DVec3::new(ray[0], ray[1], 1.0)) < 1e-9, "{tag}: {world} {ray:?}");
        }
        assert_eq!(Orientation::from_exif(99), Orientation::default());
    }

    fn photo(w: u32, h: u32) -> RgbImage {
        RgbImage::from_fn(w, h, |x, y| image::Rgb([(x * 255 / w) as u8, (y * 255 / h) as u8, 90]))
    }

    #[test]
    fn a_reduced_picture_is_the_smallest_that_is_large_enough_and_looks_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.jpg");
        photo(400, 302).save(&path).unwrap();
        for (wanted, size) in [
            ((100, 75), (100, 76)),
            ((101, 75), (200, 151)),
            ((50, 30), (50, 38)),
            ((201, 10), (400, 302)),
            ((1, 1), (50, 38)),
        ] {
            let image = decode_at_least(&path, wanted).unwrap();
            assert_eq!(image.dimensions(), size, "{wanted:?}");
            let (w, h) = size;
            for (x, y) in [(0, 0), (w / 2, h / 3), (w - 1, h - 1)] {
                let (got, want) = (image.get_pixel(x, y), [(x * 255 / w) as u8, (y * 255 / h) as u8, 90]);
                let close = got.0.iter().zip(want).all(|(g, w)| g.abs_diff(w) <= 6);
                assert!(close, "{wanted:?} at {x}, {y}: {got:?} {want:?}");
            }
        }
    }

    #[test]
    fn a_picture_cut_off_is_an_error_at_every_size() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.jpg");
        let noise = RgbImage::from_fn(160, 120, |x, y| {
            let v = (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(40_503)).wrapping_mul(2_246_822_519) >> 24;
            image::Rgb([v as u8, (v >> 1) as u8, (v >> 2) as u8])
        });
        noise.save(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for keep in [whole.len() / 4, whole.len() / 2, whole.len() * 9 / 10] {
            std::fs::write(&path, &whole[..keep]).unwrap();
            let error = decode_at_least(&path, (40, 30)).unwrap_err().to_string();
            assert!(error.contains("a.jpg") && !error.contains('\n'), "{error}");
        }
        for keep in [whole.len() / 4, whole.len() / 2, whole.len() * 9 / 10, whole.len() - 1] {
            std::fs::write(&path, &whole[..keep]).unwrap();
            assert!(decode(&path).is_err_and(|e| e.what.contains("cut off")), "{keep} bytes at full size");
            // Whatever ends it.
            std::fs::write(&path, [&whole[..keep - 1], &[0xFF, 0xD9]].concat()).unwrap();
            let refused = |wanted| decode_at_least(&path, wanted).is_err_and(|e| e.what.contains("cut off"));
            assert!(keep == whole.len() - 1 || refused((160, 120)) && refused((20, 15)), "{keep} bytes and an end");
        }
        // Bytes behind the end belong to nobody.
        std::fs::write(&path, [whole.as_slice(), &[7; 999]].concat()).unwrap();
        assert_eq!(decode(&path).unwrap().dimensions(), (160, 120));
        // At full size another decoder reads it, whose words may end with a line break.
        let said = (2..whole.len().min(700)).filter_map(|n| {
            std::fs::write(&path, &whole[..n]).unwrap();
            Some(decode(&path).err()?.to_string())
        });
        let said: Vec<String> = said.collect();
        assert!(said.len() > 300 && said.iter().all(|e| e.contains("a.jpg") && !e.contains('\n')), "{said:?}");
    }

    /// A picture of four inks in one colour, as Adobe's programs store it: inverted, 255 being no ink. Baseline, every value in the first
    /// coefficient of its block.
    fn four_inks(side: u16, inks: [u8; 4]) -> Vec<u8> {
        let segment =
            |marker: u8, body: &[u8]| [&[0xFF, marker][..], &(body.len() as u16 + 2).to_be_bytes(), body].concat();
        let quantisers = [&[0u8][..], &[1; 64]].concat();
        let [high, low] = side.to_be_bytes();
        let frame: Vec<u8> =
            [8, high, low, high, low, 4].into_iter().chain((1..=4).flat_map(|id| [id, 0x11, 0])).collect();
        // Twelve sizes of a first coefficient in codes of four bits; of the others the end of the block alone.
        let first: Vec<u8> = [0, 0, 0, 0, 12].into_iter().chain([0; 12]).chain(0..12).collect();
        let others: Vec<u8> = [0x10, 1].into_iter().chain([0; 15]).chain([0]).collect();
        let scan: Vec<u8> = std::iter::once(4).chain((1..=4).flat_map(|id| [id, 0])).chain([0, 63, 0]).collect();
        let (mut bits, mut before) = (Vec::new(), [0i32; 4]);
        for _ in 0..(usize::from(side) / 8).pow(2) {
            for (ink, before) in inks.iter().zip(&mut before) {
                let now = 8 * (i32::from(*ink) - 128);
                let step = now - *before;
                *before = now;
                let size = 32 - step.unsigned_abs().leading_zeros();
                let value = if step < 0 { step + (1 << size) - 1 } else { step };
                bits.extend((0..4).rev().map(|k| size >> k & 1 == 1));
                bits.extend((0..size).rev().map(|k| value >> k & 1 == 1));
                bits.push(false);
            }
        }
        bits.resize(bits.len().next_multiple_of(8), true);
        let mut data = Vec::new();
        for byte in bits.chunks(8) {
            data.push(byte.iter().fold(0u8, |byte, bit| byte << 1 | u8::from(*bit)));
            if data.last() == Some(&0xFF) {
                data.push(0);
            }
        }
        let adobe = b"Adobe\0\x64\0\0\0\0\0";
        let parts = [segment(0xEE, adobe), segment(0xDB, &quantisers), segment(0xC0, &frame)];
        let tables = [segment(0xC4, &first), segment(0xC4, &others), segment(0xDA, &scan)];
        [&[0xFF, 0xD8][..], &parts.concat(), &tables.concat(), &data, &[0xFF, 0xD9]].concat()
    }

    #[test]
    fn a_picture_for_print_has_its_colours_at_every_size() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.jpg");
        // No cyan, all magenta, half of the yellow, no black.
        std::fs::write(&path, four_inks(64, [255, 0, 128, 255])).unwrap();
        for wanted in [64, 32, 16, 8] {
            let image = decode_at_least(&path, (wanted, wanted)).unwrap();
            assert_eq!(image.dimensions(), (wanted, wanted));
            let [r, g, b] = image.get_pixel(3, 3).0;
            assert!(r > 250 && g < 5 && b.abs_diff(128) < 6, "{wanted}: {r} {g} {b}");
        }
    }
}

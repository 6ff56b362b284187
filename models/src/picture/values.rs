//! Pictures of more than eight bits a value: which of their values are used, so that eight bits show them; and what a file's head says of
//! its pixels.

use std::path::Path;

use image::{ColorType, DynamicImage, ExtendedColorType, ImageDecoder, RgbImage};

use super::{PictureError, bad, decode_stored, open, webp};
use crate::formats::one_line;

/// Pictures sampled for the range of all.
const SAMPLED: usize = 12;
/// Share of the values that may lie beyond either end of a band's range: stray pixels and glints.
const BEYOND: f64 = 1e-3;

/// What a file's head says of its pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Kind {
    /// Sixteen bits a value.
    pub is_deep: bool,
    /// One value a pixel.
    pub is_grey: bool,
    /// Some pixels may be transparent.
    pub has_alpha: bool,
}

impl Kind {
    /// From the head of a PNG, TIFF or WebP file. A JPEG, whose head is all of the file to its decoder, has eight bits and no alpha;
    /// whether it is grey is not asked.
    ///
    /// # Errors
    /// The file cannot be opened or is damaged.
    pub fn of(path: &Path) -> Result<Self, PictureError> {
        if let Some(decoder) = webp::open(path)? {
            return Ok(Self { has_alpha: decoder.has_alpha(), ..Self::default() });
        }
        let reader = open(path)?;
        if reader.format() == Some(image::ImageFormat::Jpeg) {
            return Ok(Self::default());
        }
        let decoder = reader.into_decoder().map_err(|e| bad(path, format!("cannot be decoded ({})", one_line(e))))?;
        let color = decoder.color_type();
        // A palette with a transparent colour, a mask of one bit.
        let is_grey = !color.has_color() && !matches!(decoder.original_color_type(), ExtendedColorType::L1);
        Ok(Self {
            is_deep: matches!(color, ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16),
            is_grey,
            has_alpha: color.has_alpha(),
        })
    }
}

/// Which 16-bit values become black and white.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ValueRange {
    /// Becomes 0.
    pub low: u16,
    /// Becomes 255.
    pub high: u16,
}

impl ValueRange {
    /// All values.
    pub const FULL: Self = Self { low: 0, high: u16::MAX };

    /// The range of 16-bit pictures of one kind, from a sample of them. For bands (one value a pixel) it holds nearly all values. For
    /// colours, whose proportions must stay, it is as many bits as are used. `None` where none can be read.
    pub fn of<P: AsRef<Path>>(pictures: &[P]) -> Option<Self> {
        if pictures.is_empty() {
            return None;
        }
        let every = pictures.len().div_ceil(SAMPLED).max(1);
        let mut counts = vec![0u64; 1 << 16];
        let mut is_grey = true;
        for path in pictures.iter().step_by(every) {
            // What cannot be decoded is said where it is needed.
            match decode_stored(path.as_ref()) {
                Ok(DynamicImage::ImageLuma16(image)) => {
                    image.as_raw().iter().for_each(|v| counts[usize::from(*v)] += 1)
                }
                Ok(DynamicImage::ImageLumaA16(image)) => {
                    image.pixels().filter(|p| p.0[1] > 0).for_each(|p| counts[usize::from(p.0[0])] += 1);
                }
                Ok(DynamicImage::ImageRgb16(image)) => {
                    is_grey = false;
                    image.as_raw().iter().for_each(|v| counts[usize::from(*v)] += 1);
                }
                Ok(DynamicImage::ImageRgba16(image)) => {
                    is_grey = false;
                    let opaque = image.pixels().filter(|p| p.0[3] > 0).flat_map(|p| [p.0[0], p.0[1], p.0[2]]);
                    opaque.for_each(|v| counts[usize::from(v)] += 1);
                }
                _ => {}
            }
        }
        let all: u64 = counts.iter().sum();
        let beyond = (all as f64 * BEYOND) as u64;
        let reached = |from: &dyn Fn(usize) -> usize| {
            let mut passed = 0;
            (0..=0xFFFFusize).map(from).find(|v| {
                passed += counts[*v];
                passed > beyond
            })
        };
        let (low, high) = (reached(&|v| v), reached(&|v| 0xFFFF - v));
        let (low, high) = (low? as u16, high? as u16);
        Some(match is_grey {
            true => Self { low: low.min(high.saturating_sub(1)), high: high.max(1) },
            // The next power of two, at least the eight bits that are shown.
            false => Self { low: 0, high: (u32::from(high).max(255) + 1).next_power_of_two().saturating_sub(1) as u16 },
        })
    }

    /// A value in eight bits.
    pub fn byte(&self, value: u16) -> u8 {
        let span = f32::from(self.high) - f32::from(self.low);
        ((f32::from(value) - f32::from(self.low)) / span.max(1.0) * 255.0).round().clamp(0.0, 255.0) as u8
    }

    /// The picture in eight bits; `None` for one that has no more.
    pub(super) fn shown(&self, image: &DynamicImage) -> Option<RgbImage> {
        let (w, h) = (image.width(), image.height());
        Some(match image {
            DynamicImage::ImageLuma16(p) => {
                RgbImage::from_fn(w, h, |x, y| image::Rgb([self.byte(p.get_pixel(x, y).0[0]); 3]))
            }
            DynamicImage::ImageLumaA16(p) => {
                RgbImage::from_fn(w, h, |x, y| image::Rgb([self.byte(p.get_pixel(x, y).0[0]); 3]))
            }
            DynamicImage::ImageRgb16(p) => {
                RgbImage::from_fn(w, h, |x, y| image::Rgb(p.get_pixel(x, y).0.map(|v| self.byte(v))))
            }
            DynamicImage::ImageRgba16(p) => {
                let rgb = |x, y| {
                    let [r, g, b, _] = p.get_pixel(x, y).0;
                    image::Rgb([r, g, b].map(|v| self.byte(v)))
                };
                RgbImage::from_fn(w, h, rgb)
            }
            _ => return None,
        })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use image::{ImageBuffer, Luma, Rgb};

    use super::*;
    use crate::picture::decode_shown;

    #[test]
    fn bands_of_sixteen_bits_use_all_of_the_eight_that_are_shown() {
        let dir = tempfile::tempdir().unwrap();
        let [band, color] = ["a.tif", "a.png"].map(|name| dir.path().join(name));
        // A sensor of twelve bits whose darkest value is 200: between 200 and 4,000 of 65,535.
        let dark = ImageBuffer::<Luma<u16>, _>::from_fn(64, 64, |x, _| Luma([200 + (x * 60) as u16]));
        dark.save(&band).unwrap();
        ImageBuffer::<Rgb<u16>, _>::from_fn(64, 64, |x, _| Rgb([x as u16 * 60, x as u16 * 30, 0]))
            .save(&color)
            .unwrap();
        assert_eq!(Kind::of(&band).unwrap(), Kind { is_deep: true, is_grey: true, has_alpha: false });
        assert_eq!(Kind::of(&color).unwrap(), Kind { is_deep: true, is_grey: false, has_alpha: false });
        let range = ValueRange::of(&[&band]).unwrap();
        assert_eq!(range, ValueRange { low: 200, high: 3980 });
        let (shown, mask) = decode_shown(&band, (u32::MAX, u32::MAX), Some(range)).unwrap();
        assert_eq!((shown.get_pixel(0, 0).0, shown.get_pixel(63, 5).0, mask), ([0; 3], [255; 3], None));
        assert!(shown.get_pixel(32, 0).0[0].abs_diff(129) <= 1);
        // Proportions of colours stay.
        let range = ValueRange::of(&[&color]).unwrap();
        assert_eq!(range, ValueRange { low: 0, high: 4095 });
        let (shown, _) = decode_shown(&color, (u32::MAX, u32::MAX), Some(range)).unwrap();
        let [r, g, b] = shown.get_pixel(63, 0).0;
        assert!(r.abs_diff(235) <= 1 && g.abs_diff(118) <= 1 && b == 0, "{r} {g} {b}");
        assert_eq!(ValueRange::of(&[dir.path().join("none.tif")]), None);
    }

    #[test]
    fn what_is_transparent_is_a_mask_in_every_format_that_has_it() {
        let dir = tempfile::tempdir().unwrap();
        let picture =
            image::RgbaImage::from_fn(40, 30, |x, _| image::Rgba([200, 100, 50, if x < 10 { 0 } else { 255 }]));
        for name in ["a.png", "a.tif", "a.webp"] {
            let path = dir.path().join(name);
            if name.ends_with("webp") {
                let mut file = std::fs::File::create(&path).unwrap();
                let encoder = image_webp::WebPEncoder::new(&mut file);
                encoder.encode(picture.as_raw(), 40, 30, image_webp::ColorType::Rgba8).unwrap();
            } else {
                picture.save(&path).unwrap();
            }
            assert!(Kind::of(&path).unwrap().has_alpha, "{name}");
            let (shown, mask) = decode_shown(&path, (u32::MAX, u32::MAX), None).unwrap();
            let mask = mask.unwrap();
            assert_eq!(shown.get_pixel(39, 0).0, [200, 100, 50], "{name}");
            assert_eq!((mask.count(), mask.keeps(9, 0), mask.keeps(10, 0)), (30 * 30, false, true), "{name}");
        }
        let opaque = dir.path().join("b.png");
        image::RgbaImage::from_pixel(8, 8, image::Rgba([1, 2, 3, 255])).save(&opaque).unwrap();
        assert_eq!(decode_shown(&opaque, (8, 8), None).unwrap().1, None);
    }
}

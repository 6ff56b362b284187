//! Mask files: a second picture of the same view, black where nothing is to be learnt.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageFormat, ImageReader};

use super::{PictureError, bad, jpeg, limits, stored};
use crate::formats::one_line;
use crate::mask::Mask;

/// Grey value below which a pixel of a lossy mask is black: compression leaves noise about both colours.
const BLACK: u8 = 128;

impl Mask {
    /// A mask file: JPEG, PNG or TIFF, of which black pixels are left out (exactly black ones where the format keeps values as
    /// they are, the darker half of JPEG's).
    ///
    /// # Errors
    /// The file cannot be opened, is damaged, or is no picture.
    pub fn read(path: &Path) -> Result<Self, PictureError> {
        let damaged =
            |e: image::ImageError| bad(path, format!("cannot be decoded ({}); mend or remove this mask", one_line(e)));
        let (decoded, least) = match jpeg(path)? {
            Some(bytes) => {
                let mut reader = ImageReader::with_format(Cursor::new(bytes), ImageFormat::Jpeg);
                reader.limits(limits());
                (reader.decode(), BLACK)
            }
            None => (stored(path)?.decode(), 1),
        };
        let grey = match decoded.map_err(damaged)? {
            // A 16-bit value below 128 would be rounded to black.
            DynamicImage::ImageLuma16(image) => {
                return Ok(Self::from_fn(image.width(), image.height(), |x, y| image.get_pixel(x, y).0[0] > 0));
            }
            image => image.into_luma8(),
        };
        Ok(Self::from_fn(grey.width(), grey.height(), |x, y| grey.get_pixel(x, y).0[0] >= least))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use image::{GrayImage, ImageBuffer, Luma};

    use super::*;

    #[test]
    fn black_is_zero_in_a_png_of_any_depth_and_the_darker_half_of_a_jpeg() {
        let dir = tempfile::tempdir().unwrap();
        let left = |x: u32| x < 16;
        let read = |name: &str| {
            let mask = Mask::read(&dir.path().join(name)).unwrap();
            assert_eq!(mask, Mask::from_fn(32, 16, |x, _| !left(x)), "{name}");
        };
        for (name, white) in [("a.png", 255), ("ones.png", 1), ("a.jpg", 255)] {
            let image = GrayImage::from_fn(32, 16, |x, _| Luma([if left(x) { 0 } else { white }]));
            image.save(dir.path().join(name)).unwrap();
            read(name);
        }
        let deep = ImageBuffer::<Luma<u16>, _>::from_fn(32, 16, |x, _| Luma([if left(x) { 0u16 } else { 9 }]));
        deep.save(dir.path().join("deep.png")).unwrap();
        read("deep.png");
    }

    /// What is missing would be grey: white, and learnt from.
    #[test]
    fn a_mask_that_is_cut_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.jpg");
        GrayImage::from_fn(96, 64, |x, y| Luma([(x * y * 7 + 31 * x) as u8])).save(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        assert!(Mask::read(&path).is_ok());
        std::fs::write(&path, [&whole[..2 * whole.len() / 3], &[0xFF, 0xD9]].concat()).unwrap();
        assert!(image::open(&path).is_ok(), "a decoder notices nothing");
        assert!(Mask::read(&path).is_err_and(|e| e.to_string().contains("is cut off or damaged")));
    }
}

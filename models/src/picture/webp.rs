//! WebP, lossy and lossless: pixels, and what is written beside them.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use image::{DynamicImage, RgbImage, RgbaImage};
use image_webp::WebPDecoder;

use super::{MAX_EDGE, PictureError, bad};
use crate::formats::one_line;

/// EXIF and XMP of a WebP file.
#[derive(Clone, Debug, Default)]
pub struct Head {
    /// Width and height.
    pub size: (u32, u32),
    /// EXIF as it stands in the file, a TIFF.
    pub exif: Option<Vec<u8>>,
    /// The XMP packet.
    pub xmp: Option<Vec<u8>>,
}

/// What stands beside the pixels of a WebP file; `None` where it is another kind of file.
///
/// # Errors
/// The file cannot be opened or is damaged.
pub fn head(path: &Path) -> Result<Option<Head>, PictureError> {
    let Some(mut decoder) = open(path)? else { return Ok(None) };
    let exif = decoder.exif_metadata().ok().flatten();
    let xmp = decoder.xmp_metadata().ok().flatten();
    Ok(Some(Head { size: decoder.dimensions(), exif, xmp }))
}

/// A reader of the file, where it is WebP.
pub(super) fn open(path: &Path) -> Result<Option<WebPDecoder<BufReader<File>>>, PictureError> {
    let io = |e: std::io::Error| bad(path, format!("cannot be opened ({e}); is the picture folder complete?"));
    let mut file = BufReader::new(disk::regular::open(path).map_err(io)?);
    let mut magic = [0; 12];
    if file.read_exact(&mut magic).is_err() || !is_webp(&magic) {
        return Ok(None);
    }
    file.seek(SeekFrom::Start(0)).map_err(io)?;
    let mut decoder = WebPDecoder::new(file).map_err(|e| damaged(path, &e))?;
    decoder.set_memory_limit(MAX_EDGE as usize * MAX_EDGE as usize * 4);
    let (w, h) = decoder.dimensions();
    match w.max(h) <= MAX_EDGE {
        true => Ok(Some(decoder)),
        false => Err(bad(path, format!("has {w} x {h} pixels; at most {MAX_EDGE} a side can be taken"))),
    }
}

/// Whether a file that begins so is WebP.
pub fn is_webp(start: &[u8]) -> bool {
    start.starts_with(b"RIFF") && start.get(8..12) == Some(b"WEBP")
}

/// The picture; of several the first.
pub(super) fn decode(path: &Path, decoder: &mut WebPDecoder<BufReader<File>>) -> Result<DynamicImage, PictureError> {
    let (w, h) = decoder.dimensions();
    let bytes = decoder.output_buffer_size().ok_or_else(|| bad(path, "is too large a WebP"))?;
    let mut pixels = vec![0; bytes];
    decoder.read_image(&mut pixels).map_err(|e| damaged(path, &e))?;
    let image = match decoder.has_alpha() {
        true => RgbaImage::from_raw(w, h, pixels).map(DynamicImage::ImageRgba8),
        false => RgbImage::from_raw(w, h, pixels).map(DynamicImage::ImageRgb8),
    };
    image.ok_or_else(|| bad(path, "is a damaged WebP; copy it again"))
}

fn damaged(path: &Path, e: &image_webp::DecodingError) -> PictureError {
    bad(path, format!("cannot be decoded ({}); copy it again", one_line(e)))
}

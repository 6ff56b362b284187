//! Pictures of the page, as bytes and as data URIs.

use base64::Engine;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageError, RgbImage};

/// Above this many pixels JPEG is used: a page of PNG photographs would not fit on a mail, and below it
/// JPEG's blocks would be larger than what there is to see.
const PNG_PIXELS: u32 = 128 * 128;
/// High enough that the codec's error stays far below the rendering's.
const JPEG_QUALITY: u8 = 88;

/// A picture's bytes and what kind they are.
///
/// # Errors
/// It has no pixels.
pub fn encode(image: &RgbImage) -> Result<(&'static str, Vec<u8>), ImageError> {
    let mut bytes = Vec::new();
    let (w, h) = image.dimensions();
    let kind = if w * h <= PNG_PIXELS {
        PngEncoder::new(&mut bytes).write_image(image.as_raw(), w, h, ExtendedColorType::Rgb8)?;
        "image/png"
    } else {
        JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).write_image(
            image.as_raw(),
            w,
            h,
            ExtendedColorType::Rgb8,
        )?;
        "image/jpeg"
    };
    Ok((kind, bytes))
}

/// A picture inside a page.
///
/// # Errors
/// It has no pixels.
pub fn data_uri(image: &RgbImage) -> Result<String, ImageError> {
    encode(image).map(|(kind, bytes)| uri(kind, &bytes))
}

/// A file of that format inside a page.
pub(super) fn png_uri(bytes: &[u8]) -> String {
    uri("image/png", bytes)
}

/// A drawing inside a page.
pub(super) fn svg_uri(svg: &str) -> String {
    uri("image/svg+xml", svg.as_bytes())
}

fn uri(kind: &str, bytes: &[u8]) -> String {
    format!("data:{kind};base64,{}", base64::engine::general_purpose::STANDARD.encode(bytes))
}

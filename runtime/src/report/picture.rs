//! Pictures inside the page, as data URIs.

use base64::Engine;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageError, RgbImage};

/// Above this many pixels JPEG is used: a page of PNG photographs would not fit on a mail, and below it
/// JPEG's blocks would be larger than what there is to see.
const PNG_PIXELS: u32 = 128 * 128;
/// High enough that the codec's error stays far below the rendering's.
const JPEG_QUALITY: u8 = 88;

pub(crate) fn data_uri(image: &RgbImage) -> Result<String, ImageError> {
    let mut bytes = Vec::new();
    let (w, h) = image.dimensions();
    let kind = if w * h <= PNG_PIXELS {
        PngEncoder::new(&mut bytes).write_image(image.as_raw(), w, h, ExtendedColorType::Rgb8)?;
        "png"
    } else {
        JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).write_image(
            image.as_raw(),
            w,
            h,
            ExtendedColorType::Rgb8,
        )?;
        "jpeg"
    };
    Ok(format!("data:image/{kind};base64,{}", base64::engine::general_purpose::STANDARD.encode(bytes)))
}

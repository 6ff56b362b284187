//! Lens distortion is taken out of a data set's pictures once, when they are read.

use geometry::lens::{Distortion, Lens, Pixels};
use image::{Rgb, RgbImage};
use rayon::prelude::*;

use crate::camera::Intrinsics;

/// Returns the picture as a pinhole of these intrinsics sees it.
pub fn undistort(image: &RgbImage, k: &Intrinsics, distortion: &Distortion) -> RgbImage {
    let mut out = RgbImage::new(image.width(), image.height());
    if image.width() == 0 || image.height() == 0 {
        return out;
    }
    let lens =
        Lens { focal: [k.fx.into(), k.fy.into()], principal: [k.cx.into(), k.cy.into()], distortion: *distortion };
    out.as_mut()
        .par_chunks_exact_mut(3 * image.width() as usize)
        .enumerate()
        .for_each(|(row, line)| lens.undistort_row(pixels(image), row, line));
    out
}

/// Colour at a pixel position (centres at .5); positions outside take the nearest border pixel.
pub fn sample_bilinear(image: &RgbImage, x: f32, y: f32) -> Rgb<u8> {
    Rgb(pixels(image).bilinear(x, y))
}

fn pixels(image: &RgbImage) -> Pixels<'_> {
    Pixels { rgb: image.as_raw(), width: image.width() as usize, height: image.height() as usize }
}

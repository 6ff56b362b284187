//! Undistortion on ingest: everything behind the HAL sees a pinhole camera, with the mission's own focal lengths and
//! principal point.

use config::mission::CameraSettings;
use geometry::lens::{Distortion, Lens, Pixels};
use image::RgbImage;
use rayon::prelude::*;

/// The pinhole picture of a distorted one. A lens without distortion returns the picture untouched.
pub fn undistort(image: RgbImage, settings: &CameraSettings) -> RgbImage {
    let [k1, k2, p1, p2] = settings.distortion.map(f64::from);
    let distortion = Distortion { k1, k2, p1, p2, ..Distortion::default() };
    if distortion.is_none() || image.width() == 0 || image.height() == 0 {
        return image;
    }
    let [fx, fy, cx, cy] = [settings.fx, settings.fy, settings.cx, settings.cy].map(f64::from);
    let lens = Lens { focal: [fx, fy], principal: [cx, cy], distortion };
    let (width, height) = (image.width() as usize, image.height() as usize);
    let picture = Pixels { rgb: image.as_raw(), width, height };
    let mut out = RgbImage::new(image.width(), image.height());
    out.as_mut()
        .par_chunks_exact_mut(3 * width)
        .enumerate()
        .for_each(|(row, line)| lens.undistort_row(picture, row, line));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_coefficients_of_the_mission_are_opencvs_k1_k2_p1_p2() {
        let side = 101;
        let lens = |distortion| CameraSettings { distortion, ..CameraSettings::pinhole(side, side, 80.0) };
        // p1 moves what lies right of the centre down: y = p1 r² = 0.1 · 0.25, two pixels.
        let mut image = RgbImage::new(side, side);
        image.put_pixel(90, 52, image::Rgb([255; 3]));
        let out = undistort(image.clone(), &lens([0.0, 0.0, 0.1, 0.0]));
        assert_eq!(out.get_pixel(90, 50).0, [255; 3]);
        assert_eq!(undistort(image.clone(), &lens([0.0; 4])), image);
    }
}

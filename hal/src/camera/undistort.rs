//! Undistortion on ingest: everything behind the HAL sees a pinhole camera. Brown–Conrady as in OpenCV, same focal lengths
//! and principal point, so that the mission's calibration is the pinhole's as well.

use config::mission::CameraSettings;
use image::RgbImage;
use rayon::prelude::*;

/// The pinhole picture of a distorted one; where the pinhole sees past it the picture's edge is repeated, as for data sets:
/// training has no mask, and a black border would be learnt as black ground. A lens without distortion returns the picture
/// untouched.
pub fn undistort(image: RgbImage, lens: &CameraSettings) -> RgbImage {
    let [k1, k2, p1, p2] = lens.distortion;
    if lens.distortion == [0.0; 4] || image.width() == 0 || image.height() == 0 {
        return image;
    }
    let (w, h) = image.dimensions();
    let mut out = RgbImage::new(w, h);
    out.as_mut().par_chunks_exact_mut(3 * w as usize).enumerate().for_each(|(row, line)| {
        let y = (row as f32 + 0.5 - lens.cy) / lens.fy;
        for (column, pixel) in line.chunks_exact_mut(3).enumerate() {
            let x = (column as f32 + 0.5 - lens.cx) / lens.fx;
            let r2 = x * x + y * y;
            let radial = 1.0 + r2 * (k1 + r2 * k2);
            let xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
            let yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
            sample(&image, lens.fx * xd + lens.cx, lens.fy * yd + lens.cy, pixel);
        }
    });
    out
}

/// Bilinear; (0.5, 0.5) is the centre of the first pixel, positions outside take the nearest pixel of the edge.
fn sample(image: &RgbImage, u: f32, v: f32, pixel: &mut [u8]) {
    let (w, h) = image.dimensions();
    let (u, v) = ((u - 0.5).clamp(0.0, (w - 1) as f32), (v - 0.5).clamp(0.0, (h - 1) as f32));
    let (x, y) = (u as u32, v as u32);
    let (fx, fy) = (u - x as f32, v - y as f32);
    let (x1, y1) = ((x + 1).min(w - 1), (y + 1).min(h - 1));
    for (c, out) in pixel.iter_mut().enumerate() {
        let at = |x, y| f32::from(image.get_pixel(x, y).0[c]);
        let top = at(x, y) + (at(x1, y) - at(x, y)) * fx;
        let bottom = at(x, y1) + (at(x1, y1) - at(x, y1)) * fx;
        *out = (top + (bottom - top) * fy).round() as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lens(distortion: [f32; 4]) -> CameraSettings {
        let side = 101;
        CameraSettings {
            width: side,
            height: side,
            fx: 80.0,
            fy: 80.0,
            cx: 50.5,
            cy: 50.5,
            distortion,
            exposure_delay_ms: 0.0,
        }
    }

    #[test]
    fn a_point_seen_through_barrel_distortion_returns_to_where_a_pinhole_sees_it() {
        let lens = lens([-0.2, 0.0, 0.0, 0.0]);
        // A pinhole sees it 40 pixels right of the centre: x = 0.5, distorted x = 0.5 (1 − 0.2 · 0.25) = 0.475, 38 pixels.
        let mut image = RgbImage::new(lens.width, lens.height);
        image.put_pixel(50 + 38, 50, image::Rgb([255, 255, 255]));
        let out = undistort(image, &lens);
        assert_eq!(out.get_pixel(50 + 40, 50).0, [255; 3]);
        assert_eq!(out.get_pixel(50 + 38, 50).0, [0; 3]);
    }

    #[test]
    fn where_the_lens_saw_nothing_the_edge_is_repeated_and_nothing_is_black() {
        // Pincushion: the pinhole's corners lie outside of the picture.
        let image = RgbImage::from_fn(101, 101, |x, _| image::Rgb([if x < 50 { 80 } else { 160 }, 90, 100]));
        let out = undistort(image, &lens([0.3, 0.0, 0.0, 0.0]));
        assert_eq!((out.get_pixel(0, 0).0, out.get_pixel(100, 100).0), ([80, 90, 100], [160, 90, 100]));
        assert!(out.pixels().all(|p| p.0[0] >= 80 && p.0[1] == 90 && p.0[2] == 100));
    }

    #[test]
    fn without_distortion_the_picture_is_untouched() {
        let image = RgbImage::from_fn(101, 101, |x, y| image::Rgb([x as u8, y as u8, 7]));
        assert_eq!(undistort(image.clone(), &lens([0.0; 4])), image);
        let nearly = undistort(image.clone(), &lens([1e-9, 0.0, 0.0, 0.0]));
        assert_eq!(nearly, image);
    }
}

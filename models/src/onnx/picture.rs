//! Pictures into input tensors: area-averaged or bilinear resampling straight into planar f32, with the manifest's
//! range. One pass, one buffer that the caller keeps.

use image::RgbImage;

use crate::camera::Intrinsics;

use super::manifest::InputSettings;

/// Appends `image`, resampled to `width` × `height`, as three planes (r, g, b) to `out`.
///
/// Pixel centres are at +0.5 in both pictures, so intrinsics scale with [`crate::camera::Intrinsics::resized`].
/// Shrinking averages the covered area (no aliasing), growing interpolates.
pub fn push_planes(image: &RgbImage, width: u32, height: u32, settings: &InputSettings, out: &mut Vec<f32>) {
    let (w, h) = (width as usize, height as usize);
    let start = out.len();
    out.resize(start + 3 * w * h, 0.0);
    let planes = &mut out[start..];
    let scale = (settings.range[1] - settings.range[0]) / 255.0;
    let mut gain = [0.0f32; 3];
    let mut offset = [0.0f32; 3];
    for c in 0..3 {
        gain[c] = scale / settings.std[c];
        offset[c] = (settings.range[0] - settings.mean[c]) / settings.std[c];
    }
    let pixels = image.as_raw();
    if (image.width(), image.height()) == (width, height) {
        let pixels = pixels.as_chunks::<3>().0;
        for (c, plane) in planes.chunks_exact_mut((w * h).max(1)).enumerate() {
            let (gain, offset) = (gain[c], offset[c]);
            plane.iter_mut().zip(pixels).for_each(|(value, rgb)| *value = f32::from(rgb[c]) * gain + offset);
        }
        return;
    }
    let columns = taps(image.width() as usize, w);
    let rows = taps(image.height() as usize, h);
    let stride = image.width() as usize * 3;
    for (y, row) in rows.iter().enumerate() {
        for (x, column) in columns.iter().enumerate() {
            let mut sum = [0.0f32; 3];
            for (j, wy) in row.weights() {
                let line = &pixels[j * stride..(j + 1) * stride];
                for (i, wx) in column.weights() {
                    for c in 0..3 {
                        sum[c] += wy * wx * f32::from(line[i * 3 + c]);
                    }
                }
            }
            for c in 0..3 {
                planes[c * w * h + y * w + x] = sum[c] * gain[c] + offset[c];
            }
        }
    }
}

/// The picture at another size, by the same filter.
pub fn resized(image: &RgbImage, width: u32, height: u32) -> RgbImage {
    if image.dimensions() == (width, height) {
        return image.clone();
    }
    let plain =
        InputSettings { width: None, height: None, multiple: 1, range: [0.0, 255.0], mean: [0.0; 3], std: [1.0; 3] };
    let mut planes = Vec::new();
    push_planes(image, width, height, &plain, &mut planes);
    let n = (width * height) as usize;
    let at = |i: usize| planes[i].round().clamp(0.0, 255.0) as u8;
    RgbImage::from_fn(width, height, |x, y| {
        let i = (y * width + x) as usize;
        image::Rgb([at(i), at(n + i), at(2 * n + i)])
    })
}

/// The largest centred part of a picture that has the shape `width` × `height`, at that size, and its camera.
pub fn center_crop(image: &RgbImage, k: &Intrinsics, width: u32, height: u32) -> (RgbImage, Intrinsics) {
    let (x, y, w, h) = center_window(image.dimensions(), (width, height));
    let part = image::imageops::crop_imm(image, x, y, w, h).to_image();
    let cropped = Intrinsics { width: w, height: h, cx: k.cx - x as f32, cy: k.cy - y as f32, ..*k };
    (resized(&part, width, height), cropped.resized(width, height))
}

/// The largest window of the shape of `wanted` in the middle of a picture of `size`: its left and upper edge, width and height.
pub fn center_window(size: (u32, u32), wanted: (u32, u32)) -> (u32, u32, u32, u32) {
    let ratio = f64::from(wanted.0) / f64::from(wanted.1);
    let w = (f64::from(size.1) * ratio).round().clamp(1.0, f64::from(size.0)) as u32;
    let h = (f64::from(w) / ratio).round().clamp(1.0, f64::from(size.1)) as u32;
    ((size.0 - w) / 2, (size.1 - h) / 2, w, h)
}

/// Source pixels and weights of one target pixel along one axis: a triangle filter as wide as the shrinking factor.
struct Tap {
    first: usize,
    weights: Vec<f32>,
}

impl Tap {
    fn weights(&self) -> impl Iterator<Item = (usize, f32)> + '_ {
        self.weights.iter().enumerate().map(move |(k, &w)| (self.first + k, w))
    }
}

fn taps(from: usize, to: usize) -> Vec<Tap> {
    let ratio = from as f32 / to as f32;
    let radius = ratio.max(1.0);
    (0..to)
        .map(|t| {
            let center = (t as f32 + 0.5) * ratio - 0.5;
            let first = (center - radius).ceil().max(0.0) as usize;
            let last = ((center + radius).floor() as usize).min(from - 1);
            let mut weights: Vec<f32> =
                (first..=last).map(|i| (1.0 - (i as f32 - center).abs() / radius).max(0.0)).collect();
            let sum: f32 = weights.iter().sum();
            if sum > 0.0 {
                weights.iter_mut().for_each(|w| *w /= sum);
            } else {
                weights.iter_mut().for_each(|w| *w = 0.0);
                weights[0] = 1.0;
            }
            Tap { first, weights }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> InputSettings {
        InputSettings { width: None, height: None, multiple: 1, range: [0.0, 1.0], mean: [0.0; 3], std: [1.0; 3] }
    }

    #[test]
    fn resampling_keeps_a_linear_ramp_in_place() {
        let ramp = RgbImage::from_fn(64, 48, |x, y| image::Rgb([(x * 2) as u8, (y * 3) as u8, 100]));
        for (w, h) in [(64, 48), (32, 24), (48, 36), (20, 11), (96, 96)] {
            let mut out = Vec::new();
            push_planes(&ramp, w, h, &settings(), &mut out);
            let (x, y) = (w / 2, h / 2);
            let at = |c: usize| out[c * (w * h) as usize + (y * w + x) as usize] * 255.0;
            let expected = ((x as f32 + 0.5) * 64.0 / w as f32 - 0.5) * 2.0;
            assert!((at(0) - expected).abs() < 0.3, "{w}×{h}: {} {expected}", at(0));
            assert!((at(1) - ((y as f32 + 0.5) * 48.0 / h as f32 - 0.5) * 3.0).abs() < 0.3);
            assert!((at(2) - 100.0).abs() < 1e-3);
        }
    }
}

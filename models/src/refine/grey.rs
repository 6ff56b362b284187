//! What is kept of a key frame's picture: one byte per pixel at the size the network saw.

use std::borrow::Cow;

use glam::{DMat2, DVec2};
use image::{RgbImage, imageops};

use crate::frame_file::AsBytes;
use crate::mask::Mask;

/// Grey value of a pixel that a mask leaves out.
const LEFT_OUT: u8 = 0;
/// Key points keep this far from what is left out, pixels at the network's size: an edge of the aircraft is a corner in every
/// picture, and descriptors come from cells of 8 pixels.
const MARGIN: i32 = 8;

/// Bits of a place beyond whole pixels: what is cut off adds up to a hundred-thousandth of a pixel over a square of 13.
const PLACE_BITS: i32 = 20;
/// Farther than this from its middle a square is drawn pixel by pixel: places up to twice as far, and a half, fit beside those bits.
const FIXED_REACH: f64 = 512.0;

/// Luma of a key frame.
#[derive(Clone)]
pub(crate) struct Grey {
    width: i32,
    height: i32,
    data: Vec<u8>,
    /// Some of the pixels are left out.
    masked: bool,
    /// Pixels here per pixel of the original.
    pub scale: DVec2,
}

impl Grey {
    pub fn new(image: &RgbImage, mask: Option<&Mask>, side: u32) -> Self {
        let small = super::upright::prepare(image, side, 0);
        let mut grey = imageops::grayscale(small.as_ref());
        if let Some(mask) = mask {
            let mask = mask.resized(grey.width(), grey.height());
            for (x, y, value) in grey.enumerate_pixels_mut() {
                value.0[0] = if mask.keeps(x, y) { value.0[0].max(LEFT_OUT + 1) } else { LEFT_OUT };
            }
        }
        let scale = DVec2::new(
            f64::from(grey.width()) / f64::from(image.width()),
            f64::from(grey.height()) / f64::from(image.height()),
        );
        Self {
            width: grey.width() as i32,
            height: grey.height() as i32,
            data: grey.into_raw(),
            masked: mask.is_some(),
            scale,
        }
    }

    /// The picture in grey: what the network makes of colours is nearly the same.
    pub fn picture(&self) -> RgbImage {
        RgbImage::from_fn(self.width as u32, self.height as u32, |x, y| {
            let value = self.data[y as usize * self.width as usize + x as usize];
            image::Rgb([value; 3])
        })
    }

    /// Whether a key point at a place in pixels of the original lies on, and not at the edge of, what is to be learnt.
    pub fn keeps(&self, place: [f32; 2]) -> bool {
        if !self.masked {
            return true;
        }
        let [x, y] = [f64::from(place[0]) * self.scale.x, f64::from(place[1]) * self.scale.y].map(|v| v as i32);
        let range = |at: i32, side: i32| (at - MARGIN).max(0)..(at + MARGIN + 1).min(side);
        let value = |x: i32, y: i32| self.data[y as usize * self.width as usize + x as usize];
        range(y, self.height).all(|v| range(x, self.width).all(|u| value(u, v) != LEFT_OUT))
    }

    /// Bilinear values on a grid of `SIDE` × `SIDE` steps around `center`, its axes mapped by `warp`, row by row; `None` where one of
    /// them lies outside, or beside what is left out.
    pub fn square<const SIDE: usize>(&self, center: DVec2, warp: DMat2, out: &mut [f32]) -> Option<()> {
        let half = SIDE as i32 / 2;
        // Where the corners are inside all of it is.
        let reach = f64::from(half) * (warp.x_axis.abs() + warp.y_axis.abs()) + 1.0;
        let inside = (center - reach).cmpge(DVec2::ZERO).all()
            && (center + reach).cmple(DVec2::new(self.width.into(), self.height.into())).all();
        if !inside || self.masked || reach.max_element() > FIXED_REACH {
            let places = (-half..=half).flat_map(|y| (-half..=half).map(move |x| DVec2::new(x.into(), y.into())));
            for (value, offset) in out.iter_mut().zip(places) {
                *value = self.at(center + warp * offset)? as f32;
            }
            return Some(());
        }
        // Counted from the lowest pixel that is needed, in whole numbers: those are cheap to cut into a pixel and the rest of it.
        let low = (center - reach).floor();
        let from = low.y as usize * self.width as usize + low.x as usize;
        let (data, width) = (self.data.get(from..)?, self.width as usize);
        let fixed = |v: DVec2| (v * f64::from(1 << PLACE_BITS)).round().as_ivec2();
        let (right, down) = (fixed(warp.x_axis), fixed(warp.y_axis));
        let mut start = fixed(center - low - 0.5 - f64::from(half) * (warp.x_axis + warp.y_axis));
        for row in out.as_chunks_mut::<SIDE>().0 {
            // Four pixels and where between them, apart from what is made of them: the second loop is one of vectors.
            let mut seen = [[0u8; 4]; SIDE];
            let mut part = [[0i32; 2]; SIDE];
            let mut at = start;
            for (seen, part) in seen.iter_mut().zip(&mut part) {
                let i = (at.y >> PLACE_BITS) as usize * width + (at.x >> PLACE_BITS) as usize;
                let around = data.get(i..)?.get(..width + 2)?;
                *seen = [around[0], around[1], around[width], around[width + 1]];
                *part = [at.x, at.y].map(|v| v & ((1 << PLACE_BITS) - 1));
                at = at.wrapping_add(right);
            }
            for ((value, seen), part) in row.iter_mut().zip(&seen).zip(&part) {
                let [a, b, c, d] = seen.map(f32::from);
                let [u, v] = part.map(|p| p as f32 * (1.0 / (1 << PLACE_BITS) as f32));
                let (top, low) = (a + (b - a) * u, c + (d - c) * u);
                *value = top + (low - top) * v;
            }
            start = start.wrapping_add(down);
        }
        Some(())
    }

    /// Bilinear value at a place in its own pixels; `None` outside, and beside what is left out.
    pub fn at(&self, p: DVec2) -> Option<f64> {
        let q = p - 0.5;
        let (x, y) = (q.x.floor(), q.y.floor());
        if !(x >= 0.0 && y >= 0.0 && x < f64::from(self.width - 1) && y < f64::from(self.height - 1)) {
            return None;
        }
        let (u, v) = (q.x - x, q.y - y);
        let i = (y as i32 * self.width + x as i32) as usize;
        let w = self.width as usize;
        let d = &self.data;
        if self.masked && [d[i], d[i + 1], d[i + w], d[i + w + 1]].contains(&LEFT_OUT) {
            return None;
        }
        let top = f64::from(d[i]) * (1.0 - u) + f64::from(d[i + 1]) * u;
        let low = f64::from(d[i + w]) * (1.0 - u) + f64::from(d[i + w + 1]) * u;
        Some(top * (1.0 - v) + low * v)
    }
}

/// Width, height, whether some of it is left out, scale.
type Shape = (i32, i32, bool, DVec2);

impl AsBytes for Grey {
    type Shape = Shape;

    fn shape(&self) -> Shape {
        (self.width, self.height, self.masked, self.scale)
    }

    fn to_bytes(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.data)
    }

    fn byte_count((width, height, ..): Shape) -> usize {
        width as usize * height as usize
    }

    fn from_bytes((width, height, masked, scale): Shape, data: Vec<u8>) -> Self {
        Self { width, height, data, masked, scale }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    #[test]
    fn what_is_left_out_has_no_value_and_no_key_point_beside_it() {
        let image = RgbImage::from_pixel(128, 96, image::Rgb([0; 3]));
        let mask = Mask::from_fn(128, 96, |x, _| x < 64);
        // At half the size the edge lies at 32.
        let grey = Grey::new(&image, Some(&mask), 64);
        assert!(grey.at(DVec2::new(31.0, 20.0)).is_some(), "black ground is ground");
        assert!(grey.at(DVec2::new(32.0, 20.0)).is_none() && grey.at(DVec2::new(50.0, 20.0)).is_none());
        assert!(grey.keeps([46.0, 40.0]) && !grey.keeps([50.0, 40.0]) && !grey.keeps([100.0, 40.0]));
        let whole = Grey::new(&image, None, 64);
        assert!(whole.keeps([100.0, 40.0]) && whole.at(DVec2::new(50.0, 20.0)) == Some(0.0));
    }

    #[test]
    fn a_square_has_the_values_of_its_places_and_none_at_the_edge() {
        let image = RgbImage::from_fn(40, 30, |x, y| image::Rgb([(7 * x + 11 * y) as u8; 3]));
        let grey = Grey::new(&image, None, 640);
        let warp = DMat2::from_cols(DVec2::new(0.9, 0.2), DVec2::new(-0.3, 1.1));
        let mut missing = 0;
        for center in (0..400).map(|i| DVec2::new(f64::from(i % 20) * 2.1, f64::from(i / 20) * 1.6)) {
            let mut values = [0.0; 25];
            let square = grey.square::<5>(center, warp, &mut values);
            let places = (0..25).map(|k| center + warp * DVec2::new(f64::from(k % 5 - 2), f64::from(k / 5 - 2)));
            let expected: Option<Vec<f64>> = places.map(|p| grey.at(p)).collect();
            assert_eq!(square.is_some(), expected.is_some(), "{center}");
            let apart = |(a, b): (&f64, &f32)| (a - f64::from(*b)).abs();
            assert!(expected.iter().flatten().zip(&values).map(apart).fold(0.0, f64::max) < 0.01, "{center}");
            missing += usize::from(expected.is_none());
        }
        assert!((50..350).contains(&missing), "{missing}");
    }
}

//! What is kept of a key frame's picture: one byte per pixel at the size the network saw.

use glam::DVec2;
use image::{RgbImage, imageops};

/// Luma of a key frame.
pub(crate) struct Grey {
    width: i32,
    height: i32,
    data: Vec<u8>,
    /// Pixels here per pixel of the original.
    pub scale: DVec2,
}

impl Grey {
    pub fn new(image: &RgbImage, side: u32) -> Self {
        let small = super::upright::prepare(image, side, 0);
        let grey = imageops::grayscale(small.as_ref());
        let scale = DVec2::new(
            f64::from(grey.width()) / f64::from(image.width()),
            f64::from(grey.height()) / f64::from(image.height()),
        );
        Self { width: grey.width() as i32, height: grey.height() as i32, data: grey.into_raw(), scale }
    }

    pub fn bytes(&self) -> usize {
        self.data.len()
    }

    /// The picture in grey: what the network makes of colours is nearly the same.
    pub fn picture(&self) -> RgbImage {
        RgbImage::from_fn(self.width as u32, self.height as u32, |x, y| {
            let value = self.data[y as usize * self.width as usize + x as usize];
            image::Rgb([value; 3])
        })
    }

    /// Bilinear value at a place in its own pixels; `None` outside.
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
        let top = f64::from(d[i]) * (1.0 - u) + f64::from(d[i + 1]) * u;
        let low = f64::from(d[i + w]) * (1.0 - u) + f64::from(d[i + w + 1]) * u;
        Some(top * (1.0 - v) + low * v)
    }
}

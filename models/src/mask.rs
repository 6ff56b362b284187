//! Which pixels of a picture count: all but those where nothing is to be learnt (the aircraft's own parts, sky, water, people).

/// Which pixels of a picture count; a bit each.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    width: u32,
    height: u32,
    kept: Vec<u64>,
}

impl Mask {
    /// Of a picture of `width` × `height`, of which the pixels count for which `keeps` says so.
    pub fn from_fn(width: u32, height: u32, keeps: impl Fn(u32, u32) -> bool) -> Self {
        let mut kept = vec![0; (width as usize * height as usize).div_ceil(64)];
        for y in 0..height {
            for x in 0..width {
                let at = y as usize * width as usize + x as usize;
                kept[at / 64] |= u64::from(keeps(x, y)) << (at % 64);
            }
        }
        Self { width, height, kept }
    }

    /// Width and height, pixels.
    pub fn dimensions(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// Whether a pixel counts; what lies outside does not.
    pub fn keeps(&self, x: u32, y: u32) -> bool {
        let at = y as usize * self.width as usize + x as usize;
        x < self.width && y < self.height && self.kept[at / 64] >> (at % 64) & 1 == 1
    }

    /// Whether the pixel counts in which a place lies, given as shares of width and height; past an edge, the pixel there.
    pub fn keeps_at(&self, [u, v]: [f64; 2]) -> bool {
        let pixel = |share: f64, side: u32| ((share * f64::from(side)).max(0.0) as u32).min(side.saturating_sub(1));
        self.keeps(pixel(u, self.width), pixel(v, self.height))
    }

    /// Whether all pixels count within `margin` of a place, in its own pixels; those outside of the picture are not asked.
    pub fn keeps_around(&self, [x, y]: [f64; 2], margin: f64) -> bool {
        let range = |at: f64, side: u32| {
            let low = (at - margin).clamp(0.0, f64::from(side)) as u32;
            low..((at + margin).clamp(0.0, f64::from(side)).ceil() as u32).max(low)
        };
        range(y, self.height).all(|v| range(x, self.width).all(|u| self.keeps(u, v)))
    }

    /// The mask of the picture at another size: a pixel counts where all of it does.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let share = |at: u32, part: f64, side: u32| (f64::from(at) + part) / f64::from(side);
        Self::from_fn(width, height, |x, y| {
            CORNERS.iter().all(|[a, b]| self.keeps_at([share(x, *a, width), share(y, *b, height)]))
        })
    }

    /// The mask of a window of the picture.
    pub fn window(&self, x: u32, y: u32, width: u32, height: u32) -> Self {
        Self::from_fn(width, height, |u, v| self.keeps(x + u, y + v))
    }

    /// Pixels that count.
    pub fn count(&self) -> usize {
        self.kept.iter().map(|word| word.count_ones() as usize).sum()
    }
}

/// Places within a pixel at which a mask of another size is asked.
pub const CORNERS: [[f64; 2]; 4] = [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_at_another_size_keeps_no_pixel_that_it_left_out() {
        let mask = Mask::from_fn(40, 30, |x, y| !(x > 10 && x < 19 && y < 7));
        for (w, h) in [(40, 30), (20, 15), (10, 8), (80, 60), (41, 31)] {
            let small = mask.resized(w, h);
            for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
                let middle = [(f64::from(x) + 0.5) / f64::from(w), (f64::from(y) + 0.5) / f64::from(h)];
                assert!(!small.keeps(x, y) || mask.keeps_at(middle), "{w}x{h} at {x}, {y}");
            }
            assert!(small.count() > 0 && small.count() < (w * h) as usize);
        }
        assert_eq!(mask.resized(40, 30), mask);
        assert_eq!(mask.window(9, 5, 4, 3).count(), 12 - 4);
        assert!(!mask.keeps(40, 0) && mask.keeps_at([2.0, -1.0]));
        assert!(mask.keeps_around([5.5, 3.5], 4.0) && !mask.keeps_around([5.5, 3.5], 6.0));
    }
}

//! Which windows of a large picture show what a small copy of it cannot.

use image::RgbImage;

/// A window of a picture, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crop {
    /// Left edge.
    pub x: u32,
    /// Upper edge.
    pub y: u32,
    /// Width.
    pub width: u32,
    /// Height.
    pub height: u32,
    /// What is lost of it in a copy of the whole picture that is smaller by the factor asked for: mean square of the difference in
    /// brightness between a pixel and the pixel of the copy, 0…255².
    pub detail: f32,
}

/// Windows of `size` that cover `picture` with as little overlap as that takes, from left to right, then down; each with the
/// detail that a copy `factor` times smaller has lost.
pub fn crops(picture: &RgbImage, size: (u32, u32), factor: u32) -> Vec<Crop> {
    let (columns, rows) = (starts(picture.width(), size.0), starts(picture.height(), size.1));
    let (width, height) = (size.0.min(picture.width()), size.1.min(picture.height()));
    let window =
        |x: u32, y: u32| Crop { x, y, width, height, detail: detail(picture, (x, y), (width, height), factor.max(1)) };
    rows.iter().flat_map(|&y| columns.iter().map(move |&x| (x, y))).map(|(x, y)| window(x, y)).collect()
}

/// The `most` with the most detail, the first ones of equal ones, in the order in which they came.
pub fn finest(crops: &[Crop], most: usize) -> Vec<Crop> {
    let mut chosen: Vec<usize> = (0..crops.len()).collect();
    chosen.sort_by(|&a, &b| crops[b].detail.total_cmp(&crops[a].detail));
    chosen.truncate(most);
    chosen.sort_unstable();
    chosen.into_iter().map(|i| crops[i]).collect()
}

/// Where windows of `side` start that cover `whole` evenly.
fn starts(whole: u32, side: u32) -> Vec<u32> {
    let side = side.clamp(1, whole.max(1));
    let n = whole.div_ceil(side).max(1);
    let last = u64::from(whole - side);
    (0..n).map(|i| if n == 1 { 0 } else { (last * u64::from(i) / u64::from(n - 1)) as u32 }).collect()
}

/// Mean over blocks of `factor` × `factor` pixels of the variance of brightness inside a block.
fn detail(picture: &RgbImage, (x, y): (u32, u32), (width, height): (u32, u32), factor: u32) -> f32 {
    let (mut sum, mut pixels) = (0.0, 0.0);
    for top in (y..y + height).step_by(factor as usize) {
        for left in (x..x + width).step_by(factor as usize) {
            let (right, bottom) = ((left + factor).min(x + width), (top + factor).min(y + height));
            let (mut first, mut second) = (0.0f64, 0.0f64);
            for v in top..bottom {
                for u in left..right {
                    let [r, g, b] = picture.get_pixel(u, v).0.map(f64::from);
                    // Rec. 601.
                    let luma = 0.299 * r + 0.587 * g + 0.114 * b;
                    (first, second) = (first + luma, second + luma * luma);
                }
            }
            let n = f64::from((right - left) * (bottom - top));
            sum += (second - first * first / n).max(0.0);
            pixels += n;
        }
    }
    if pixels > 0.0 { (sum / pixels) as f32 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;

    #[test]
    fn windows_cover_every_pixel_and_lie_inside() {
        for (whole, size) in
            [((1600, 900), (640, 360)), ((640, 480), (640, 480)), ((641, 7), (640, 480)), ((1, 1), (5, 5))]
        {
            let found = crops(&RgbImage::new(whole.0, whole.1), size, 4);
            assert_eq!(
                found.len() as u32,
                whole.0.div_ceil(size.0) * whole.1.div_ceil(size.1),
                "{whole:?} by {size:?}"
            );
            let mut seen = vec![false; (whole.0 * whole.1) as usize];
            for c in &found {
                assert!(c.x + c.width <= whole.0 && c.y + c.height <= whole.1, "{c:?}");
                for v in c.y..c.y + c.height {
                    (c.x..c.x + c.width).for_each(|u| seen[(v * whole.0 + u) as usize] = true);
                }
            }
            assert!(seen.iter().all(|s| *s), "{whole:?} by {size:?}");
        }
    }

    #[test]
    fn detail_is_what_a_smaller_copy_cannot_show() {
        // On the left stripes of one pixel, on the right of four: a copy a quarter as large shows the latter alone.
        let stripe = |x: u32| if x < 64 { x.is_multiple_of(2) } else { (x / 4).is_multiple_of(2) };
        let picture = RgbImage::from_fn(128, 16, |x, _| Rgb(if stripe(x) { [200; 3] } else { [100; 3] }));
        let found = crops(&picture, (64, 16), 4);
        assert!((found[0].detail - 2500.0).abs() < 1e-2 && found[1].detail < 1e-2, "{found:?}");
        assert!(crops(&picture, (64, 16), 8)[1].detail > 2000.0);
        assert_eq!(finest(&found, 1), found[..1]);
        assert_eq!(finest(&found, 5), found);
        assert!(finest(&found, 0).is_empty());
    }

    #[test]
    fn of_windows_without_detail_the_first_are_taken() {
        let found = crops(&RgbImage::new(64, 64), (16, 16), 4);
        assert_eq!(finest(&found, 3), found[..3]);
    }
}

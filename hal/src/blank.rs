//! Pictures that show nothing: a lens cap left on, a blown exposure, a sensor that repeats one value. Noticed on ingest
//! from a few thousand samples, so that none becomes a key frame and takes the place of one that shows the ground.

use image::RgbImage;

/// Samples along each side; the whole picture has at most this many squared.
const GRID: u32 = 64;
/// Brightest of the darkest 95 %: video black (ITU-R BT.601 puts it at 16 of 255).
const BLACK: u8 = 16;
/// Half of the picture at or above this is clipped (a sensor's last levels bend into saturation).
const CLIPPED: u8 = 250;
/// Levels between the darkest and the brightest 5 % of a picture that has contents; JPEG's noise alone makes 1 or 2.
const LEAST_SPREAD: u8 = 4;

/// What is wrong with a picture's light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blank {
    /// Nearly nothing reached the sensor.
    Black,
    /// More than half is clipped.
    Overexposed,
    /// One value everywhere.
    Constant,
}

impl std::fmt::Display for Blank {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Black => "black",
            Self::Overexposed => "overexposed",
            Self::Constant => "of one colour",
        })
    }
}

/// Whether `image`, as it left the camera, shows anything; `None` for a picture with contents.
pub fn blank(image: &RgbImage) -> Option<Blank> {
    let (width, height) = image.dimensions();
    let (columns, rows) = (width.min(GRID), height.min(GRID));
    let mut histogram = [0u32; 256];
    for row in 0..rows {
        for column in 0..columns {
            // The middle of each cell of the grid.
            let x = (u64::from(column) * 2 + 1) * u64::from(width) / (2 * u64::from(columns));
            let y = (u64::from(row) * 2 + 1) * u64::from(height) / (2 * u64::from(rows));
            let [r, g, b] = image.get_pixel(x as u32, y as u32).0.map(u32::from);
            // Rec. 601 luma in 1/256.
            histogram[((77 * r + 150 * g + 29 * b) >> 8).min(255) as usize] += 1;
        }
    }
    let samples = rows * columns;
    if samples == 0 {
        return Some(Blank::Constant);
    }
    let level = |percent: u32| {
        let mut below = 0;
        let at = histogram.iter().position(|n| {
            below += n;
            below * 100 > samples * percent
        });
        at.unwrap_or(255) as u8
    };
    if level(95) <= BLACK {
        Some(Blank::Black)
    } else if level(50) >= CLIPPED {
        Some(Blank::Overexposed)
    } else if level(95) - level(5) < LEAST_SPREAD {
        Some(Blank::Constant)
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    /// Ground of middling contrast, its light multiplied.
    fn ground(gain: f32) -> RgbImage {
        RgbImage::from_fn(200, 150, |x, y| {
            let v = 60.0 + ((x * 7 + y * 13) % 90) as f32;
            Rgb([(v * gain).min(255.0) as u8; 3])
        })
    }

    #[test]
    fn black_overexposed_and_constant_pictures_are_told_from_dark_and_bright_ones() {
        assert_eq!(blank(&ground(1.0)), None);
        assert_eq!(blank(&ground(0.2)), None, "dusk");
        assert_eq!(blank(&ground(2.2)), None, "sand at noon, a third of it clipped");
        assert_eq!(blank(&ground(0.05)), Some(Blank::Black));
        assert_eq!(blank(&ground(8.0)), Some(Blank::Overexposed));
        assert_eq!(blank(&RgbImage::from_pixel(64, 48, Rgb([90, 120, 80]))), Some(Blank::Constant));
        assert_eq!(blank(&RgbImage::from_pixel(1, 1, Rgb([0; 3]))), Some(Blank::Black));
        assert_eq!(blank(&RgbImage::new(0, 0)), Some(Blank::Constant), "nothing at all");
    }

    #[test]
    fn a_few_lights_at_night_do_not_make_a_picture() {
        let mut night = ground(0.05);
        (0..20).for_each(|i| night.put_pixel(i * 9, 70, Rgb([255; 3])));
        assert_eq!(blank(&night), Some(Blank::Black));
    }
}

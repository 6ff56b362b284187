//! Where a map is wrong, to look at: the exact orthophoto, the drawn one and the errors of its heights, side by side.

use std::path::Path;

use disk::Disk;
use image::{Rgb, RgbImage};

use super::Compared;
use runtime::error::JobError;

/// Error of a height that is drawn as strongly as can be, metres.
const FULL_M: f64 = 1.0;
/// Brightness of what is not compared, as a share of the exact orthophoto's.
const DIM: f32 = 0.3;

/// Writes the picture: in the third panel compared pixels go from white (exact) to red (too high) and blue (too low),
/// others show the ground dimly.
///
/// # Errors
/// A full disk.
pub(super) fn write(path: &Path, compared: &Compared, level: &[bool], origin_m: f64) -> Result<(), JobError> {
    let (columns, rows) = (compared.columns as u32, compared.rows as u32);
    let mut picture = RgbImage::new(3 * columns, rows);
    let bytes = |color: [f32; 3]| Rgb(color.map(|v| (v.clamp(0.0, 1.0) * 255.0) as u8));
    for (i, truth) in compared.truth.iter().enumerate() {
        let (x, y) = (i as u32 % columns, i as u32 / columns);
        let drawn = compared.drawn[i];
        let error = drawn.filter(|_| level[i]).map(|_| f64::from(compared.heights[i]) - origin_m - truth.height);
        let panel = match error {
            Some(e) => {
                let strength = (e.abs() / FULL_M).min(1.0) as f32;
                let (same, other) = (1.0, 1.0 - strength);
                if e > 0.0 { [same, other, other] } else { [other, other, same] }
            }
            None => truth.color.map(|c| c * DIM),
        };
        picture.put_pixel(x, y, bytes(truth.color));
        picture.put_pixel(columns + x, y, bytes(drawn.unwrap_or_default()));
        picture.put_pixel(2 * columns + x, y, bytes(panel));
    }
    let mut png = std::io::Cursor::new(Vec::new());
    picture
        .write_to(&mut png, image::ImageFormat::Png)
        .map_err(|e| JobError::System(format!("encoding {}: {e}", path.display())))?;
    let written = Disk::default().replace(path, |out| out.write_all(png.get_ref()));
    written.map_err(|e| JobError::System(format!("{}: {e}", path.display())))
}

//! The headerless `.splat` of the first viewers: 32 bytes a Gaussian: place and size as floats, colour and opacity and rotation as bytes.
//! Read only; it has no directional colours.

use std::path::Path;

use super::{FormatError, read_bounded};
use crate::cloud::{GaussianCloud, SH_C0};

/// Bytes of a Gaussian.
const ROW: usize = 32;
/// Ten million Gaussians.
const LIMIT: u64 = 10_000_000 * ROW as u64;

/// Reads a `.splat`; rows that hold no usable number are left out, and counted.
///
/// # Errors
/// The file cannot be read, or is none: its length is no multiple of 32 bytes, or its numbers are no places and sizes.
pub fn read(path: &Path) -> Result<(GaussianCloud, usize), FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let rows = bytes.as_chunks::<ROW>().0;
    if bytes.is_empty() || !bytes.len().is_multiple_of(ROW) {
        return Err(FormatError::invalid(path, "is no .splat file: its length is no multiple of 32 bytes"));
    }
    let mut cloud = GaussianCloud::with_capacity(0, rows.len());
    let mut unlikely = 0usize;
    for row in rows {
        let float = |k: usize| f32::from_le_bytes([row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3]]);
        let [mean, size] = [0, 3].map(|from| [0, 1, 2].map(|k| float(from + k)));
        unlikely += usize::from(!size.iter().all(|v| (0.0..1e6).contains(v)) || mean.iter().any(|v| v.abs() > 1e9));
        let [r, g, b, a] = [24, 25, 26, 27].map(|k| f32::from(row[k]) / 255.0);
        let opacity = a.clamp(1e-6, 1.0 - 1e-6);
        let rotation = [28, 29, 30, 31].map(|k| (f32::from(row[k]) - 128.0) / 128.0);
        let sh = [r, g, b].map(|v| (v - 0.5) / SH_C0);
        cloud.push(mean, size.map(f32::ln), rotation, (opacity / (1.0 - opacity)).ln(), &sh);
    }
    // A file of another kind has every second number out of any range.
    if 10 * unlikely > rows.len() {
        return Err(FormatError::invalid(path, "is no .splat file: its numbers are no places and sizes of Gaussians"));
    }
    cloud.bring_in_limits();
    let dropped = cloud.drop_invalid();
    Ok((cloud, dropped))
}

//! A small picture of a map for those without a GIS: colours, and heights as a shaded relief.

use std::path::Path;

use disk::Disk;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::grid::{Block, Grid};
use models::formats::FormatError;

/// Longest side, pixels.
const SIDE: u32 = 640;
/// Where the light of the relief comes from: north-west, 45° high (the cartographers' convention).
const LIGHT: [f32; 3] = [-0.5, 0.5, std::f32::consts::FRAC_1_SQRT_2];
/// Brightness of level ground in the relief.
const LEVEL: f32 = 0.75;

/// Pixels of a map of so many columns and rows along a side of one of its small picture.
pub fn preview_step([columns, rows]: [u32; 2]) -> u32 {
    columns.max(rows).div_ceil(SIDE).max(1)
}

/// Means over squares of the map's pixels.
pub(super) struct Preview {
    step: u32,
    width: u32,
    height: u32,
    metres: f32,
    /// Red, green, blue, height and number of the covered pixels of each square.
    sums: Vec<[f32; 5]>,
}

impl Preview {
    pub fn of(grid: &Grid) -> Self {
        let [columns, rows] = grid.size();
        let step = preview_step([columns, rows]);
        let (width, height) = (columns.div_ceil(step), rows.div_ceil(step));
        let metres = (f64::from(step) * grid.gsd()) as f32;
        Self { step, width, height, metres, sums: vec![[0.0; 5]; width as usize * height as usize] }
    }

    /// Adds a block's pixels; `rgba` and `heights` are row by row of the block.
    pub fn add(&mut self, block: Block, rgba: &[u8], heights: &[f32]) {
        for (i, (color, height)) in rgba.chunks_exact(4).zip(heights).enumerate() {
            let (x, y) = (block.x + i as u32 % block.width, block.y + i as u32 / block.width);
            if color[3] > 0 {
                let sum = &mut self.sums[((y / self.step) * self.width + x / self.step) as usize];
                (0..3).for_each(|c| sum[c] += f32::from(color[c]));
                sum[3] += height;
                sum[4] += 1.0;
            }
        }
    }

    /// Writes both pictures.
    pub fn write(&self, disk: &Disk, colors: &Path, relief: &Path) -> Result<(), FormatError> {
        let rgba = self.sums.iter().flat_map(|s| {
            let n = s[4].max(1.0);
            [(s[0] / n) as u8, (s[1] / n) as u8, (s[2] / n) as u8, if s[4] > 0.0 { 255 } else { 0 }]
        });
        self.png(disk, colors, &rgba.collect::<Vec<u8>>(), ExtendedColorType::Rgba8)?;
        let shades: Vec<u8> = (0..self.sums.len()).flat_map(|i| self.shade(i)).collect();
        self.png(disk, relief, &shades, ExtendedColorType::La8)
    }

    fn height(&self, i: usize) -> Option<f32> {
        let s = self.sums.get(i)?;
        (s[4] > 0.0).then(|| s[3] / s[4])
    }

    /// Lambert's shading of the slope towards the eastern and northern neighbour.
    fn shade(&self, i: usize) -> [u8; 2] {
        let Some(here) = self.height(i) else { return [0, 0] };
        let (x, width) = (i % self.width as usize, self.width as usize);
        let east = if x + 1 < width { self.height(i + 1) } else { None };
        let north = i.checked_sub(width).and_then(|i| self.height(i));
        let slope = |other: Option<f32>| (other.unwrap_or(here) - here) / self.metres;
        let normal = [-slope(east), -slope(north), 1.0f32];
        let length = normal.iter().map(|v| v * v).sum::<f32>().sqrt();
        let light = normal.iter().zip(LIGHT).map(|(a, b)| a * b).sum::<f32>() / length;
        [(255.0 * LEVEL * light / LIGHT[2]).clamp(0.0, 255.0) as u8, 255]
    }

    fn png(&self, disk: &Disk, path: &Path, bytes: &[u8], kind: ExtendedColorType) -> Result<(), FormatError> {
        let mut encoded = Vec::new();
        PngEncoder::new(&mut encoded)
            .write_image(bytes, self.width, self.height, kind)
            .map_err(|e| FormatError::invalid(path, format!("cannot be encoded: {e}")))?;
        disk.replace(path, |out| out.write_all(&encoded)).map_err(|e| FormatError::disk(path, e))
    }
}

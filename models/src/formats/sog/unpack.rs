//! Reads a `.sog`, which rounds: what it holds is a scene again, no model to measure by.

use std::collections::HashMap;
use std::io::{Cursor, Read};
use std::path::Path;

use image_webp::WebPDecoder;
use serde::Deserialize;
use zip::ZipArchive;

use super::{ENTRIES_A_ROW, MAX_SIDE, STEPS, VERSION};
use crate::cloud::{GaussianCloud, sh_coefficients};
use crate::formats::{FormatError, one_line, read_bounded};

/// Ten million Gaussians at 20 bytes.
const LIMIT: u64 = 256 << 20;
/// Description of a scene: 768 numbers.
const MAX_META: u64 = 1 << 20;
/// A picture's file at most: all its pixels.
const MAX_PICTURE: u64 = 64 << 20;
/// Most Gaussians read, and those that a file of any size may hold; beyond them a file has a byte for each (real scenes: 8 to 20), so that
/// a small file cannot claim the memory of a city.
const MAX_GAUSSIANS: usize = 10_000_000;
const FREE_GAUSSIANS: usize = 1 << 16;
/// Pixels of the largest palette: 65,536 entries of 15 coefficients.
const PALETTE_PIXELS: usize = 1 << 20;

#[derive(Deserialize)]
struct Meta {
    version: u32,
    count: usize,
    means: Means,
    scales: Coded,
    quats: Files,
    sh0: Coded,
    #[serde(rename = "shN")]
    sh_n: Option<Harmonics>,
}

#[derive(Deserialize)]
struct Means {
    mins: [f32; 3],
    maxs: [f32; 3],
    files: [String; 2],
}

#[derive(Deserialize)]
struct Coded {
    codebook: Vec<f32>,
    files: [String; 1],
}

#[derive(Deserialize)]
struct Files {
    files: [String; 1],
}

#[derive(Deserialize)]
struct Harmonics {
    bands: u8,
    codebook: Vec<f32>,
    files: [String; 2],
}

/// A picture as red, green, blue, alpha.
struct Pixels {
    width: usize,
    rgba: Vec<u8>,
}

impl Pixels {
    fn at(&self, i: usize) -> Option<[u8; 4]> {
        self.rgba.get(4 * i..4 * i + 4)?.first_chunk().copied()
    }
}

/// Reads a `.sog` file; rows that hold no usable number are left out, and counted.
///
/// # Errors
/// The file cannot be read, or is no scene of version 2 in one zip.
pub fn read(path: &Path) -> Result<(GaussianCloud, usize), FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    let bad = |what: &str| FormatError::invalid(path, format!("is no SOG file that can be read: {what}"));
    let limit = bytes.len().clamp(FREE_GAUSSIANS, MAX_GAUSSIANS);
    let mut zip = ZipArchive::new(Cursor::new(bytes)).map_err(|e| bad(&one_line(e)))?;
    let mut file = |name: &str, limit: u64| -> Result<Vec<u8>, FormatError> {
        let entry = zip.by_name(name).map_err(|e| bad(&format!("{name}: {}", one_line(e))))?;
        let mut bytes = Vec::new();
        entry.take(limit).read_to_end(&mut bytes).map_err(|e| bad(&format!("{name}: {e}")))?;
        Ok(bytes)
    };
    let meta = file("meta.json", MAX_META)?;
    let meta: Meta = serde_json::from_slice(&meta).map_err(|e| bad(&format!("meta.json: {e}")))?;
    if meta.version != VERSION {
        return Err(bad(&format!("it is version {}, of which 2 can be read", meta.version)));
    }
    if meta.count > limit {
        let (size, limit) = (meta.count as u64, limit as u64);
        return Err(FormatError::TooLarge { path: path.to_owned(), what: "its number of Gaussians", size, limit });
    }
    if meta.scales.codebook.len() < 256 || meta.sh0.codebook.len() < 256 {
        return Err(bad("its description is damaged"));
    }
    let mut pictures: HashMap<String, Pixels> = HashMap::new();
    let palette = meta.sh_n.iter().flat_map(|sh| &sh.files);
    let names = meta.means.files.iter().chain(&meta.scales.files).chain(&meta.quats.files).chain(&meta.sh0.files);
    for name in names.chain(palette) {
        let most = 2 * meta.count + PALETTE_PIXELS;
        let picture = picture(file(name, MAX_PICTURE)?, most)
            .ok_or_else(|| bad(&format!("{name} is no picture, or far larger than its scene")))?;
        pictures.insert(name.clone(), picture);
    }
    let of = |name: &String, i: usize| pictures.get(name).and_then(|p| p.at(i));
    let degree = meta.sh_n.as_ref().map_or(0, |sh| sh.bands);
    if degree > 3 || meta.sh_n.as_ref().is_some_and(|sh| sh.codebook.len() < 256) {
        return Err(bad("its directional colours are damaged"));
    }
    let coefficients = sh_coefficients(degree) - 1;
    if meta.count > 0 && meta.means.files.iter().any(|name| of(name, meta.count - 1).is_none()) {
        return Err(bad("a picture is too small"));
    }
    let mut cloud = GaussianCloud::with_capacity(degree, meta.count);
    let mut sh = vec![0.0; cloud.sh_stride()];
    for i in 0..meta.count {
        let row = (|| {
            let (low, high) = (of(&meta.means.files[0], i)?, of(&meta.means.files[1], i)?);
            let (size, turn) = (of(&meta.scales.files[0], i)?, of(&meta.quats.files[0], i)?);
            let color = of(&meta.sh0.files[0], i)?;
            let mean = [0, 1, 2].map(|k| {
                let share = f32::from(u16::from_le_bytes([low[k], high[k]])) / STEPS;
                let v = meta.means.mins[k] + (meta.means.maxs[k] - meta.means.mins[k]) * share;
                v.signum() * v.abs().exp_m1()
            });
            (0..3).for_each(|c| sh[c] = meta.sh0.codebook[usize::from(color[c])]);
            if let Some(harmonics) = &meta.sh_n {
                let [low, high, ..] = of(&harmonics.files[1], i)?;
                let entry = usize::from(u16::from_le_bytes([low, high]));
                let centroids = pictures.get(&harmonics.files[0])?;
                let start = entry / ENTRIES_A_ROW * centroids.width + entry % ENTRIES_A_ROW * coefficients;
                for k in 0..coefficients {
                    let pixel = centroids.at(start + k)?;
                    (0..3).for_each(|c| sh[3 + 3 * k + c] = harmonics.codebook[usize::from(pixel[c])]);
                }
            }
            let opacity = (f32::from(color[3]) / 255.0).clamp(1e-6, 1.0 - 1e-6);
            Some((mean, [0, 1, 2].map(|k| meta.scales.codebook[usize::from(size[k])]), unpack_rotation(turn)?, opacity))
        })();
        let Some((mean, log_scale, rotation, opacity)) = row else { return Err(bad("a picture is too small")) };
        cloud.push(mean, log_scale, rotation, (opacity / (1.0 - opacity)).ln(), &sh);
    }
    cloud.bring_in_limits();
    let dropped = cloud.drop_invalid();
    Ok((cloud, dropped))
}

/// The pixels of a picture that has `most` at most.
fn picture(bytes: Vec<u8>, most: usize) -> Option<Pixels> {
    let mut decoder = WebPDecoder::new(Cursor::new(bytes)).ok()?;
    let (width, height) = decoder.dimensions();
    if width.max(height) as usize > MAX_SIDE || width as usize * height as usize > most {
        return None;
    }
    let mut pixels = vec![0; decoder.output_buffer_size()?];
    decoder.read_image(&mut pixels).ok()?;
    let rgba = match decoder.has_alpha() {
        true => pixels,
        false => pixels.as_chunks::<3>().0.iter().flat_map(|[r, g, b]| [*r, *g, *b, u8::MAX]).collect(),
    };
    Some(Pixels { width: width as usize, rgba })
}

/// w x y z.
fn unpack_rotation([a, b, c, which]: [u8; 4]) -> Option<[f32; 4]> {
    let largest = usize::from(which.checked_sub(252)?);
    let parts = [a, b, c].map(|v| (f32::from(v) / 255.0 - 0.5) * std::f32::consts::SQRT_2);
    let left = (1.0 - parts.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    let mut others = parts.into_iter();
    Some(std::array::from_fn(|i| if i == largest { left } else { others.next().unwrap_or_default() }))
}

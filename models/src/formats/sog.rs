//! PlayCanvas' SOG, version 2: a zip of lossless WebP pictures with a Gaussian per pixel, a tenth of the PLY. For viewers
//! in a browser; it rounds, so a model to go on with is exchanged as `.dgtr` or PLY.
//!
//! Positions are 16 bits of sign · ln(1 + |x|) between the scene's bounds, so that they are finest around zero: the cloud is
//! moved there, and [`Sog::shift`] says by how much. Scales, plain colours and the palette of directional colours are indices of
//! 256 values each (`codebook`), directional colours indices of up to 65,536 rows (`palette`). Rows come in Morton order, which
//! is what the pictures are packed by. Source: PlayCanvas' "The SOG Format", and `splat-transform` where it is silent.

use std::io::{Cursor, Write};
use std::ops::Range;
use std::path::Path;

use glam::{Quat, Vec3};
use image_webp::{ColorType, EncoderParams, WebPEncoder};
use serde::Serialize;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::{FormatError, write_atomic};
use crate::cloud::{GaussianCloud, sh_coefficients};
use crate::morton::{BITS, morton};
use codebook::Codebook;
use palette::Palette;

mod codebook;
mod palette;
pub mod streamed;
mod unpack;

pub use unpack::read;

const VERSION: u32 = 2;
const GENERATOR: &str = concat!("dgtr ", env!("CARGO_PKG_VERSION"));
/// Most rows of the palette: a label is 16 bits.
const MAX_PALETTE: usize = 1 << 16;
/// Palette entries side by side in their picture.
const ENTRIES_A_ROW: usize = 64;
/// Steps of a coordinate.
const STEPS: f32 = 65_535.0;
/// Most pixels along a side of a WebP picture.
const MAX_SIDE: usize = 16_383;

/// A packed scene.
pub struct Sog {
    /// The file.
    pub bytes: Vec<u8>,
    /// What is to be added to the file's coordinates for the cloud's, metres.
    pub shift: [f32; 3],
    /// Gaussians in it.
    pub count: usize,
}

#[derive(Serialize)]
struct Meta<'a> {
    version: u32,
    asset: Asset,
    count: usize,
    means: Means,
    scales: Coded<'a>,
    quats: Files,
    sh0: Coded<'a>,
    #[serde(rename = "shN", skip_serializing_if = "Option::is_none")]
    sh_n: Option<Harmonics<'a>>,
}

#[derive(Serialize)]
struct Asset {
    generator: &'static str,
}

#[derive(Serialize)]
struct Means {
    mins: [f32; 3],
    maxs: [f32; 3],
    files: [&'static str; 2],
}

#[derive(Serialize)]
struct Coded<'a> {
    codebook: &'a [f32],
    files: [&'static str; 1],
}

#[derive(Serialize)]
struct Files {
    files: [&'static str; 1],
}

#[derive(Serialize)]
struct Harmonics<'a> {
    count: usize,
    bands: u8,
    codebook: &'a [f32],
    files: [&'static str; 2],
}

/// Writes `cloud`, atomically; what is to be added to the file's coordinates.
///
/// # Errors
/// Errors of [`encode`], else the operating system's.
pub fn write(path: &Path, cloud: &GaussianCloud) -> Result<Sog, FormatError> {
    let sog = encode(path, cloud)?;
    write_atomic(path, |out| out.write_all(&sog.bytes))?;
    Ok(sog)
}

/// Packs `cloud`; `path` is what errors name.
///
/// # Errors
/// [`FormatError::Invalid`] for a cloud that is empty, has numbers that are not finite, or is larger than a picture can be.
pub fn encode(path: &Path, cloud: &GaussianCloud) -> Result<Sog, FormatError> {
    // In whole metres, so that nobody reads meaning into digits.
    let shift = cloud.middle().map(|v| v.round() + 0.0);
    let failed = |e: std::io::Error| FormatError::io(path, "packing", e);
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in pack(path, cloud, &morton_order(cloud, 0..cloud.len()), shift)? {
        let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        zip.start_file(name, stored).map_err(|e| failed(e.into()))?;
        zip.write_all(&bytes).map_err(failed)?;
    }
    let bytes = zip.finish().map_err(|e| failed(e.into()))?.into_inner();
    Ok(Sog { bytes, shift, count: cloud.len() })
}

/// The files of a scene by name, `meta.json` last: the rows of `cloud` in `order`, their means less `shift`.
///
/// # Errors
/// As [`encode`].
fn pack(
    path: &Path,
    cloud: &GaussianCloud,
    order: &[u32],
    shift: [f32; 3],
) -> Result<Vec<(&'static str, Vec<u8>)>, FormatError> {
    if cloud.is_empty() || !(0..cloud.len()).all(|i| cloud.is_valid(i)) {
        return Err(FormatError::invalid(
            path,
            "a SOG file needs Gaussians, with finite numbers only; train the model first",
        ));
    }
    let size = picture_size(order.len());
    if size.0.max(size.1) > MAX_SIDE {
        return Err(FormatError::invalid(path, "holds more Gaussians than a WebP picture has pixels; export to ply"));
    }
    let failed = |e: std::io::Error| FormatError::io(path, "packing", e);
    let mut files = Vec::new();
    let mut add = |name: &'static str, picture: Picture| {
        files.push((name, picture.encode().map_err(failed)?));
        Ok::<(), FormatError>(())
    };
    let picture = |fill: &dyn Fn(usize) -> [u8; 4]| Picture::of(size, order.iter().map(|i| fill(*i as usize)));

    let means: Vec<[f32; 3]> = cloud.means.iter().map(|m| [0, 1, 2].map(|k| to_log(m[k] - shift[k]))).collect();
    let (mut mins, mut maxs) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for (m, k) in means.iter().flat_map(|m| (0..3).map(move |k| (m, k))) {
        (mins[k], maxs[k]) = (mins[k].min(m[k]), maxs[k].max(m[k]));
    }
    let fixed = |i: usize| {
        [0, 1, 2].map(|k| {
            let range = maxs[k] - mins[k];
            let share = if range > 0.0 { (means[i][k] - mins[k]) / range } else { 0.0 };
            ((STEPS * share).round() as u16).to_le_bytes()
        })
    };
    let byte_of_means = |b: usize| move |v: [[u8; 2]; 3]| [v[0][b], v[1][b], v[2][b], u8::MAX];
    add("means_l.webp", picture(&|i| byte_of_means(0)(fixed(i))))?;
    add("means_u.webp", picture(&|i| byte_of_means(1)(fixed(i))))?;

    let scales = Codebook::of(cloud.log_scales.iter().flatten().copied());
    let scale = |i: usize| cloud.log_scales[i].map(|v| scales.index(v));
    add("scales.webp", picture(&|i| opaque(scale(i))))?;
    add("quats.webp", picture(&|i| pack_rotation(cloud.rotations[i])))?;

    let stride = cloud.sh_stride();
    let plain = |i: usize| [0, 1, 2].map(|c| cloud.sh[i * stride + c]);
    let colors = Codebook::of((0..cloud.len()).flat_map(plain));
    let color = |i: usize| {
        let [r, g, b] = plain(i).map(|v| colors.index(v));
        [r, g, b, (255.0 / (1.0 + (-cloud.opacity_logits[i]).exp())).round() as u8]
    };
    add("sh0.webp", picture(&color))?;

    let palette = (cloud.sh_degree > 0).then(|| {
        let row = |i: usize| &cloud.sh[i * stride + 3..(i + 1) * stride];
        // As splat-transform: as many as a power of two below the number of Gaussians.
        let size = MAX_PALETTE.min(1 << cloud.len().ilog2());
        let palette = Palette::of(cloud.len(), stride - 3, size, &row);
        let book = Codebook::of(palette.entries.iter().copied());
        (palette, book)
    });
    if let Some((palette, book)) = &palette {
        add("shN_centroids.webp", entries(palette, book, cloud.sh_degree))?;
        let label = |i: usize| {
            let [low, high, ..] = palette.labels[i].to_le_bytes();
            [low, high, 0, u8::MAX]
        };
        add("shN_labels.webp", picture(&label))?;
    }
    let meta = Meta {
        version: VERSION,
        asset: Asset { generator: GENERATOR },
        count: order.len(),
        means: Means { mins, maxs, files: ["means_l.webp", "means_u.webp"] },
        scales: Coded { codebook: scales.values(), files: ["scales.webp"] },
        quats: Files { files: ["quats.webp"] },
        sh0: Coded { codebook: colors.values(), files: ["sh0.webp"] },
        sh_n: palette.as_ref().map(|(palette, book)| Harmonics {
            count: palette.entries.len() / (stride - 3),
            bands: cloud.sh_degree,
            codebook: book.values(),
            files: ["shN_centroids.webp", "shN_labels.webp"],
        }),
    };
    files.push(("meta.json", serde_json::to_vec(&meta).map_err(|e| failed(e.into()))?));
    Ok(files)
}

fn to_log(v: f32) -> f32 {
    v.signum() * v.abs().ln_1p()
}

/// `rows` in Morton order.
fn morton_order(cloud: &GaussianCloud, rows: Range<usize>) -> Vec<u32> {
    let (low, high) = cloud.means[rows.clone()].iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), m| {
        (low.min(Vec3::from_array(*m)), high.max(Vec3::from_array(*m)))
    });
    let cell = ((high - low) / ((1u32 << BITS) - 1) as f32).max(Vec3::splat(f32::MIN_POSITIVE));
    let key = |i: u32| {
        let at = (Vec3::from_array(cloud.means[i as usize]) - low) / cell;
        morton(at.x as u32, at.y as u32, at.z as u32)
    };
    let mut order: Vec<(u64, u32)> = rows.map(|i| (key(i as u32), i as u32)).collect();
    order.sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// Nearly square, sides of whole fours, as splat-transform makes them.
fn picture_size(count: usize) -> (usize, usize) {
    let width = ((count as f64).sqrt().ceil() as usize).next_multiple_of(4);
    (width, count.div_ceil(width).next_multiple_of(4))
}

fn opaque([r, g, b]: [u8; 3]) -> [u8; 4] {
    [r, g, b, u8::MAX]
}

/// The three smaller components, each a byte of ±1/√2, and in the fourth which one is left out (252 = w … 255 = z).
fn pack_rotation([w, x, y, z]: [f32; 4]) -> [u8; 4] {
    let q = Quat::from_xyzw(x, y, z, w).normalize();
    let q = [q.w, q.x, q.y, q.z];
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let mut packed = [0, 0, 0, 252 + largest as u8];
    for (byte, i) in packed.iter_mut().zip((0..4).filter(|i| *i != largest)) {
        let part = q[i] * q[largest].signum() * std::f32::consts::SQRT_2;
        *byte = ((part * 0.5 + 0.5).clamp(0.0, 1.0) * 255.0).round() as u8;
    }
    packed
}

/// The palette's picture: 64 entries a row, a pixel for each coefficient above degree 0.
fn entries(palette: &Palette, book: &Codebook, degree: u8) -> Picture {
    let coefficients = sh_coefficients(degree) - 1;
    let pixels = palette.entries.as_chunks::<3>().0.iter().map(|v| opaque(v.map(|v| book.index(v))));
    let rows = (palette.entries.len() / 3 / coefficients).div_ceil(ENTRIES_A_ROW);
    Picture::of((ENTRIES_A_ROW * coefficients, rows), pixels)
}

struct Picture {
    width: u32,
    height: u32,
    rgba: Vec<u8>,
}

impl Picture {
    /// Pixels in reading order; those that are left stay zero.
    fn of((width, height): (usize, usize), pixels: impl Iterator<Item = [u8; 4]>) -> Self {
        let mut rgba = Vec::with_capacity(4 * width * height);
        pixels.for_each(|p| rgba.extend(p));
        rgba.resize(4 * width * height, 0);
        Self { width: width as u32, height: height as u32, rgba }
    }

    /// Lossless WebP, with or without prediction from the row above, whichever is shorter: indices have no neighbours.
    fn encode(&self) -> std::io::Result<Vec<u8>> {
        let encode = |use_predictor_transform| {
            let mut bytes = Vec::new();
            let mut encoder = WebPEncoder::new(&mut bytes);
            let mut params = EncoderParams::default();
            params.use_predictor_transform = use_predictor_transform;
            encoder.set_params(params);
            encoder.encode(&self.rgba, self.width, self.height, ColorType::Rgba8).map_err(std::io::Error::other)?;
            std::io::Result::Ok(bytes)
        };
        let (with, without) = rayon::join(|| encode(true), || encode(false));
        let (with, without) = (with?, without?);
        Ok(if with.len() < without.len() { with } else { without })
    }
}

//! Niantic's SPZ: a byte for a number (three per coordinate), about a tenth of the PLY. For viewers; it rounds, so a model to go on with
//! is exchanged as `.dgtr` or PLY. Versions 2 and 3 are a gzip stream, version 4 a table of zstd streams; 3 is written unless 4 is asked
//! for.
//!
//! After the header, column by column: positions (24-bit fixed point), opacities, DC colours, log scales, rotations, SH above degree 0
//! (source: the format's own README and `load-spz.cc`; version 4: files of `splat-transform`). The format's axes are right, up, back; a
//! PLY's, by the same convention, right, down, front. Programs that convert between them turn the scene by half a turn about x, and so
//! does this one ([`Axes::Rub`]), so that a scene's PLY and SPZ show the same in every viewer.

use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::Path;

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use ruzstd::decoding::StreamingDecoder;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use super::{FormatError, write_atomic};
use crate::cloud::{GaussianCloud, sh_coefficients};

const MAGIC: u32 = 0x5053_474E; // "NGSP"
const VERSION: u32 = 3;
const LATEST: u32 = 4;
const HEADER_BYTES: usize = 16;
/// Where the table of streams of version 4 lies, and how far behind the header others may put it.
const TABLE: usize = 32;
const MOST_EXTENSIONS: usize = 1 << 20;
/// Bit of the flags.
const ANTIALIASED: u8 = 1;
/// A Gaussian so many times farther from the middle than this share of all is a stray.
const STRAY: f32 = 20.0;
const NEARLY_ALL: f64 = 0.99;
/// Most Gaussians read, 640 MiB unpacked at SH degree 3: ten times the largest scene of the paper.
const MAX_GAUSSIANS: u64 = 10_000_000;
/// Gaussians that a file of any size may hold, 20 MiB with the buffers of reading; beyond them a file has at least a byte for
/// each (real scenes: 9 to 20 bytes), so that a small file of zeros cannot claim the memory of a city.
const FREE_GAUSSIANS: u64 = 1 << 16;
/// Fractional bits of a coordinate where the scene allows it: 0.24 mm over ±2 km.
const FRACTIONAL_BITS: u8 = 12;
/// Greatest 24-bit coordinate.
const MAX_FIXED: f32 = 8_388_607.0;
/// DC coefficient → byte. Smaller than 0.282, so that colours beyond [0, 1] survive.
const COLOUR_SCALE: f32 = 0.15;
/// Magnitude of one of the three smaller quaternion components: nine bits of 1/√2.
const QUATERNION_STEPS: u32 = 511;

/// Which way the coordinates of a file point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Axes {
    /// Right, up, back, as the format wants them: half a turn about x from the model's.
    #[default]
    Rub,
    /// The model's axes, as a PLY has them.
    Own,
}

/// How a file is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SpzOptions {
    /// Axes of the file.
    pub axes: Axes,
    /// Version 4 instead of 3.
    pub is_latest: bool,
}

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SpzWritten {
    /// What is to be added to the file's coordinates, once they have the model's axes: zero but for scenes far from their origin.
    pub shift: [f32; 3],
    /// Gaussians left out because they lie far from all others, which would have cost everybody's precision.
    pub strays: usize,
}

/// What an SPZ file held.
#[derive(Clone, Debug)]
pub struct SpzModel {
    /// The Gaussians.
    pub cloud: GaussianCloud,
    /// Rows left out because they hold no usable number.
    pub dropped: usize,
    /// Trained for a renderer that makes Gaussians fainter where it widens them to a pixel (Mip-Splatting).
    pub is_antialiased: bool,
}

/// Writes `cloud`, atomically.
///
/// # Errors
/// [`FormatError::Invalid`] when a mean is not finite or the scene is larger than 16,776 km; else the operating system's.
pub fn write(path: &Path, cloud: &GaussianCloud, options: SpzOptions) -> Result<SpzWritten, FormatError> {
    let (bits, shift, near) = fixed_point(cloud)
        .ok_or_else(|| FormatError::invalid(path, "SPZ holds coordinates up to 8,388 km only; export to ply"))?;
    let count = u32::try_from(near.len()).map_err(|_| FormatError::invalid(path, "more Gaussians than SPZ counts"))?;
    let mut kept = cloud.rows(&near);
    kept.means.iter_mut().for_each(|m| *m = [0, 1, 2].map(|k| m[k] - shift[k]));
    if options.axes == Axes::Rub {
        turn_about_x(&mut kept);
    }
    let columns = columns(&kept, bits);
    let tail = [kept.sh_degree, bits, 0];
    write_atomic(path, |file| match options.is_latest {
        false => {
            let mut out = GzEncoder::new(file, Compression::default());
            for word in [MAGIC, VERSION, count] {
                out.write_all(&word.to_le_bytes())?;
            }
            out.write_all(&tail)?;
            out.write_all(&[0])?;
            columns.iter().try_for_each(|column| out.write_all(column))?;
            out.finish().map(drop)
        }
        true => {
            for word in [MAGIC, LATEST, count] {
                file.write_all(&word.to_le_bytes())?;
            }
            file.write_all(&tail)?;
            file.write_all(&[columns.len() as u8])?;
            file.write_all(&(TABLE as u32).to_le_bytes())?;
            file.write_all(&[0; TABLE - HEADER_BYTES - 4])?;
            let packed = columns.iter().map(|c| compress_to_vec(c.as_slice(), CompressionLevel::Fastest));
            let packed: Vec<Vec<u8>> = packed.collect();
            for (packed, column) in packed.iter().zip(&columns) {
                file.write_all(&(packed.len() as u64).to_le_bytes())?;
                file.write_all(&(column.len() as u64).to_le_bytes())?;
            }
            packed.iter().try_for_each(|packed| file.write_all(packed))
        }
    })?;
    Ok(SpzWritten { shift, strays: cloud.len() - near.len() })
}

/// The columns of a file; that of SH is missing where there is none.
fn columns(cloud: &GaussianCloud, bits: u8) -> Vec<Vec<u8>> {
    let (stride, scale) = (cloud.sh_stride(), (1u32 << bits) as f32);
    let fixed = |v: &f32| ((v * scale).round() as i32).to_le_bytes();
    let rows = || cloud.sh.chunks_exact(stride);
    let mut columns = vec![
        cloud.means.iter().flatten().flat_map(|v| fixed(v).into_iter().take(3)).collect(),
        cloud.opacity_logits.iter().map(|v| byte(255.0 / (1.0 + (-v).exp()))).collect(),
        rows().flat_map(|sh| [0, 1, 2].map(|c| byte(255.0 * (sh[c] * COLOUR_SCALE + 0.5)))).collect(),
        cloud.log_scales.iter().flatten().map(|v| byte((v + 10.0) * 16.0)).collect(),
        cloud.rotations.iter().flat_map(|q| pack_rotation(*q).to_le_bytes()).collect(),
    ];
    if stride > 3 {
        // Five bits for degree 1, four above: what compresses well and is not seen.
        let packed = |(i, v): (usize, &f32)| pack_sh(*v, if i < 12 { 8 } else { 16 });
        columns.push(rows().flat_map(|sh| sh.iter().enumerate().skip(3).map(packed)).collect());
    }
    columns
}

/// Turns a scene by half a turn about x: what leads from one of the two conventions into the other, and back.
fn turn_about_x(cloud: &mut GaussianCloud) {
    // Signs of x y z, and of the products of them that SH above degree 0 are even or odd in (`sh_basis`).
    const Y: f32 = -1.0;
    const SIGNS: [f32; 15] = [Y, Y, 1.0, Y, 1.0, 1.0, Y, 1.0, Y, 1.0, Y, Y, 1.0, Y, 1.0];
    cloud.means.iter_mut().for_each(|[_, y, z]| (*y, *z) = (-*y, -*z));
    // The axes of a Gaussian have no sign.
    cloud.rotations.iter_mut().for_each(|[_, _, y, z]| (*y, *z) = (-*y, -*z));
    let stride = cloud.sh_stride();
    for row in cloud.sh.chunks_exact_mut(stride) {
        row.iter_mut().skip(3).enumerate().for_each(|(i, v)| *v *= SIGNS[i / 3]);
    }
}

/// Reads an SPZ file whose coordinates have these axes.
///
/// # Errors
/// As [`FormatError`] says; nothing is allocated before the header was checked against the file's size.
pub fn read(path: &Path, axes: Axes) -> Result<SpzModel, FormatError> {
    let mut file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let size = file.metadata().map_err(|e| FormatError::io(path, "reading", e))?.len();
    let mut magic = [0; 4];
    file.read_exact(&mut magic).map_err(|e| read_error(path, "its header", e))?;
    file.seek(SeekFrom::Start(0)).map_err(|e| FormatError::io(path, "reading", e))?;
    let is_open = u32::from_le_bytes(magic) == MAGIC;
    let file = BufReader::new(file);
    let mut input: Box<dyn Read> = if is_open { Box::new(file) } else { Box::new(GzDecoder::new(file)) };
    let mut head = [0u8; HEADER_BYTES];
    input.read_exact(&mut head).map_err(|e| read_error(path, "its header", e))?;
    let word = |i: usize| u32::from_le_bytes([head[i], head[i + 1], head[i + 2], head[i + 3]]);
    let (version, count, degree, bits) = (word(4), u64::from(word(8)), head[12], head[13]);
    if word(0) != MAGIC {
        return Err(FormatError::invalid(path, "is not an SPZ file (wrong first word)"));
    }
    if !matches!((version, is_open), (2 | 3, false) | (LATEST, true)) {
        return Err(FormatError::invalid(path, format!("is SPZ version {version}; 2, 3 and 4 can be read")));
    }
    if degree > 3 || bits > 23 {
        return Err(FormatError::invalid(path, format!("has SH degree {degree} and {bits} fractional bits; damaged?")));
    }
    let limit = size.clamp(FREE_GAUSSIANS, MAX_GAUSSIANS);
    if count > limit {
        let what = "its number of Gaussians";
        return Err(FormatError::TooLarge { path: path.to_owned(), what, size: count, limit });
    }
    let (n, rest) = (count as usize, 3 * sh_coefficients(degree) - 3);
    let turn = if version == 2 { 3 } else { 4 };
    let wanted = [
        (9, "its positions"),
        (1, "its opacities"),
        (3, "its colours"),
        (3, "its scales"),
        (turn, "its rotations"),
        (rest, "its spherical harmonics"),
    ];
    let streams = if is_open { table(path, &mut input, head[15])? } else { Vec::new() };
    let mut of = Vec::with_capacity(wanted.len());
    for (k, (bytes, what)) in wanted.into_iter().enumerate() {
        let mut column = Vec::new();
        // Grows with what is there, not with what the header claims.
        let got = match (is_open, streams.get(k)) {
            (false, _) => input.by_ref().take((n * bytes) as u64).read_to_end(&mut column),
            (true, Some(&packed)) => {
                let mut part = input.by_ref().take(packed);
                let decoder = StreamingDecoder::new(&mut part).map_err(|_| broken(path, what))?;
                let got = decoder.take((n * bytes) as u64).read_to_end(&mut column);
                std::io::copy(&mut part, &mut std::io::sink()).map_err(|e| read_error(path, what, e))?;
                got
            }
            (true, None) => Ok(0),
        };
        match got {
            Ok(got) if got == n * bytes => of.push(column),
            Ok(_) => return Err(broken(path, what)),
            Err(e) => return Err(read_error(path, what, e)),
        }
    }
    let [means, opacities, colours, scales, rotations, harmonics] = &of[..] else {
        return Err(broken(path, "its columns"));
    };
    let mut cloud = GaussianCloud::with_capacity(degree, n);
    let mut sh = vec![0.0; rest + 3];
    let unit = 1.0 / (1u32 << bits) as f32;
    for i in 0..n {
        let coordinate = |k: usize| {
            let b = &means[9 * i + 3 * k..];
            // The sign bit is the 24th: up to the top of the word and back down.
            ((i32::from_le_bytes([0, b[0], b[1], b[2]])) >> 8) as f32 * unit
        };
        let opacity = (f32::from(opacities[i]) / 255.0).clamp(1e-6, 1.0 - 1e-6);
        for c in 0..3 {
            sh[c] = (f32::from(colours[3 * i + c]) / 255.0 - 0.5) / COLOUR_SCALE;
        }
        for (k, v) in harmonics[rest * i..rest * (i + 1)].iter().enumerate() {
            sh[3 + k] = (f32::from(*v) - 128.0) / 128.0;
        }
        cloud.push(
            [coordinate(0), coordinate(1), coordinate(2)],
            std::array::from_fn(|k| f32::from(scales[3 * i + k]) / 16.0 - 10.0),
            unpack_rotation(&rotations[turn * i..turn * (i + 1)]),
            (opacity / (1.0 - opacity)).ln(),
            &sh,
        );
    }
    if axes == Axes::Rub {
        turn_about_x(&mut cloud);
    }
    let dropped = cloud.drop_invalid();
    Ok(SpzModel { cloud, dropped, is_antialiased: head[14] & ANTIALIASED != 0 })
}

/// Bytes of the packed streams of version 4; reads on to the first of them.
fn table(path: &Path, input: &mut dyn Read, streams: u8) -> Result<Vec<u64>, FormatError> {
    const WHAT: &str = "its table of streams";
    let mut word = |n: usize| {
        let mut bytes = vec![0; n];
        input.read_exact(&mut bytes).map(|()| bytes).map_err(|e| read_error(path, WHAT, e))
    };
    let at = word(4)?.first_chunk().map_or(0, |b| u32::from_le_bytes(*b)) as usize;
    let Some(passed) = at.checked_sub(HEADER_BYTES + 4).filter(|n| *n < MOST_EXTENSIONS) else {
        return Err(broken(path, WHAT));
    };
    word(passed)?;
    let mut packed = Vec::with_capacity(streams.into());
    for _ in 0..streams {
        packed.push(word(16)?.first_chunk().map_or(0, |b| u64::from_le_bytes(*b)));
    }
    Ok(packed)
}

fn broken(path: &Path, what: &str) -> FormatError {
    FormatError::invalid(path, format!("is no whole SPZ file: {what} cannot be read; copy it again"))
}

fn read_error(path: &Path, what: &str, e: std::io::Error) -> FormatError {
    match e.kind() {
        ErrorKind::UnexpectedEof | ErrorKind::InvalidInput | ErrorKind::InvalidData => broken(path, what),
        _ => FormatError::io(path, "reading", e),
    }
}

fn byte(v: f32) -> u8 {
    v.round().clamp(0.0, 255.0) as u8
}

/// Fractional bits, what is taken off the means before, and the rows that then fit; `None` where a mean is no number or the scene too
/// large. A scene around its origin stays where it is, and as precise as its farthest mean allows; where that costs bits, the middle is
/// moved to the origin and rows are left out that lie [`STRAY`] times farther from it than nearly all.
fn fixed_point(cloud: &GaussianCloud) -> Option<(u8, [f32; 3], Vec<u32>)> {
    if cloud.means.iter().flatten().any(|v| !v.is_finite()) {
        return None;
    }
    let away = |shift: [f32; 3], m: &[f32; 3]| (0..3).map(|k| (m[k] - shift[k]).abs()).fold(0.0, f32::max);
    let bits = |farthest: f32| {
        (0..=FRACTIONAL_BITS).rev().find(|b| f64::from(farthest) * f64::from(1u32 << b) <= f64::from(MAX_FIXED))
    };
    let all = |shift| cloud.means.iter().map(|m| away(shift, m)).fold(0.0, f32::max);
    let rows = || (0..cloud.len() as u32).collect::<Vec<u32>>();
    let as_it_is = bits(all([0.0; 3]));
    if as_it_is == Some(FRACTIONAL_BITS) {
        return Some((FRACTIONAL_BITS, [0.0; 3], rows()));
    }
    let shift = cloud.middle().map(|v| v.round() + 0.0);
    let mut distances: Vec<f32> = cloud.means.iter().map(|m| away(shift, m)).collect();
    let nearly_all = ((distances.len() as f64 * NEARLY_ALL) as usize).min(distances.len().saturating_sub(1));
    let usual = *distances.select_nth_unstable_by(nearly_all, f32::total_cmp).1;
    let reach = (STRAY * usual).max(1.0);
    let near: Vec<u32> = rows().into_iter().filter(|&i| away(shift, &cloud.means[i as usize]) <= reach).collect();
    let farthest = near.iter().map(|&i| away(shift, &cloud.means[i as usize])).fold(0.0, f32::max);
    let moved = bits(farthest)?;
    match as_it_is {
        Some(bits) if bits >= moved => Some((bits, [0.0; 3], rows())),
        _ => Some((moved, shift, near)),
    }
}

fn pack_sh(v: f32, bucket: i32) -> u8 {
    let q = (v * 128.0).round() as i32 + 128;
    ((q + bucket / 2).div_euclid(bucket) * bucket).clamp(0, 255) as u8
}

/// Index of the largest of x y z w, then the other three: a sign bit and nine bits each.
fn pack_rotation(wxyz: [f32; 4]) -> u32 {
    let q = glam::Quat::from_xyzw(wxyz[1], wxyz[2], wxyz[3], wxyz[0]).normalize().to_array();
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    (0..4).filter(|i| *i != largest).fold(largest as u32, |packed, i| {
        let negative = u32::from((q[i] < 0.0) != (q[largest] < 0.0));
        let steps = (QUATERNION_STEPS as f32 * q[i].abs() * std::f32::consts::SQRT_2).round() as u32;
        packed << 10 | negative << 9 | steps.min(QUATERNION_STEPS)
    })
}

/// w x y z of a version 2 (three bytes) or version 3 (four bytes) rotation.
fn unpack_rotation(packed: &[u8]) -> [f32; 4] {
    let mut q = [0.0f32; 4]; // x y z w
    let left_over = |q: &[f32; 4]| (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    if let &[a, b, c, d] = packed {
        let mut word = u32::from_le_bytes([a, b, c, d]);
        let largest = (word >> 30) as usize;
        for i in (0..4).rev().filter(|i| *i != largest) {
            let size = (word & QUATERNION_STEPS) as f32 / QUATERNION_STEPS as f32 * std::f32::consts::FRAC_1_SQRT_2;
            q[i] = if word >> 9 & 1 == 1 { -size } else { size };
            word >>= 10;
        }
        q[largest] = left_over(&q);
    } else {
        for (v, b) in q.iter_mut().zip(packed) {
            *v = f32::from(*b) / 127.5 - 1.0;
        }
        q[3] = left_over(&q);
    }
    [q[3], q[0], q[1], q[2]]
}

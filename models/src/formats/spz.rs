//! Niantic's SPZ, version 3: a gzip stream of one byte per number (three per coordinate), about a tenth of the PLY.
//! For viewers; it rounds, so a model to go on with is exchanged as `.dgtr` or PLY. Versions 2 and 3 are read.
//!
//! After 16 bytes of header, column by column: positions (24-bit fixed point), opacities, DC colours, log scales,
//! rotations, SH above degree 0 (source: the format's own README and `load-spz.cc`). The axes are kept as they are, like
//! the PLY's: east, north, up.

use std::io::{BufReader, ErrorKind, Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

use super::{FormatError, write_atomic};
use crate::cloud::{GaussianCloud, sh_coefficients};

const MAGIC: u32 = 0x5053_474E; // "NGSP"
const VERSION: u32 = 3;
const HEADER_BYTES: usize = 16;
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

/// What an SPZ file held.
#[derive(Clone, Debug)]
pub struct SpzModel {
    /// The Gaussians.
    pub cloud: GaussianCloud,
    /// Rows left out because they hold no usable number.
    pub dropped: usize,
}

/// Writes `cloud`, atomically, in its own axes.
///
/// # Errors
/// [`FormatError::Invalid`] when a mean is not finite or farther than 8,388 km from the origin.
pub fn write(path: &Path, cloud: &GaussianCloud) -> Result<(), FormatError> {
    let bits = fractional_bits(cloud)
        .ok_or_else(|| FormatError::invalid(path, "SPZ holds coordinates up to 8,388 km only; export to ply"))?;
    let count = u32::try_from(cloud.len()).map_err(|_| FormatError::invalid(path, "more Gaussians than SPZ counts"))?;
    let stride = cloud.sh_stride();
    write_atomic(path, |file| {
        let mut out = GzEncoder::new(file, Compression::default());
        out.write_all(&MAGIC.to_le_bytes())?;
        out.write_all(&VERSION.to_le_bytes())?;
        out.write_all(&count.to_le_bytes())?;
        out.write_all(&[cloud.sh_degree, bits, 0, 0])?;
        let scale = (1u32 << bits) as f32;
        for v in cloud.means.iter().flatten() {
            out.write_all(&((v * scale).round() as i32).to_le_bytes()[..3])?;
        }
        for v in &cloud.opacity_logits {
            out.write_all(&[byte(255.0 / (1.0 + (-v).exp()))])?;
        }
        for sh in cloud.sh.chunks_exact(stride) {
            out.write_all(&[0, 1, 2].map(|c| byte(255.0 * (sh[c] * COLOUR_SCALE + 0.5))))?;
        }
        for v in cloud.log_scales.iter().flatten() {
            out.write_all(&[byte((v + 10.0) * 16.0)])?;
        }
        for q in &cloud.rotations {
            out.write_all(&pack_rotation(*q).to_le_bytes())?;
        }
        for sh in cloud.sh.chunks_exact(stride) {
            for (i, v) in sh.iter().enumerate().skip(3) {
                // Five bits for degree 1, four above: what compresses well and is not seen.
                out.write_all(&[pack_sh(*v, if i < 12 { 8 } else { 16 })])?;
            }
        }
        out.finish().map(drop)
    })
}

/// Reads an SPZ file.
///
/// # Errors
/// As [`FormatError`] says; nothing is allocated before the header was checked against the file's size.
pub fn read(path: &Path) -> Result<SpzModel, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let size = file.metadata().map_err(|e| FormatError::io(path, "reading", e))?.len();
    let mut input = GzDecoder::new(BufReader::new(file));
    let mut head = [0u8; HEADER_BYTES];
    input.read_exact(&mut head).map_err(|e| read_error(path, "its header", e))?;
    let word = |i: usize| u32::from_le_bytes([head[i], head[i + 1], head[i + 2], head[i + 3]]);
    let (version, count, degree, bits) = (word(4), u64::from(word(8)), head[12], head[13]);
    if word(0) != MAGIC {
        return Err(FormatError::invalid(path, "is not an SPZ file (wrong first word)"));
    }
    if !matches!(version, 2 | 3) {
        return Err(FormatError::invalid(path, format!("is SPZ version {version}; 2 and 3 can be read")));
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
    // Grows with what is there, not with what the header claims.
    let mut column = |bytes: usize, what| {
        let mut column = Vec::new();
        match input.by_ref().take((n * bytes) as u64).read_to_end(&mut column) {
            Ok(got) if got == n * bytes => Ok(column),
            Ok(_) => Err(broken(path, what)),
            Err(e) => Err(read_error(path, what, e)),
        }
    };
    let means = column(9, "its positions")?;
    let opacities = column(1, "its opacities")?;
    let colours = column(3, "its colours")?;
    let scales = column(3, "its scales")?;
    let rotations = column(turn, "its rotations")?;
    let harmonics = column(rest, "its spherical harmonics")?;
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
    let dropped = cloud.drop_invalid();
    Ok(SpzModel { cloud, dropped })
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

/// As many fractional bits as the farthest mean allows; `None` where even whole metres do not fit.
fn fractional_bits(cloud: &GaussianCloud) -> Option<u8> {
    let farthest =
        cloud.means.iter().flatten().fold(0.0f32, |a, v| if v.is_nan() { f32::INFINITY } else { a.max(v.abs()) });
    (0..=FRACTIONAL_BITS).rev().find(|b| farthest * (1u32 << b) as f32 <= MAX_FIXED)
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

//! The `.dgtr` model file: checkpoint on board, what is sent to the ground, and the global model.
//!
//! ```text
//! magic "dgtr\r\n\x1a\n" (8) · version u32 · header bytes u32 · Gaussians u64 · SH degree u32
//! header (postcard)
//! version 1, exact: means 3N f32 · log scales 3N · rotations 4N (w x y z) · opacity logits N · sh N·D·3
//! BLAKE3 of everything before (32)
//!
//! version 4, quantised in cells: side f32 · cells u32 · per cell, the most important first: level u8 · y i32 · x i32 · Gaussians u32 ·
//!     words u32 · importance f32 · BLAKE3 of its words (32) · of its coarse layer Gaussians u32 · words u32 · BLAKE3 (32)
//! BLAKE3 of everything before (32) · the words of all coarse layers, u32 of the delivery encoding (`super::delivery`) · those of the cells.
//!     Whatever part of the file is there shows the whole scene ([`read_what_is_there`])
//! ```
//!
//! All little-endian. The magic's line ends betray a transfer as text, what is allocated follows from the fixed part and
//! the file's size, and the hash covers every byte.

use std::io::Write;
use std::path::Path;

use disk::Disk;
use geometry::geodesy::Geodetic;
use serde::{Deserialize, Serialize};

use super::delivery::Rounding;
use super::reconstruction::LocalFrame;
use super::{FormatError, write_atomic};
use crate::camera::View;
use crate::cloud::{GaussianCloud, sh_coefficients};
use crate::light::PictureLight;
use celled::Cells;
use chunks::compare;
use columns::{read_cloud, write_floats};
use hashing::Hashing;
use opening::{Body, Opened, open, read_header_of};

mod celled;
mod chunks;
pub mod columns;
mod hashing;
mod opening;
mod partial;

pub use celled::{pieces, write_cells};
pub use chunks::{Chunks, Pieces, open_checkpoint, piece_bytes, write_checkpoint_pieces, write_chunks, write_columns};
pub use partial::{Partial, read_what_is_there};

const MAGIC: [u8; 8] = *b"dgtr\r\n\x1a\n";
/// Columns as they are.
const EXACT: u32 = 1;
/// The delivery encoding, cell by cell, the coarse layers of all cells before them.
const CELLED: u32 = 4;
const FIXED: u64 = 28;
const HASH: u64 = 32;
/// A header holds 130 bytes per view; this is room for 100,000 of them and long names.
pub const MAX_HEADER: u64 = 64 << 20;
/// Corners of a region taken, far more than any field has.
const MAX_CORNERS: usize = 4096;

/// What a model file says about itself besides its Gaussians.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ModelHeader {
    /// Name of the mission; empty when trained from a data set by hand.
    pub mission: String,
    /// Who trained it; the ground writes `global`.
    pub aircraft: String,
    /// WGS-84 origin of the ENU frame the Gaussians live in; `None` when the frame is not georeferenced.
    pub origin: Option<Geodetic>,
    /// Polygon of the area this model answers for, ENU metres; empty = everything.
    pub region: Vec<[f64; 2]>,
    /// Training views by picture name, with their (refined) poses.
    pub views: Vec<(String, View)>,
    /// Optimiser steps taken so far, over all continuations.
    pub steps: u64,
    /// Zeros.
    pub reserved: [u8; 8],
    /// Seed of the random choices.
    pub seed: u64,
    /// Whether the job that writes this file had reached its goal; false in checkpoints.
    pub finished: bool,
    /// The light of each training view's picture, in their order, which is not in the Gaussians; empty: it was even.
    pub lights: Vec<PictureLight>,
    /// Whether Gaussians have been taken out of it for delivery; such a model is not thinned a second time when it is continued.
    pub thinned: bool,
    /// How the coordinates that the pictures' poses came in became those of the Gaussians; `None`: they are the same.
    pub local: Option<LocalFrame>,
}

/// Writes a model whole or not at all.
///
/// # Errors
/// [`FormatError::Invalid`] for a cloud whose columns differ in length and for a header that [`read`] would refuse, else the
/// operating system's.
pub fn write(path: &Path, header: &ModelHeader, cloud: &GaussianCloud) -> Result<(), FormatError> {
    let content = content(path, header, cloud)?;
    write_atomic(path, content)
}

/// As [`write()`], through `disk`, and the checkpoint before stays as the older of two generations.
///
/// # Errors
/// Errors of [`write()`].
pub fn write_checkpoint(
    disk: &Disk,
    path: &Path,
    header: &ModelHeader,
    cloud: &GaussianCloud,
) -> Result<(), FormatError> {
    let content = content(path, header, cloud)?;
    disk.replace_keeping(path, content).map_err(|e| FormatError::disk(path, e))
}

/// The newest of the two generations that [`write_checkpoint`] keeps and that can be read. What cannot be read is set aside
/// and named in a warning.
///
/// # Errors
/// A damaged file that cannot be set aside: the folder is not writable.
pub fn read_checkpoint(disk: &Disk, path: &Path) -> Result<Option<(ModelHeader, GaussianCloud)>, FormatError> {
    let newest = disk.newest(path, read).map_err(|e| FormatError::io(path, "setting aside", e))?;
    newest.damaged.iter().for_each(|d| tracing::warn!("{d}"));
    Ok(newest.found)
}

/// Writes a model rounded, for delivery: about a thirtieth of the exact file, through `disk`, whole or not at all. Gives the
/// number of Gaussians it holds.
///
/// # Errors
/// Errors of [`write()`].
pub fn write_rounded(
    disk: &Disk,
    path: &Path,
    header: &ModelHeader,
    cloud: &GaussianCloud,
    rounding: &Rounding,
) -> Result<usize, FormatError> {
    write_cells(disk, path, header, cloud, rounding, &|_, _| true)
}

/// What fills the file of a model.
fn content<'a>(
    path: &Path,
    header: &ModelHeader,
    cloud: &'a GaussianCloud,
) -> Result<impl FnOnce(&mut dyn Write) -> std::io::Result<()> + use<'a>, FormatError> {
    check_columns(path, cloud)?;
    let head = encode_header(path, header)?;
    Ok(move |file: &mut dyn Write| {
        let mut out = begin(file, EXACT, &head, cloud.len(), cloud.sh_degree)?;
        for column in columns::of(cloud) {
            write_floats(&mut out, column)?;
        }
        finish(out).map(drop)
    })
}

fn check_columns(path: &Path, cloud: &GaussianCloud) -> Result<(), FormatError> {
    let n = cloud.len();
    let columns_fit = cloud.log_scales.len() == n
        && cloud.rotations.len() == n
        && cloud.opacity_logits.len() == n
        && cloud.sh_degree <= 3
        && cloud.sh.len() == n * cloud.sh_stride();
    if columns_fit {
        return Ok(());
    }
    Err(FormatError::invalid(path, "not written: the cloud's columns differ in length"))
}

/// A header's bytes (postcard). `path` is what an error names.
///
/// # Errors
/// One that [`decode_header`] would refuse.
pub fn encode_header(path: &Path, header: &ModelHeader) -> Result<Vec<u8>, FormatError> {
    check_header(path, header)?;
    let head = postcard::to_allocvec(header)
        .map_err(|e| FormatError::invalid(path, format!("not written: its header cannot be encoded ({e})")))?;
    if head.len() as u64 > MAX_HEADER {
        let (size, limit) = (head.len() as u64, MAX_HEADER);
        return Err(FormatError::TooLarge { path: path.to_owned(), what: "its header", size, limit });
    }
    Ok(head)
}

/// Everything before the Gaussians.
fn begin<'a>(
    file: &'a mut dyn Write,
    version: u32,
    head: &[u8],
    n: usize,
    sh_degree: u8,
) -> std::io::Result<Hashing<&'a mut dyn Write>> {
    let mut out = Hashing { inner: file, hasher: blake3::Hasher::new() };
    out.write_all(&MAGIC)?;
    out.write_all(&version.to_le_bytes())?;
    out.write_all(&(head.len() as u32).to_le_bytes())?;
    out.write_all(&(n as u64).to_le_bytes())?;
    out.write_all(&u32::from(sh_degree).to_le_bytes())?;
    out.write_all(head)?;
    Ok(out)
}

fn finish(out: Hashing<&mut dyn Write>) -> std::io::Result<&mut dyn Write> {
    let hash = out.hasher.finalize();
    out.inner.write_all(hash.as_bytes())?;
    Ok(out.inner)
}

/// Reads and verifies a model. Gaussians that hold a number that is not finite are dropped and their number logged.
///
/// # Errors
/// As [`FormatError`] says; nothing is allocated that the file's own size and stated bounds do not cover.
pub fn read(path: &Path) -> Result<(ModelHeader, GaussianCloud), FormatError> {
    read_with_hash(path).map(|(header, cloud, _)| (header, cloud))
}

/// As [`read`], with the BLAKE3 of the content, by which the same model is known again.
///
/// # Errors
/// Errors of [`read`].
pub fn read_with_hash(path: &Path) -> Result<(ModelHeader, GaussianCloud, [u8; 32]), FormatError> {
    let mut opened = open(path)?;
    let header = read_header_of(path, &mut opened)?;
    let Opened { mut input, count, sh_degree, body, size, .. } = opened;
    let mut cloud = GaussianCloud { sh_degree, ..Default::default() };
    let failed = |e| FormatError::io(path, "reading", e);
    let mut cells = None;
    match body {
        Body::Cells => cells = Some(Cells::read(path, &mut input, count, size - FIXED - header.len() as u64)?),
        Body::Columns => cloud = read_cloud(&mut input, sh_degree, count).map_err(failed)?,
    }
    let hash = compare(path, &mut input)?;
    if let Some(cells) = cells {
        cells.each(path, &mut input.inner, sh_degree, &mut |cell| {
            cloud.extend(&cell);
            Ok::<(), FormatError>(())
        })?;
    }
    let header = decode_header(path, &header)?;
    let dropped = cloud.drop_invalid();
    if dropped > 0 {
        tracing::warn!("{}: {dropped} Gaussians hold numbers that are not finite and were dropped", path.display());
    }
    Ok((header, cloud, hash))
}

/// The header and the number of Gaussians alone, without the time to verify the columns: enough to list models.
///
/// # Errors
/// As [`read`]; the checksum is not compared.
pub fn read_header(path: &Path) -> Result<(ModelHeader, usize), FormatError> {
    let mut opened = open(path)?;
    let header = read_header_of(path, &mut opened)?;
    Ok((decode_header(path, &header)?, opened.count))
}

/// Bytes that the Gaussians of a model take as exact columns, in memory or in a file, whatever this file takes.
///
/// # Errors
/// As [`read_header`].
pub fn unpacked_bytes(path: &Path) -> Result<u64, FormatError> {
    let opened = open(path)?;
    Ok(opened.count as u64 * exact_bytes(opened.sh_degree))
}

/// Bytes of a Gaussian as exact columns.
fn exact_bytes(sh_degree: u8) -> u64 {
    4 * (11 + 3 * sh_coefficients(sh_degree) as u64)
}

/// The header that these bytes hold.
///
/// # Errors
/// [`FormatError::Invalid`]: it cannot be decoded, or a later stage could not work with it.
pub fn decode_header(path: &Path, bytes: &[u8]) -> Result<ModelHeader, FormatError> {
    // A header without a frame may end before it: "none" is one byte.
    let header: ModelHeader = postcard::from_bytes(bytes)
        .or_else(|e| postcard::from_bytes(&[bytes, &[0]].concat()).map_err(|_| e))
        .map_err(|e| FormatError::invalid(path, format!("its header cannot be decoded ({e})")))?;
    check_header(path, &header)?;
    Ok(header)
}

/// Refuses what a later stage would size a buffer by, or place something at: a model comes from another machine.
fn check_header(path: &Path, header: &ModelHeader) -> Result<(), FormatError> {
    let bad = |what: String| Err(FormatError::invalid(path, format!("{what}; a dgtr does not write such a model")));
    if let Some((name, view)) = header.views.iter().find(|(_, view)| !view.is_usable()) {
        let k = &view.intrinsics;
        return bad(format!("its view {name:?} of {} x {} pixels has no usable camera or pose", k.width, k.height));
    }
    let lights = header.lights.len();
    if ![0, header.views.len()].contains(&lights) || !header.lights.iter().all(PictureLight::is_usable) {
        return bad(format!("it states the light of {lights} of {} views, or one that cannot be", header.views.len()));
    }
    if header.region.len() > MAX_CORNERS || header.region.iter().flatten().any(|v| !v.is_finite()) {
        return bad(format!("its region has {} corners, or one that is not a number", header.region.len()));
    }
    if header.origin.is_some_and(|o| !o.is_valid()) {
        return bad("its origin is no place on the earth".to_owned());
    }
    if header.local.is_some_and(|local| !local.is_usable()) {
        return bad("its frame is no shift and scale".to_owned());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_page_on_formats_states_these_versions() {
        let row = format!("| `.dgtr` model file | {} exact, {} quantised in cells |", super::EXACT, super::CELLED);
        assert!(include_str!("../../FORMATS.md").contains(&row), "{row}");
    }
}

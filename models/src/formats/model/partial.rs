//! The part of a file that is there: a transfer that goes on, or one that ended early.

use std::path::Path;

use super::celled::Cells;
use super::chunks::compare;
use super::opening::{Body, Opened, open_to};
use super::{FIXED, FormatError, ModelHeader, decode_header, read, read_header_of};
use crate::cloud::GaussianCloud;

/// How much of a model in layers was there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Partial {
    /// Cells of the whole.
    pub cells: usize,
    /// Those that are there.
    pub whole: usize,
    /// Of the others those whose coarse layer stands for them.
    pub coarse: usize,
}

/// As [`read`], and of a file in layers that is cut short what is there: cells as they are, and for those that are not their coarse
/// layers. For who looks at a model, not for who goes on with it.
///
/// # Errors
/// Errors of [`read`], which anything is that is not cut short behind its index.
pub fn read_what_is_there(path: &Path) -> Result<(ModelHeader, GaussianCloud, Option<Partial>), FormatError> {
    match read(path) {
        Ok((header, cloud)) => Ok((header, cloud, None)),
        Err(whole @ (FormatError::Truncated { .. } | FormatError::TooLarge { .. })) => part(path)?.ok_or(whole),
        Err(e) => Err(e),
    }
}

fn part(path: &Path) -> Result<Option<(ModelHeader, GaussianCloud, Option<Partial>)>, FormatError> {
    let mut opened = open_to(path, false)?;
    let Body::Cells = opened.body else { return Ok(None) };
    let header = read_header_of(path, &mut opened)?;
    let Opened { mut input, count, sh_degree, size, .. } = opened;
    let left = size - FIXED - header.len() as u64;
    let (index, room) = Cells::read_index(path, &mut input, count, left)?;
    compare(path, &mut input)?;
    let cells = index.count();
    let (mut cloud, [whole, coarse]) = index.there(path, &mut input.inner, sh_degree, room)?;
    let partial = Partial { cells, whole, coarse: coarse.saturating_sub(whole) };
    tracing::warn!(
        "{}: is cut short: {whole} of {cells} cells are there, and coarse layers of {} more",
        path.display(),
        partial.coarse
    );
    cloud.drop_invalid();
    Ok(Some((decode_header(path, &header)?, cloud, Some(partial))))
}

//! Columns of numbers to and from a file, a piece at a time.

use std::io::{Read, Write};

use crate::cloud::{GaussianCloud, sh_coefficients};

/// Columns of a cloud.
pub const COLUMNS: usize = 5;
/// Numbers moved at a time.
const CHUNK: usize = 16 << 10;

/// Numbers that a Gaussian of this degree has in each column: mean, log scale, rotation, opacity logit, SH.
pub const fn floats(sh_degree: u8) -> [usize; COLUMNS] {
    [3, 3, 4, 1, 3 * sh_coefficients(sh_degree)]
}

/// The columns of a cloud, in the order of a file.
pub fn of(cloud: &GaussianCloud) -> [&[f32]; COLUMNS] {
    [
        cloud.means.as_flattened(),
        cloud.log_scales.as_flattened(),
        cloud.rotations.as_flattened(),
        &cloud.opacity_logits,
        &cloud.sh,
    ]
}

/// The cloud of `count` Gaussians whose columns follow each other in `input`. The caller has bounded `count`.
///
/// # Errors
/// The reader's; `input` ends too early.
pub fn read_cloud(input: &mut impl Read, sh_degree: u8, count: usize) -> std::io::Result<GaussianCloud> {
    let of = floats(sh_degree);
    let mut column = |k: usize| read_words(input, of[k] * count, f32::from_le_bytes);
    Ok(GaussianCloud {
        sh_degree,
        means: triples(column(0)?),
        log_scales: triples(column(1)?),
        rotations: column(2)?.as_chunks().0.to_vec(),
        opacity_logits: column(3)?,
        sh: column(4)?,
    })
}

pub(super) fn triples(flat: Vec<f32>) -> Vec<[f32; 3]> {
    flat.as_chunks().0.to_vec()
}

/// Writes numbers, little-endian.
///
/// # Errors
/// The writer's.
pub fn write_floats(out: &mut impl Write, values: &[f32]) -> std::io::Result<()> {
    let mut buffer = Vec::with_capacity(4 * CHUNK.min(values.len()));
    for chunk in values.chunks(CHUNK) {
        buffer.clear();
        buffer.extend(chunk.iter().flat_map(|v| v.to_le_bytes()));
        out.write_all(&buffer)?;
    }
    Ok(())
}

pub(super) fn read_words<T>(input: &mut impl Read, n: usize, word: fn([u8; 4]) -> T) -> std::io::Result<Vec<T>> {
    let mut values = Vec::with_capacity(n);
    let mut buffer = vec![0; 4 * CHUNK.min(n)];
    while values.len() < n {
        let bytes = &mut buffer[..4 * CHUNK.min(n - values.len())];
        input.read_exact(bytes)?;
        values.extend(bytes.as_chunks().0.iter().map(|b| word(*b)));
    }
    Ok(values)
}

//! Columns of numbers to and from a file, a piece at a time.

use std::io::{Read, Write};

/// Numbers moved at a time.
const CHUNK: usize = 16 << 10;

pub(super) fn triples(flat: Vec<f32>) -> Vec<[f32; 3]> {
    flat.as_chunks().0.to_vec()
}

pub(super) fn write_floats(out: &mut impl Write, values: &[f32]) -> std::io::Result<()> {
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

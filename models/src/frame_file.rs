//! What waits of a key frame: in memory, or, on long flights, in a file.

use std::borrow::Cow;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A file of its own that many frames are kept in, one behind the other.
#[derive(Debug)]
pub struct FrameFile {
    file: File,
    end: AtomicU64,
}

impl FrameFile {
    /// In an empty file.
    pub fn new(file: File) -> Arc<Self> {
        Arc::new(Self { file, end: AtomicU64::new(0) })
    }
}

/// What can be kept as bytes.
pub trait AsBytes: Clone {
    /// What is known of it beside its bytes.
    type Shape: Copy + std::fmt::Debug + PartialEq;
    fn shape(&self) -> Self::Shape;
    fn to_bytes(&self) -> Cow<'_, [u8]>;
    /// As many bytes as one of this shape has.
    fn byte_count(shape: Self::Shape) -> usize;
    fn from_bytes(shape: Self::Shape, bytes: Vec<u8>) -> Self;
}

/// A value here or there.
#[derive(Debug)]
pub enum Kept<T: AsBytes> {
    Memory(T),
    File { file: Arc<FrameFile>, at: u64, shape: T::Shape },
}

impl<T: AsBytes> Kept<T> {
    /// In `file`, or in memory where there is none.
    pub fn new(value: T, file: Option<&Arc<FrameFile>>) -> io::Result<Self> {
        let Some(file) = file else { return Ok(Self::Memory(value)) };
        let bytes = value.to_bytes();
        let at = file.end.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        file.file.write_all_at(&bytes, at)?;
        Ok(Self::File { file: Arc::clone(file), at, shape: value.shape() })
    }

    /// As [`Self::new`]; what cannot be written stays in memory.
    pub fn at_best(value: T, file: Option<&Arc<FrameFile>>) -> Self {
        Self::new(value.clone(), file).unwrap_or_else(|e| {
            tracing::warn!("the file of what waits of key frames: {}; until then it is kept in memory", disk::told(&e));
            Self::Memory(value)
        })
    }

    /// Bytes it takes of the memory.
    pub fn bytes_in_memory(&self) -> usize {
        match self {
            Self::Memory(value) => T::byte_count(value.shape()),
            Self::File { .. } => 0,
        }
    }

    /// Another value in its place; one of the same shape takes no more of the file.
    pub fn replace(&mut self, value: T) -> io::Result<()> {
        match self {
            Self::File { file, at, shape } if *shape == value.shape() => file.file.write_all_at(&value.to_bytes(), *at),
            Self::File { file, .. } => {
                let file = Arc::clone(file);
                *self = Self::new(value, Some(&file))?;
                Ok(())
            }
            Self::Memory(own) => {
                *own = value;
                Ok(())
            }
        }
    }

    pub fn get(&self) -> io::Result<Cow<'_, T>> {
        match self {
            Self::Memory(value) => Ok(Cow::Borrowed(value)),
            Self::File { file, at, shape } => {
                let mut bytes = vec![0; T::byte_count(*shape)];
                file.file.read_exact_at(&mut bytes, *at)?;
                Ok(Cow::Owned(T::from_bytes(*shape, bytes)))
            }
        }
    }
}

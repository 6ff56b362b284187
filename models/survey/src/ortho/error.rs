//! Why a map cannot be drawn or written.

use std::path::PathBuf;

use config::error::{Error, ErrorKind};

use models::formats::FormatError;

/// Why a map cannot be drawn or written.
#[derive(Debug, thiserror::Error)]
pub enum OrthoError {
    /// A reference system that is not known, or not one to draw maps in.
    #[error("EPSG:{code}: {why}; leave it out for the UTM zone of the scene")]
    Epsg {
        /// The code.
        code: u16,
        /// What is wrong with it.
        why: &'static str,
    },
    /// A reference system for a scene that is nowhere on Earth.
    #[error("EPSG:{0}: the model has no origin on Earth; leave the code out for a map in its own metres")]
    NoOrigin(u16),
    /// A scene that is nowhere on Earth, whose cameras do not tell its vertical.
    #[error(
        "this scene has no up: its cameras are neither level nor do they look down its z axis; say which axis points up (--up y, --up=-y, …)"
    )]
    NoUp,
    /// An axis for a scene that knows its vertical.
    #[error("--up: the model has an origin on Earth, and its z axis points up; leave it out")]
    KnownUp,
    /// A place outside of what the reference system describes.
    #[error("east {east_m:.0} m, north {north_m:.0} m of the origin is outside of the map's reference system")]
    Outside {
        /// East of the model's origin.
        east_m: f64,
        /// North of it.
        north_m: f64,
    },
    /// A pixel size or bounds that make no map.
    #[error("{0}")]
    Request(String),
    /// What the TIFF writer says.
    #[error("{}: {source}", path.display())]
    Tiff {
        /// The file.
        path: PathBuf,
        /// The writer's reason.
        source: geotiff_writer::Error,
    },
    /// A file cannot be written.
    #[error(transparent)]
    File(#[from] FormatError),
}

impl Error for OrthoError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::File(e) => e.kind(),
            Self::Tiff { source: geotiff_writer::Error::Io(e), .. } => Error::kind(e),
            Self::Tiff { .. } => ErrorKind::Failed,
            _ => ErrorKind::Input,
        }
    }
}

//! From a handful of posed pictures to a dense Gaussian cloud in seconds, without SfM: pair selection, matching or a
//! feed-forward network, alignment, scales and a budgeted merge; and the two baselines it is compared with.

mod baselines;
mod consistency;
mod depth_frame;
mod fill;
mod finish;
mod ground;
mod initialiser;
mod lighting;
mod merge;
mod pairs;
mod posed;
mod range;
mod report;
mod samples;
mod stereo;
#[cfg(test)]
mod tests;
mod unposed;

pub use baselines::{from_sfm, random};
pub use initialiser::{Initialiser, most_frame_bytes};
pub use pairs::SkippedPairs;
pub use range::mutual_matches;
pub use report::{AlignmentReport, Growth, InitReport, InitTimes, Initialisation, MergeReport};

use config::error::{Error, ErrorKind};

use crate::onnx::OnnxError;

/// Why there is no initial cloud.
#[derive(Debug, thiserror::Error)]
pub enum InitError {
    /// Nothing to start from.
    #[error("initialisation: none of {given} points is usable; give finite points, views and a depth range")]
    NoPoints {
        /// Points handed in.
        given: usize,
    },
    /// A setting is out of range.
    #[error("[init] {0}")]
    Setting(#[from] config::settings::SettingError),
    /// The plan is for fewer pictures.
    #[error("initialisation: more than {limit} pictures; raise [init] max_pictures")]
    TooMany {
        /// `max_pictures`.
        limit: usize,
    },
    /// A picture cannot be used.
    #[error("picture {name}: {reason}")]
    Picture {
        /// Its name.
        name: String,
        /// Why.
        reason: &'static str,
    },
    /// Nothing bounds the depths.
    #[error(
        "initialisation: only {points} points could be triangulated to bound the depths; give [init] depth_m = [nearest, farthest]"
    )]
    NoRange {
        /// Points found.
        points: usize,
    },
    /// No picture has a partner.
    #[error(
        "initialisation: none of {pictures} pictures has a partner with baseline and overlap ({skipped} pairs skipped); fly further apart, or check the poses"
    )]
    NoDepth {
        /// Pictures.
        pictures: usize,
        /// Pairs refused.
        skipped: usize,
    },
    /// The file of what waits of the pictures.
    #[error("initialisation: the file of the pictures' depths: {}", disk::told(.0))]
    FrameFile(#[from] std::io::Error),
    /// The network or ONNX Runtime.
    #[error(transparent)]
    Network(#[from] OnnxError),
}

impl Error for InitError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Network(e) => e.kind(),
            Self::FrameFile(_) => ErrorKind::Failed,
            _ => ErrorKind::Input,
        }
    }
}

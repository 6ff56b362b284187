//! ONNX networks: where the runtime library is found, what a network promises (its manifest), and the features
//! network that pose refinement and pair selection share.
//!
//! A session is opened when it is needed and dropped when it is not; nothing here is global except the runtime
//! library itself, which ONNX Runtime allows only once per process, and the request to end that process.

pub mod depth;
mod external;
pub mod features;
pub mod manifest;
pub mod metric;
pub mod network;
pub mod picture;
pub mod session;

use crate::formats::FormatError;

use config::error::{Error, ErrorKind};

/// What can be wrong with a network, in one line each.
#[derive(Debug, thiserror::Error)]
pub enum OnnxError {
    /// libonnxruntime.so is nowhere.
    #[error(
        "ONNX Runtime not found (looked at {searched}); put libonnxruntime.so (1.22 or newer, e.g. from the PyPI wheel `onnxruntime`) in ~/.local/share/dgtr/lib or point ORT_DYLIB_PATH at it"
    )]
    LibraryMissing {
        /// The places tried.
        searched: String,
    },
    /// The library is there but cannot be used.
    #[error("ONNX Runtime at {path} cannot be used: {reason}")]
    Library {
        /// The library.
        path: String,
        /// The loader's words.
        reason: String,
    },
    /// A file cannot be read.
    #[error(transparent)]
    File(#[from] FormatError),
    /// The manifest contradicts itself or the network's bytes.
    #[error("network manifest {manifest}: {field}: {reason}")]
    Manifest {
        /// Where it came from.
        manifest: String,
        /// The offending field.
        field: &'static str,
        /// What is wrong, and what would be right.
        reason: String,
    },
    /// The network's inputs or outputs are not what the manifest's contract promises.
    #[error("network {network}: {tensor} is {found}, contract `{contract}` wants {expected}")]
    Contract {
        /// Name of the network.
        network: String,
        /// The contract in the manifest.
        contract: &'static str,
        /// The input or output.
        tensor: String,
        /// What was expected.
        expected: Box<str>,
        /// What the file says.
        found: Box<str>,
    },
    /// The process was asked to end while it ran.
    #[error("network {network}: stopped on request")]
    Stopped {
        /// Name of the network.
        network: String,
    },
    /// ONNX Runtime failed while loading or running.
    #[error("network {network}: {reason}")]
    Runtime {
        /// Name of the network.
        network: String,
        /// ONNX Runtime's words, one line.
        reason: String,
    },
}

impl Error for OnnxError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::LibraryMissing { .. } | Self::Library { .. } => ErrorKind::Device,
            Self::File(e) => e.kind(),
            Self::Stopped { .. } => ErrorKind::Interrupted,
            _ => ErrorKind::Input,
        }
    }
}

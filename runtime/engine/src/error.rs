//! Why no model could be trained, drawn or scored.

use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use config::plan::PlanError;
use models::formats::FormatError;
use models::init::InitError;
use models::onnx::OnnxError;
use models::refine::RefineError;
use survey::dataset::DatasetError;
use survey::ortho::OrthoError;
use vulkan::gpu::GpuError;
use vulkan::trainer::TrainError;

/// Every variant's text is one line that says what, where and how to mend it.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The memory budget.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The host's memory.
    #[error(
        "memory plan: host_mib = {host_mib} is too little, {needed_mib} MiB are needed, {section_mib} MiB of it for the \
         {section}; raise memory.host_mib, or lower memory.device_mib, max_gaussians, image_scale or keyframes.max"
    )]
    HostMemory {
        /// What was allowed.
        host_mib: u32,
        /// What would do.
        needed_mib: u64,
        /// The largest section of the plan.
        section: &'static str,
        /// Its MiB.
        section_mib: u64,
    },
    /// A folder of pictures.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// What gives pictures cannot give or keep the next one.
    #[error("{0}")]
    Source(Box<dyn Error + Send + Sync>),
    /// Model files, run.json.
    #[error(transparent)]
    File(#[from] FormatError),
    /// A user's network, or ONNX Runtime.
    #[error(transparent)]
    Network(#[from] OnnxError),
    /// Pose refinement.
    #[error(transparent)]
    Refine(#[from] RefineError),
    /// Initialisation.
    #[error(transparent)]
    Init(#[from] InitError),
    /// Vulkan device or driver.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Maps.
    #[error(transparent)]
    Ortho(#[from] OrthoError),
    /// Training and rendering.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// Figures that JSON cannot hold.
    #[error("figures cannot be written as JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// A file or folder that no format owns.
    #[error("{}: {}", path.display(), disk::told(source))]
    Io {
        /// Where.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A map was asked to end that nobody asks to.
    #[error("a map was not finished")]
    Unfinished,
    /// What was asked for contradicts the pictures, the model or the settings.
    #[error("{0}")]
    Request(String),
    /// A rendering that does not have its camera's size.
    #[error("{0}: the rendering has another size than its camera")]
    RenderingSize(String),
    /// A picture that cannot be encoded.
    #[error("{}: cannot be encoded: {source}", path.display())]
    Encode {
        /// Where it should go.
        path: PathBuf,
        /// The encoder's reason.
        source: image::ImageError,
    },
}

impl EngineError {
    /// For `map_err` on file operations.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.to_owned(), source }
    }

    /// Whether it is the disk's fault and room, or a medium that comes back, may mend it.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::File(e) if e.may_pass())
    }
}

impl Error for EngineError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Plan(e) => e.kind(),
            Self::Dataset(e) => e.kind(),
            Self::Source(e) => e.kind(),
            Self::File(e) => e.kind(),
            Self::Network(e) => e.kind(),
            Self::Refine(e) => e.kind(),
            Self::Init(e) => e.kind(),
            Self::Gpu(e) => e.kind(),
            Self::Ortho(e) => e.kind(),
            Self::Train(e) => e.kind(),
            Self::Io { source, .. } => Error::kind(source),
            Self::HostMemory { .. } | Self::Request(_) => ErrorKind::Input,
            Self::Json(_) | Self::Unfinished | Self::RenderingSize(_) | Self::Encode { .. } => ErrorKind::Failed,
        }
    }
}

//! Why a job (a flight, a training, an evaluation, a measurement) stopped.

use std::path::PathBuf;

use config::error::{Error, ErrorKind};
use config::mission::MissionError;
use config::plan::PlanError;
use hal::error::HalError;
use job::interrupt::InterruptError;
use models::formats::FormatError;
use models::init::InitError;
use models::onnx::OnnxError;
use models::refine::RefineError;
use survey::dataset::DatasetError;
use survey::ortho::OrthoError;
use vulkan::gpu::GpuError;
use vulkan::trainer::TrainError;

use engine::error::EngineError;
use flight::error::FlightError;
use pages::report::ReportError;
use uplink::UploadError;

/// Every variant's text is one line that says what, where and how to mend it.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// The mission file.
    #[error(transparent)]
    Mission(#[from] MissionError),
    /// The memory budget.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// Link or camera.
    #[error(transparent)]
    Hal(#[from] HalError),
    /// Training, maps and scores.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A flight.
    #[error(transparent)]
    Flight(#[from] FlightError),
    /// A folder of pictures.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
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
    /// Upload settings.
    #[error(transparent)]
    Upload(#[from] UploadError),
    /// A page of figures.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// Figures that JSON cannot hold.
    #[error("figures cannot be written as JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// Signal handlers.
    #[error(transparent)]
    Interrupt(#[from] InterruptError),
    /// A file or folder that no format owns.
    #[error("{}: {}", path.display(), disk::told(source))]
    Io {
        /// Where.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A thread or a signal handler could not be started, or ended abnormally.
    #[error("{0}")]
    System(String),
    /// What was asked for contradicts the pictures, the model or the settings.
    #[error("{0}")]
    Request(String),
    /// A `dgtr` started as a process of its own.
    #[error("{line}")]
    Child {
        /// By its exit code.
        kind: ErrorKind,
        /// Its last line.
        line: String,
    },
}

impl JobError {
    /// For `map_err` on file operations.
    pub fn io(path: &std::path::Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.to_owned(), source }
    }
}

impl Error for JobError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Mission(e) => e.kind(),
            Self::Plan(e) => e.kind(),
            Self::Hal(e) => e.kind(),
            Self::Engine(e) => e.kind(),
            Self::Flight(e) => e.kind(),
            Self::Dataset(e) => e.kind(),
            Self::File(e) => e.kind(),
            Self::Network(e) => e.kind(),
            Self::Refine(e) => e.kind(),
            Self::Init(e) => e.kind(),
            Self::Gpu(e) => e.kind(),
            Self::Ortho(e) => e.kind(),
            Self::Train(e) => e.kind(),
            Self::Upload(e) => e.kind(),
            Self::Report(e) => e.kind(),
            Self::Interrupt(e) => e.kind(),
            Self::Io { source, .. } => Error::kind(source),
            Self::Request(_) => ErrorKind::Input,
            Self::Json(_) | Self::System(_) => ErrorKind::Failed,
            Self::Child { kind, .. } => *kind,
        }
    }
}

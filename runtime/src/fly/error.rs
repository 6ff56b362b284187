//! Why a flight's job stopped.

use config::mission::MissionError;
use config::plan::PlanError;
use hal::error::HalError;
use models::formats::FormatError;
use models::init::InitError;
use models::refine::RefineError;
use vulkan::gpu::GpuError;
use vulkan::trainer::TrainError;

use crate::keyframe_store::StoreError;
use crate::upload::UploadError;

/// Every variant's text is one line that says what, where and how to mend it.
#[derive(Debug, thiserror::Error)]
pub enum FlyError {
    /// The mission file.
    #[error(transparent)]
    Mission(#[from] MissionError),
    /// The memory budget.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// Link or camera.
    #[error(transparent)]
    Hal(#[from] HalError),
    /// Stored key frames.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Model files.
    #[error(transparent)]
    File(#[from] FormatError),
    /// Pose refinement.
    #[error(transparent)]
    Refine(#[from] RefineError),
    /// Initialisation.
    #[error(transparent)]
    Init(#[from] InitError),
    /// Vulkan device or driver.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Training.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// Upload settings.
    #[error(transparent)]
    Upload(#[from] UploadError),
    /// The list of pictures.
    #[error("geotags.csv cannot be written: {0}")]
    Geotags(std::io::Error),
    /// A thread could not be started or ended abnormally.
    #[error("the capture thread {0}")]
    Thread(String),
    /// The flight ended before there was anything to build from.
    #[error("only {keyframes} key frames, nothing to build a model from: {cause}")]
    TooFewKeyframes {
        /// How many there were.
        keyframes: usize,
        /// The most likely cause by what was counted, and the remedy.
        cause: String,
    },
}

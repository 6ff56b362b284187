//! What can go wrong while training.

use crate::gpu::GpuError;
use config::error::{Error, ErrorKind};
use config::settings::SettingError;

/// Why a training call failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TrainError {
    /// Device, driver or memory.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A setting outside its range.
    #[error("[training] {0}; mend it in the mission or settings file")]
    Settings(#[from] SettingError),
    /// There is nothing to train.
    #[error("no Gaussian to train: {non_finite} Gaussians were not finite; check the initialisation")]
    Empty {
        /// Those that were dropped.
        non_finite: usize,
    },
    /// There is nothing to train on.
    #[error("no view to train on; add at least one")]
    NoViews,
    /// More views than planned.
    #[error("the memory plan holds {planned} views; plan for more (PlanRequest::views)")]
    TooManyViews {
        /// Views in the plan.
        planned: usize,
    },
    /// More crops than planned.
    #[error("the memory plan holds {planned} crops; plan for more (PlanRequest::crops)")]
    TooManyCrops {
        /// Crops in the plan.
        planned: usize,
    },
    /// The file of the views that are not on the device.
    #[error("the file of the views that are not on the device: {0}")]
    ViewFile(String),
    /// The file of the cells that are not on the device.
    #[error("the file of the cells that are not on the device: {0}")]
    SceneFile(String),
    /// A scene that is read more than once was not the same every time.
    #[error("the scene changed while it was read; nothing else may write to its file meanwhile")]
    SceneChanged,
    /// No picture shows anything of the scene.
    #[error("no Gaussian is in view of any picture; check the poses and the initialisation")]
    NothingInView,
    /// Not even a small part of any picture can be drawn with what the device holds.
    #[error(
        "the least part of a picture shows {needed} Gaussians and the device holds {gaussians} at once; \
         raise device_mib (or max_gaussians), or lower scene_gaussians"
    )]
    TooCrowded {
        /// Gaussians that may show in it.
        needed: usize,
        /// Gaussians that the plan holds.
        gaussians: usize,
    },
    /// A picture, pose, lens or depth prior that cannot be used.
    #[error("picture '{name}' cannot be used: {why}")]
    BadView {
        /// Name of the picture.
        name: String,
        /// What is wrong.
        why: String,
    },
    /// A picture so wide that one row of tiles exceeds the plan.
    #[error("a picture {width} pixels wide cannot be rendered: the plan holds {pixels} pixels")]
    TooWide {
        /// Width asked for.
        width: u32,
        /// Pixels in the plan.
        pixels: usize,
    },
}

impl Error for TrainError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Gpu(e) => e.kind(),
            Self::ViewFile(_) | Self::SceneFile(_) => ErrorKind::Failed,
            _ => ErrorKind::Input,
        }
    }
}

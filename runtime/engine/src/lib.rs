//! The reconstruction engine: posed pictures in, a trained model out, in the order capture → refine → initialise → train →
//! checkpoint. A flight and `dgtr train` differ in their [`PictureSource`] and in [`EngineSettings`], not in the work.
//!
//! All memory is planned when it is opened. A picture comes by once: matching takes its features, the trainer its pixels,
//! and what initialisation needs of it later is read from where the trainer keeps them.

use std::path::{Path, PathBuf};

use config::init::InitSettings;
use config::map::MapSettings;
use config::mission::NetworkSettings;
use config::refine::RefineSettings;
use config::training::TrainSettings;
use disk::Disk;
use models::formats::delivery::Rounding;

mod budget;
#[cfg(test)]
#[path = "../../../tests/carpet.rs"]
mod carpet;
mod carry;
mod delivery;
pub mod device;
pub mod energy;
pub mod error;
pub mod evaluate;
pub mod failsafe;
mod first_gaussians;
mod follow;
pub mod host;
mod map;
pub mod ortho;
pub mod pieces;
mod poses;
pub mod preset;
mod reconstruct;
pub mod renderings;
mod resumed;
pub mod source;
#[cfg(test)]
mod testing;
pub mod tiles;
mod training;
pub mod transfer;
mod waiting;

use device::DeviceRequest;
pub use first_gaussians::InitKind;
pub use poses::Point;
pub use reconstruct::{Reconstruct, Reconstruction};
pub use source::PictureSource;
pub use waiting::{matching_file_bytes, scratch_bytes, waiting_file};

/// What the engine needs to know before the first picture.
#[derive(Clone, Debug)]
pub struct EngineSettings {
    /// Where checkpoints are written to and read from.
    pub disk: Disk,
    /// Device and budget.
    pub device: DeviceRequest,
    /// Pixels of a picture as it leaves the camera.
    pub camera_pixels: u64,
    /// Pictures that the source decodes ahead.
    pub ahead: usize,
    /// Their camera's own pictures wait in memory with them.
    pub ahead_in_memory: bool,
    /// To what models are quantised for delivery while the job goes on.
    pub delivers: Option<Rounding>,
    /// `[map]`: what is drawn after each build; `None` draws nothing.
    pub map: Option<MapSettings>,
    /// Pictures are trained at this fraction of the size they come in; matching sees them whole.
    pub scale: f64,
    /// `[network]`: manifests of the user's own networks.
    pub network: NetworkSettings,
    /// `[training]`.
    pub training: TrainSettings,
    /// `[init]`.
    pub init: InitSettings,
    /// `[refine]`; `None` takes poses as they are.
    pub refine: Option<RefineSettings>,
    /// First Gaussians.
    pub start: InitKind,
    /// Refine, estimate depths and build while pictures still come, and keep what is trained over a rebuild; else everything
    /// is done once, with all pictures there.
    pub incremental: bool,
}

/// Where the model lies in an output folder.
pub fn model_path(out: &Path) -> PathBuf {
    out.join("model.dgtr")
}

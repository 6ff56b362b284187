//! What the onboard job asks of a reconstruction: the seam at which a rehearsal stands in for network, device and disk.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use models::camera::PosedImage;
use vulkan::trainer::{RunBudget, StepReport};

use super::{FlyError, Reconstruction};

/// What makes a model out of key frames.
pub trait Reconstruct {
    /// Takes in a new key frame.
    ///
    /// # Errors
    /// It cannot be stored.
    fn add(&mut self, frame: &PosedImage) -> Result<(), FlyError>;
    /// Number of key frames.
    fn keyframes(&self) -> usize;
    /// Whether enough key frames came since the last build; with `last`, whether any did.
    fn wants_build(&self, last: bool) -> bool;
    /// Whether there is a model to train.
    fn has_model(&self) -> bool;
    /// (Re)builds the model from all key frames.
    ///
    /// # Errors
    /// The network or the device fails; the pictures give no depth.
    fn build(&mut self) -> Result<(), FlyError>;
    /// Whether the schedule of `budget` is over.
    fn is_done(&self, budget: &RunBudget) -> bool;
    /// Steps taken since the last build.
    fn steps(&self) -> u32;
    /// Trains until the budget, the schedule, or `each` says stop.
    ///
    /// # Errors
    /// The device fails; the last checkpoint stays valid.
    fn train(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<(), FlyError>;
    /// Trains at half the size, or as scheduled again.
    fn halve_resolution(&mut self, on: bool);
    /// Gives up the least useful Gaussians.
    ///
    /// # Errors
    /// The device fails.
    fn shrink(&mut self) -> Result<(), FlyError>;
    /// Gaussians of the model as it is now.
    fn gaussians(&self) -> usize;
    /// Writes the model as it is now; returns its path and its number of Gaussians.
    ///
    /// # Errors
    /// The disk cannot be written; the file written before stays.
    fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), FlyError>;
}

impl Reconstruct for Reconstruction {
    fn add(&mut self, frame: &PosedImage) -> Result<(), FlyError> {
        Self::add(self, frame)
    }

    fn keyframes(&self) -> usize {
        Self::keyframes(self)
    }

    fn wants_build(&self, last: bool) -> bool {
        Self::wants_build(self, last)
    }

    fn has_model(&self) -> bool {
        Self::has_model(self)
    }

    fn build(&mut self) -> Result<(), FlyError> {
        Self::build(self)
    }

    fn is_done(&self, budget: &RunBudget) -> bool {
        Self::is_done(self, budget)
    }

    fn steps(&self) -> u32 {
        self.trainer().steps()
    }

    fn train(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<(), FlyError> {
        Self::train(self, budget, each)
    }

    fn halve_resolution(&mut self, on: bool) {
        Self::halve_resolution(self, on);
    }

    fn shrink(&mut self) -> Result<(), FlyError> {
        Self::shrink(self)
    }

    fn gaussians(&self) -> usize {
        self.trainer().gaussians()
    }

    fn checkpoint(&mut self, out: &Path, finished: bool) -> Result<(PathBuf, usize), FlyError> {
        Self::checkpoint(self, out, finished)
    }
}

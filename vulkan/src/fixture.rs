//! A trainer with the pictures it is trained on, for tests and cases.

use crate::gpu::Gpu;
use crate::kernel_config::KernelConfig;
use crate::trainer::{
    CropPlace, PictureStore, RunBudget, StepReport, TrainError, TrainSummary, Trainer, ViewGradients,
};
use config::plan::Plan;
use config::training::TrainSettings;
use image::RgbImage;
use models::camera::{DepthPrior, PosedImage};
use models::cloud::GaussianCloud;
use models::mask::Mask;
use std::ops::{ControlFlow, Deref, DerefMut};

/// Trainer and pictures, opened by one plan.
#[derive(Debug)]
pub struct Fixture {
    /// The trainer.
    pub trainer: Trainer,
    /// Its pictures.
    pub pictures: PictureStore,
}

impl Deref for Fixture {
    type Target = Trainer;

    fn deref(&self) -> &Trainer {
        &self.trainer
    }
}

impl DerefMut for Fixture {
    fn deref_mut(&mut self) -> &mut Trainer {
        &mut self.trainer
    }
}

impl From<Trainer> for Fixture {
    fn from(trainer: Trainer) -> Self {
        Self { pictures: PictureStore::new(trainer.plan()), trainer }
    }
}

impl Fixture {
    /// Opens both with the device's standard configuration.
    ///
    /// # Errors
    /// Errors of [`Trainer::new`].
    pub fn new(gpu: &Gpu, plan: &Plan, settings: &TrainSettings) -> Result<Self, TrainError> {
        Trainer::new(gpu, plan, settings).map(Self::from)
    }

    /// Opens both with kernels of `config`.
    ///
    /// # Errors
    /// Errors of [`Trainer::with_config`].
    pub fn with_config(
        gpu: &Gpu,
        plan: &Plan,
        settings: &TrainSettings,
        config: KernelConfig,
    ) -> Result<Self, TrainError> {
        Trainer::with_config(gpu, plan, settings, config).map(Self::from)
    }

    /// Takes a picture in.
    ///
    /// # Errors
    /// Errors of [`PictureStore::add`].
    pub fn add_view(&mut self, picture: &PosedImage, prior: Option<&DepthPrior>) -> Result<usize, TrainError> {
        self.pictures.add(self.trainer.device_mut(), picture, prior)
    }

    /// Takes a crop in.
    ///
    /// # Errors
    /// Errors of [`PictureStore::add_crop`].
    pub fn add_crop(
        &mut self,
        view: usize,
        image: &RgbImage,
        mask: Option<&Mask>,
        place: CropPlace,
    ) -> Result<(), TrainError> {
        self.pictures.add_crop(self.trainer.device_mut(), view, image, mask, place)
    }

    /// Replaces a view's depth prior.
    ///
    /// # Errors
    /// Errors of [`PictureStore::set_prior`].
    pub fn set_prior(&mut self, index: usize, prior: Option<&DepthPrior>) -> Result<(), TrainError> {
        self.pictures.set_prior(self.trainer.device_mut(), index, prior)
    }

    /// The picture of a view.
    ///
    /// # Errors
    /// Errors of [`PictureStore::image`].
    pub fn view_image(&mut self, index: usize) -> Result<RgbImage, TrainError> {
        self.pictures.image(self.trainer.device_mut(), index)
    }

    /// Which of its pixels count.
    ///
    /// # Errors
    /// Errors of [`PictureStore::mask`].
    pub fn view_mask(&mut self, index: usize) -> Result<Option<Mask>, TrainError> {
        self.pictures.mask(self.trainer.device_mut(), index)
    }

    /// Takes a step.
    ///
    /// # Errors
    /// Errors of [`Trainer::step`].
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        self.trainer.step(&mut self.pictures)
    }

    /// Trains.
    ///
    /// # Errors
    /// Errors of [`Trainer::run`].
    pub fn run(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<TrainSummary, TrainError> {
        self.trainer.run(&mut self.pictures, budget, each)
    }

    /// Computes the gradient of a view's loss.
    ///
    /// # Errors
    /// Errors of [`Trainer::gradient`].
    pub fn gradient(&mut self, index: usize, into: &mut GaussianCloud) -> Result<ViewGradients, TrainError> {
        self.trainer.gradient(&mut self.pictures, index, into)
    }

    /// Steps taken since the Gaussians were loaded.
    pub fn steps(&self) -> u32 {
        self.trainer.schedule().taken()
    }
}

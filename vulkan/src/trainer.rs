//! Training: one gradient step after the other on pictures that are borrowed, nothing allocated in between.
//!
//! The parts: [`Device`] (one allocation, the kernels' passes), the model (Gaussians with their moments, cells), [`Schedule`] (how much of
//! it is over), densification, and whose turn it is.

mod check;
mod gradient;
mod render;
mod run;
mod schedule;
mod step;
mod strategy;
mod turns;
mod validation;

pub use crate::device::Device;
pub use crate::error::TrainError;
pub use crate::model::{BoundingBox, Counters, Fate, LoadReport, Pieces, Trained};
pub use crate::pictures::{CropPlace, PictureStore};
pub use check::{PlanFit, TrainingCheck, check_device, check_plan, check_training};
pub use gradient::ViewGradients;
pub use render::Rendering;
pub use run::{RunBudget, StepReport, StopReason, TrainSummary};
pub use schedule::Schedule;
pub use validation::Validated;

use crate::gpu::Gpu;
use crate::kernel_config::KernelConfig;
use crate::kernels::{ALL, Kernel};
use crate::layout::Frame;
use crate::model::Model;
use config::plan::Plan;
use config::settings::SettingError;
use config::training::{LossSettings, MOST_STEPS, RateSettings, TrainSettings};
use models::camera::{OrthographicView, View};
use models::cloud::GaussianCloud;
use std::ops::ControlFlow;
use std::time::Instant;

/// Gaussians and their optimiser on one device.
pub struct Trainer {
    pub(crate) device: Device,
    pub(crate) model: Model,
    schedule: Schedule,
    settings: TrainSettings,
    pub(crate) turns: turns::Turns,
    density: strategy::Density,
    validation: validation::Validation,
    patience: run::Patience,
}

impl std::fmt::Debug for Trainer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Trainer({} Gaussians, step {})", self.gaussians(), self.model.updates)
    }
}

impl Trainer {
    /// Opens a trainer with the device's standard configuration; else as [`Trainer::with_config`].
    ///
    /// # Errors
    /// Errors of [`Trainer::with_config`].
    pub fn new(gpu: &Gpu, plan: &Plan, settings: &TrainSettings) -> Result<Self, TrainError> {
        Self::with_config(gpu, plan, settings, KernelConfig::standard(gpu.info()))
    }

    /// Allocates everything training will ever need: one device allocation of `plan.total_bytes`, all pipelines, and the
    /// host's own lists. The configuration decides how fast the kernels run and changes no bit of what they compute.
    ///
    /// # Errors
    /// [`TrainError::Gpu`] (device, driver, memory, limits); [`TrainError::Settings`].
    pub fn with_config(
        gpu: &Gpu,
        plan: &Plan,
        settings: &TrainSettings,
        config: KernelConfig,
    ) -> Result<Self, TrainError> {
        Self::with_kernels(gpu, plan, settings, config, ALL)
    }

    /// Opens a trainer with some of the kernels only.
    pub(crate) fn with_kernels(
        gpu: &Gpu,
        plan: &Plan,
        settings: &TrainSettings,
        config: KernelConfig,
        kernels: &[Kernel],
    ) -> Result<Self, TrainError> {
        settings.check()?;
        if plan.is_paged() && settings.sh.raise_share < 1.0 {
            let wanted = "1 where the scene has more Gaussians than the device: degrees are ranked among all of them";
            return Err(SettingError::new("sh.raise_share", &settings.sh.raise_share, wanted).into());
        }
        let device = Device::new(gpu, plan, config, settings.sh.raise_share < 1.0, kernels)?;
        Ok(Self {
            model: Model::new(&device, settings),
            device,
            schedule: Schedule::new(settings),
            turns: turns::Turns::new(settings.seed, plan.views, plan.crops),
            density: strategy::Density::new(plan.gaussians),
            validation: validation::Validation::new(plan.views),
            patience: run::Patience::default(),
            settings: settings.clone(),
        })
    }

    /// Keeps the cells that find no room on the device in `file`, empty and with room for [`Plan::scene_file_bytes`]. Call it before
    /// [`Trainer::load`] where the plan holds fewer Gaussians than the scene.
    pub fn keep_scene_in(&mut self, file: std::fs::File) {
        self.model.scene.store.keep_in(file);
    }

    /// Replaces the Gaussians and starts the schedule anew. Those that are not finite are left out, and so are the least
    /// important ones beyond the plan's capacity.
    ///
    /// # Errors
    /// [`TrainError::Empty`] when nothing remains; [`TrainError::SceneFile`] where they are more than the device holds.
    pub fn load(&mut self, cloud: &GaussianCloud) -> Result<LoadReport, TrainError> {
        self.load_pieces::<TrainError>(&|take| take(cloud))
    }

    /// Loads all pieces in one, of which the host holds one at a time; else as [`Trainer::load`].
    ///
    /// # Errors
    /// Errors of [`Trainer::load`] and of `pieces`: no Gaussians are there then, where it had begun to replace them.
    pub fn load_pieces<E: From<TrainError>>(&mut self, pieces: Pieces<'_, E>) -> Result<LoadReport, E> {
        let report = self.model.load_pieces(&mut self.device, &self.settings, pieces)?;
        self.schedule.restart();
        self.turns.restart();
        self.density.restart(self.settings.density.resolve(self.gaussians(), self.plan().scene));
        self.validation.reset();
        self.patience = run::Patience::default();
        self.device.clear_times();
        Ok(report)
    }

    /// Trains until the budget, the schedule or `each` says stop. The schedule fits itself to the budget: `steps` and
    /// `seconds` given here replace those of the settings.
    ///
    /// # Errors
    /// [`TrainError::NoViews`], [`TrainError::Empty`], [`TrainError::Gpu`]. What was trained before stays.
    pub fn run(
        &mut self,
        pictures: &mut PictureStore,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<TrainSummary, TrainError> {
        if let Some(steps) = budget.steps {
            self.schedule.set_steps(steps.clamp(1, MOST_STEPS));
        } else if budget.seconds.is_some() {
            self.schedule.set_steps(MOST_STEPS);
        }
        if budget.seconds.is_some() {
            self.schedule.set_seconds(budget.seconds);
        }
        let start = (Instant::now(), self.schedule.taken());
        let mut reason = StopReason::Schedule;
        let mut last = None;
        while self.schedule.progress() < 1.0 {
            let report = self.step(pictures)?;
            let stop = each(&report).is_break();
            last = Some(report);
            let converged = self.patience.is_over(&self.settings, &report, pictures.len());
            if stop {
                reason = StopReason::Caller;
                break;
            }
            if converged {
                self.patience = run::Patience::default();
                reason = StopReason::Converged;
                break;
            }
        }
        Ok(TrainSummary {
            steps: self.schedule.taken() - start.1,
            seconds: start.0.elapsed().as_secs_f64(),
            reason,
            gaussians: self.gaussians(),
            last,
            counters: self.model.counters,
        })
    }

    /// Number of Gaussians, those that are not on the device included.
    pub fn gaussians(&self) -> usize {
        self.model.total()
    }

    /// Cells of ground, and how many of them are on the device; (0, 0) while all Gaussians are.
    pub fn cells(&self) -> (usize, usize) {
        self.model.scene.cells()
    }

    /// The plan everything was allocated by.
    pub fn plan(&self) -> &Plan {
        self.device.plan()
    }

    /// The device at work.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// The device at work, whose memory pictures are put into.
    pub fn device_mut(&mut self) -> &mut Device {
        &mut self.device
    }

    /// How much of the schedule is over.
    pub fn schedule(&self) -> &Schedule {
        &self.schedule
    }

    /// The schedule, to be continued, begun anew or bounded.
    pub fn schedule_mut(&mut self) -> &mut Schedule {
        &mut self.schedule
    }

    /// Trains on pictures of at most 1/`divisor` of their size from now on, whatever the schedule says (1 = as scheduled):
    /// the failsafe's way to a third of the work without touching the model.
    pub fn set_least_divisor(&mut self, divisor: u32) {
        self.settings.resolution.least_divisor = divisor.max(1);
    }

    /// Takes other learning rates from the next step on.
    ///
    /// # Errors
    /// [`TrainError::Settings`] when one is negative or not a number; the old ones then stay.
    pub fn set_rates(&mut self, rates: &RateSettings) -> Result<(), TrainError> {
        let mut settings = self.settings.clone();
        settings.rates = *rates;
        settings.check()?;
        self.settings = settings;
        Ok(())
    }

    /// Takes another loss from the next step on.
    ///
    /// # Errors
    /// [`TrainError::Settings`] when a weight is negative or not a number; the old one then stays.
    pub fn set_loss(&mut self, loss: &LossSettings) -> Result<(), TrainError> {
        let mut settings = self.settings.clone();
        settings.loss = *loss;
        settings.check()?;
        self.settings = settings;
        Ok(())
    }

    /// From here on, until the next [`Trainer::load`] that is followed by none of this: views are visited newest first, with an
    /// exponential tail of older ones, instead of once in an epoch each, and the number of Gaussians is the caller's: nothing is
    /// densified.
    pub fn while_views_come(&mut self) {
        self.turns.views.prefer_newest(true);
        self.keep_number();
    }

    /// From here on, until the next [`Trainer::load`], nothing is densified: the number of Gaussians is the caller's.
    pub fn keep_number(&mut self) {
        self.density.keep_number();
    }

    /// Holds the Gaussians just loaded for which `is_held(row of the cloud)` says so: they are drawn and blended, and the others are
    /// trained as if they could not move. Adam does it, by second moments that no gradient comes near: what is held moves by
    /// less than rounding shows, but for numbers that are nearly zero. Until the next [`Trainer::load`]; only for a scene that is
    /// on the device as a whole, of which no row was left out.
    pub fn hold(&mut self, is_held: impl Fn(usize) -> bool) {
        self.model.hold(&mut self.device, is_held);
    }

    /// Shows every Gaussian of `within`, in order.
    ///
    /// # Errors
    /// [`TrainError::Gpu`], [`TrainError::SceneFile`].
    pub fn each(&mut self, within: &BoundingBox, see: impl FnMut(&Trained)) -> Result<(), TrainError> {
        let unbias = self.schedule.second_unbias(self.settings.adam.beta2);
        self.model.each(&mut self.device, within, unbias, see)
    }

    /// Moves Gaussians of `within` and takes others out, as `fate` says of each in the order of [`Trainer::each`]; never the last one.
    /// Returns how many went.
    ///
    /// # Errors
    /// [`TrainError::Gpu`], [`TrainError::SceneFile`].
    pub fn revise(&mut self, within: &BoundingBox, fate: impl FnMut(&Trained) -> Fate) -> Result<usize, TrainError> {
        let unbias = self.schedule.second_unbias(self.settings.adam.beta2);
        self.model.revise(&mut self.device, within, unbias, fate)
    }

    /// Adds Gaussians, as many as find room; those that are not finite are left out. A scene that outgrows the device goes into cells.
    ///
    /// # Errors
    /// [`TrainError::Gpu`], [`TrainError::SceneFile`].
    pub fn extend(&mut self, cloud: &GaussianCloud) -> Result<LoadReport, TrainError> {
        self.model.extend(&mut self.device, &self.settings, cloud)
    }

    /// Writes the present parameters to `cloud`, reusing its memory.
    ///
    /// # Errors
    /// [`TrainError::Gpu`], [`TrainError::SceneFile`].
    pub fn snapshot(&mut self, cloud: &mut GaussianCloud) -> Result<(), TrainError> {
        self.model.snapshot(&mut self.device, cloud)
    }

    /// Moves every parameter of `cloud`, which is an earlier [`Trainer::snapshot`] of as many Gaussians, by `share` of the way to the present
    /// one. Allocates nothing.
    ///
    /// # Errors
    /// Errors of [`Trainer::snapshot`]; the cloud is of no use then.
    pub fn blend_into(&mut self, cloud: &mut GaussianCloud, share: f32) -> Result<(), TrainError> {
        self.model.blend_into(&mut self.device, cloud, share)
    }

    /// Gives the present parameters to `take` piece by piece, in the order of [`Trainer::snapshot`]. What it has not flushed before it
    /// does first, so that it gives the same Gaussians until the next step.
    ///
    /// # Errors
    /// Errors of [`Trainer::snapshot`] and of `take`.
    pub fn each_piece<E: From<TrainError>>(
        &mut self,
        take: &mut dyn FnMut(&mut GaussianCloud) -> Result<(), E>,
    ) -> Result<(), E> {
        self.model.each_piece(&mut self.device, take)
    }

    /// Renders the present Gaussians with all trained SH degrees, without exposure, over black.
    ///
    /// # Errors
    /// [`TrainError::BadView`] for a camera that is not finite, [`TrainError::TooWide`], [`TrainError::Gpu`].
    pub fn render(&mut self, view: &View, into: &mut Rendering) -> Result<(), TrainError> {
        render::check(view)?;
        self.draw((view.intrinsics.width, view.intrinsics.height), into, |frame| frame.look(view))
    }

    /// Renders with parallel rays, else as [`Trainer::render`]. Depth is the distance from the view's plane to where half of the light is
    /// gone (the median, not the mean; 0 where less than half goes): what floats thinly above the ground does not raise it.
    ///
    /// # Errors
    /// Errors of [`Trainer::render`].
    pub fn render_orthographic(&mut self, view: &OrthographicView, into: &mut Rendering) -> Result<(), TrainError> {
        render::check_orthographic(view)?;
        self.draw((view.width, view.height), into, |frame| frame.look_orthographic(view))
    }

    fn draw(
        &mut self,
        size: (u32, u32),
        into: &mut Rendering,
        look: impl FnOnce(&mut Frame),
    ) -> Result<(), TrainError> {
        let sh_degree = self.settings.sh.degree_at(1.0).min(self.plan().sh_degree);
        render::Drawing { device: &mut self.device, model: &mut self.model, into }.draw(size, sh_degree, look)
    }
}

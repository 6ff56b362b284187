//! The trainer: views and Gaussians in one arena, one gradient step after the other, nothing allocated in between.
//!
//! A step is two submissions: projection, sort and counting first, so that the host knows how many instances there are;
//! then blending, loss, gradient and Adam — in several bands of tiles when the instances do not fit, with the same bits.

mod bands;
mod check;
mod control;
mod crops;
mod deferred;
mod degrees;
mod density;
mod error;
pub(crate) mod frame;
mod gradient;
mod grow;
mod load;
mod moments;
mod parameters;
mod pose;
mod render;
mod run;
mod sampler;
mod scene;
mod schedule;
mod slots;
mod snapshot;
mod state;
mod step;
mod validation;
mod views;

pub use check::{PlanFit, TrainingCheck, check_device, check_plan, check_training};
pub use crops::CropPlace;
pub use error::TrainError;
pub use gradient::ViewGradients;
pub use grow::{BoundingBox, Fate, Trained};
pub use load::{LoadReport, Pieces};
pub use render::Rendering;
pub use run::{Counters, RunBudget, StepReport, StopReason, TrainSummary};
pub use validation::Validated;

use crate::arena::Arena;
use crate::commands::{Commands, Recording};
use crate::gpu::Gpu;
use crate::kernel_config::KernelConfig;
use crate::kernels::{ALL, GROUPS, Kernel};
use crate::layout::{Frame, Push, Status};
use crate::pipelines::Pipelines;
use crate::stages::STAGE_NAMES;
use bytemuck::Zeroable;
use config::plan::Plan;
use config::settings::SettingError;
use config::training::{MOST_STEPS, Strategy, TrainSettings, scene_extent};
use std::ops::ControlFlow;
use std::time::Instant;

/// Of so many steps one is timed: on lavapipe timestamps make a step longer (`tests/results/TRIED.md`).
const TIMED_EVERY: u32 = 16;

/// How many steps the times of the one after `steps` stand for.
fn timed_weight(steps: u32, every: u32) -> f64 {
    match steps {
        steps if steps < every => 1.0,
        steps if steps.is_multiple_of(every) => f64::from(every),
        _ => 0.0,
    }
}

/// Gaussians, views and optimiser state on one device.
pub struct Trainer {
    // Dropped in this order: what refers to the arena first, the device last.
    commands: Commands,
    pipelines: Pipelines,
    arena: Arena,
    gpu: Gpu,
    plan: Plan,
    settings: TrainSettings,
    parameters: parameters::Parameters,
    frame: Box<Frame>,
    deferred: deferred::Deferred,
    views: Vec<views::TrainingView>,
    crops: Vec<crops::TrainingCrop>,
    slots: slots::Slots,
    scene: scene::Scene,
    /// One Gaussian on its way to the host.
    record: Vec<u8>,
    sampler: sampler::Sampler,
    crop_sampler: sampler::Sampler,
    density: density::Scratch,
    degrees: degrees::Degrees,
    validation: validation::Validation,
    bands: Vec<bands::Band>,
    /// Dispatches that counting and emitting are spread over.
    walk_rounds: u32,
    strategy: Strategy,
    /// Those on the device.
    gaussians: usize,
    extent: f32,
    /// Updates of the Gaussians since `load`: one for each picture looked at, or for each part of one.
    updates: u32,
    /// Pictures looked at since `load`, parts of them by their share of its pixels.
    looked: f64,
    /// Whether the lazy Adam updates of all Gaussians are done.
    flushed: bool,
    /// Gradients are left where the first moments are, and nothing moves (gradient checks).
    gradients_only: bool,
    /// Of so many steps one is timed, after as many at the beginning.
    timed_every: u32,
    /// Seconds of training since `load`.
    elapsed_s: f64,
    /// Steps and seconds that earlier processes spent on the same schedule.
    before: (u32, f64),
    /// Progress at which the schedule begins.
    begun_at: f32,
    /// Pictures looked at and seconds spent when the schedule began anew.
    since: (f64, f64),
    patience: run::Patience,
    counters: Counters,
}

impl std::fmt::Debug for Trainer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Trainer({} Gaussians, {} views, step {})", self.gaussians, self.views.len(), self.updates)
    }
}

impl Trainer {
    /// As [`Trainer::with_config`], with the device's standard configuration.
    ///
    /// # Errors
    /// As there.
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

    /// The same with some of the kernels only.
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
        let arena = Arena::new(gpu, plan)?;
        let pipelines = Pipelines::new(gpu, plan, &arena, config, settings.sh.raise_share < 1.0, kernels)?;
        let commands = Commands::new(gpu)?;
        let parameters = parameters::Parameters::new(&arena, plan);
        Ok(Self {
            commands,
            pipelines,
            arena,
            gpu: gpu.clone(),
            plan: plan.clone(),
            parameters,
            frame: Box::new(Frame::zeroed()),
            deferred: deferred::Deferred::new(&settings.adam),
            views: Vec::with_capacity(plan.views),
            crops: Vec::with_capacity(plan.crops),
            slots: slots::Slots::new(plan),
            scene: scene::Scene::new(plan),
            record: vec![0; plan.record_bytes()],
            sampler: sampler::Sampler::new(settings.seed, plan.views),
            crop_sampler: sampler::Sampler::new(settings.seed, plan.crops),
            density: density::Scratch::new(plan.gaussians),
            degrees: degrees::Degrees::new(plan.gaussians),
            validation: validation::Validation::new(plan.views),
            bands: Vec::with_capacity(plan.tiles),
            walk_rounds: bands::WALK_ROUNDS,
            strategy: Strategy::None,
            gaussians: 0,
            extent: 1.0,
            updates: 0,
            looked: 0.0,
            flushed: true,
            gradients_only: false,
            timed_every: TIMED_EVERY,
            elapsed_s: 0.0,
            before: (0, 0.0),
            begun_at: 0.0,
            patience: run::Patience::default(),
            since: (0.0, 0.0),
            counters: Counters::default(),
            settings: settings.clone(),
        })
    }

    /// Starts the schedule anew for the Gaussians just loaded.
    fn restart(&mut self) {
        (self.updates, self.looked) = (0, 0.0);
        self.elapsed_s = 0.0;
        (self.before, self.since, self.begun_at) = ((0, 0.0), (0.0, 0.0), 0.0);
        self.flushed = true;
        self.deferred.reset();
        self.sampler.look_at_newest(false);
        self.sampler.reset();
        self.crop_sampler.reset();
        self.strategy = self.settings.density.resolve(self.gaussians(), self.plan.scene);
        self.counters = Counters::default();
        self.extent = 0.0;
        self.density.last = 0.0;
        self.density.last_flush = 0;
        self.degrees.reset();
        self.validation.reset();
        self.patience = run::Patience::default();
        self.commands.clear_times();
    }

    /// Trains until the budget, the schedule or `each` says stop. The schedule fits itself to the budget: `steps` and
    /// `seconds` given here replace those of the settings.
    ///
    /// # Errors
    /// [`TrainError::NoViews`], [`TrainError::Empty`], [`TrainError::Gpu`]. What was trained before stays.
    pub fn run(
        &mut self,
        budget: &RunBudget,
        each: &mut dyn FnMut(&StepReport) -> ControlFlow<()>,
    ) -> Result<TrainSummary, TrainError> {
        if let Some(steps) = budget.steps {
            self.settings.steps = steps.clamp(1, MOST_STEPS);
        } else if budget.seconds.is_some() {
            self.settings.steps = MOST_STEPS;
        }
        self.settings.seconds = budget.seconds.or(self.settings.seconds);
        let start = (Instant::now(), self.steps());
        let mut reason = StopReason::Schedule;
        let mut last = None;
        while self.progress() < 1.0 {
            let report = self.step()?;
            let stop = each(&report).is_break();
            last = Some(report);
            let converged = self.patience.is_over(&self.settings, &report, self.views.len());
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
            steps: self.steps() - start.1,
            seconds: start.0.elapsed().as_secs_f64(),
            reason,
            gaussians: self.gaussians(),
            last,
            counters: self.counters,
        })
    }

    /// Seconds of training since the last [`Trainer::load`].
    pub fn elapsed_s(&self) -> f64 {
        self.elapsed_s
    }

    /// Number of Gaussians, those that are not on the device included.
    pub fn gaussians(&self) -> usize {
        self.gaussians + self.scene.away
    }

    /// Steps taken since the last [`Trainer::load`]: pictures looked at. Where a scene is larger than the device a picture is looked at
    /// in parts, each of which updates the Gaussians, and its step is over when they amount to it.
    pub fn steps(&self) -> u32 {
        self.looked as u32
    }

    /// The plan everything was allocated by.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Bytes really allocated on the device.
    pub fn device_bytes(&self) -> u64 {
        self.arena.total_bytes
    }

    /// Bytes of the host's memory beside them, where the device is a card with memory of its own.
    pub fn mirror_bytes(&self) -> u64 {
        self.arena.mirror_bytes()
    }

    /// Times every step from here on instead of one in sixteen: for those who measure, not for those who train.
    pub fn time_every_step(&mut self) {
        self.timed_every = 1;
    }

    /// Device milliseconds per stage since `load`, in pipeline order, of all steps as the timed ones let one expect; zeros on
    /// devices without timestamps.
    pub fn stage_ms(&self) -> [(&'static str, f64); STAGE_NAMES.len()] {
        let ms = self.commands.stage_ms();
        std::array::from_fn(|i| (STAGE_NAMES[i], ms[i]))
    }

    /// Device milliseconds of each kind of kernel since `load` (by `Group as usize`); zeros without timestamps.
    pub(crate) fn group_ms(&self) -> [f64; GROUPS] {
        self.commands.group_ms()
    }

    /// Length scale of the scene, metres (see [`scene_extent`]); learning rates of positions are relative to it.
    fn measure_extent(&mut self) {
        if self.extent > 0.0 {
            return;
        }
        let centres: Vec<[f64; 3]> = self.views.iter().map(|v| v.view.pose.center.to_array()).collect();
        if self.scene.is_paged() {
            self.extent = scene_extent(self.scene.means(), &centres);
            return;
        }
        let geometry = &self.parameters.geometry(&self.arena)[..self.gaussians];
        let means: Vec<[f32; 3]> = geometry.iter().map(|g| g.mean).collect();
        self.extent = scene_extent(&means, &centres);
    }

    /// Does the lazy Adam updates of all Gaussians, so that they may be read or moved.
    fn flush(&mut self) -> Result<(), TrainError> {
        if self.flushed || self.gaussians == 0 {
            return Ok(());
        }
        self.frame.gaussians = self.gaussians as u32;
        self.frame.step = self.updates + 1;
        self.deferred.write(&mut self.frame.deferred);
        self.write_frame();
        let all = Push { mode: 1, ..Push::default() };
        let recording = self.take_recording()?;
        recording.run(Kernel::Project, self.gaussians, all);
        recording.run(Kernel::CatchUp, self.plan.lanes.loops as usize, all);
        recording.submit()?;
        self.flushed = true;
        Ok(())
    }

    fn take_recording(&self) -> Result<Recording<'_>, TrainError> {
        Ok(self.commands.begin(&self.pipelines, &self.arena)?)
    }

    fn write_frame(&mut self) {
        let section = self.arena.section("frame");
        self.arena.slice_mut::<Frame>(section)[0] = *self.frame;
    }

    /// What the kernels left; the device must be idle.
    fn status(&self) -> &Status {
        &self.arena.slice::<Status>(self.arena.section("status"))[0]
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_timed_steps_stand_for_all_steps() {
        for (every, steps) in [(1, 37), (16, 16), (16, 32), (16, 1600)] {
            let stand_for: f64 = (0..steps).map(|step| super::timed_weight(step, every)).sum();
            assert_eq!(stand_for, f64::from(steps), "one of {every}");
        }
    }
}

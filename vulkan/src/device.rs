//! The device at work: one allocation, the pipelines, the command buffer, and the uniform block of the step at hand.
//!
//! A step is two submissions: projection, sort and counting first, so that the host knows how many instances there are;
//! then blending, loss, gradient and Adam — in several bands of tiles when the instances do not fit, with the same bits.

pub(crate) mod bands;
pub(crate) mod frame;
mod passes;

pub(crate) use bands::{Band, Counted};
pub(crate) use passes::Gradients;

use crate::arena::Arena;
use crate::commands::{Commands, Recording, Running};
use crate::error::TrainError;
use crate::gpu::Gpu;
use crate::kernel_config::KernelConfig;
use crate::kernels::{Group, Kernel};
use crate::layout::{Frame, Status};
use crate::pipelines::Pipelines;
use crate::processor::Processor;
use crate::stages::STAGE_NAMES;
use crate::times::Times;
use bytemuck::Zeroable;
use config::plan::Plan;

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

/// Who runs the kernels.
enum Runner {
    Driver(Commands, Box<Pipelines>),
    Processor(Box<Processor>),
}

/// Everything that training needs of one device.
pub struct Device {
    // Dropped in this order: what refers to the arena first, the GPU last.
    runner: Runner,
    times: Times,
    pub(crate) arena: Arena,
    gpu: Gpu,
    plan: Plan,
    /// The uniform block, as it was or will be written.
    pub(crate) frame: Box<Frame>,
    pub(crate) bands: Vec<Band>,
    /// Dispatches that counting and emitting are spread over.
    pub(crate) walk_rounds: u32,
    /// Of so many steps one is timed, after as many at the beginning.
    timed_every: u32,
}

impl Device {
    /// Allocates `plan.total_bytes` on the device and compiles `kernels`; the others must not be run. `own_degrees`: whether
    /// Gaussians have SH degrees of their own, or all the plan's.
    ///
    /// # Errors
    /// [`TrainError::Gpu`]: device, driver, memory, limits.
    pub(crate) fn new(
        gpu: &Gpu,
        plan: &Plan,
        config: KernelConfig,
        own_degrees: bool,
        kernels: &[Kernel],
    ) -> Result<Self, TrainError> {
        let arena = Arena::new(gpu, plan)?;
        let runner = match gpu.vulkan() {
            Some(vulkan) => Runner::Driver(
                Commands::new(vulkan)?,
                Box::new(Pipelines::new(vulkan, plan, &arena, config, own_degrees, kernels)?),
            ),
            None => Runner::Processor(Box::new(Processor::new(gpu, plan, own_degrees))),
        };
        Ok(Self {
            runner,
            times: Times::new(),
            arena,
            gpu: gpu.clone(),
            plan: plan.clone(),
            frame: Box::new(Frame::zeroed()),
            bands: Vec::with_capacity(plan.tiles),
            walk_rounds: bands::WALK_ROUNDS,
            timed_every: TIMED_EVERY,
        })
    }

    /// The GPU, or what stands for one.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// The plan everything was allocated by.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Bytes really allocated on the device.
    pub fn bytes(&self) -> u64 {
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

    /// Milliseconds per stage since the Gaussians were loaded, in pipeline order, of all steps as the timed ones let one
    /// expect; zeros on devices without timestamps.
    pub fn stage_ms(&self) -> [(&'static str, f64); STAGE_NAMES.len()] {
        let ms = self.times.stage_ms();
        std::array::from_fn(|i| (STAGE_NAMES[i], ms[i]))
    }

    /// Milliseconds of the wide, the narrow and the blending kernels since then, whose sizes a [`KernelConfig`] chooses apart; zeros
    /// without timestamps.
    pub fn kind_ms(&self) -> [f64; 3] {
        let ms = self.times.group_ms();
        let of = |group: Group| ms[group as usize];
        [of(Group::Wide) + of(Group::Strips), of(Group::Sort) + of(Group::Walk), of(Group::Tiles)]
    }

    pub(crate) fn clear_times(&self) {
        self.times.clear();
    }

    /// Times the submissions of the step after `steps`, where it is one of those that are timed.
    pub(crate) fn time_step(&self, steps: u32) {
        self.times.weigh(timed_weight(steps, self.timed_every));
    }

    /// Times what is submitted between steps.
    pub(crate) fn time_all(&self) {
        self.times.weigh(1.0);
    }

    /// Begins a submission.
    pub(crate) fn begin(&self) -> Result<Recording<'_>, TrainError> {
        let (arena, times) = (&self.arena, &self.times);
        match &self.runner {
            Runner::Driver(commands, pipelines) => Ok(commands.begin(pipelines, arena, times)?),
            Runner::Processor(processor) => Ok(Recording::Processor(Running { processor, arena, times })),
        }
    }

    /// Puts the uniform block where the kernels read it.
    pub(crate) fn write_frame(&mut self) {
        let section = self.arena.section("frame");
        self.arena.slice_mut::<Frame>(section)[0] = *self.frame;
    }

    /// What the kernels left; the device must be idle.
    pub(crate) fn status(&self) -> &Status {
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

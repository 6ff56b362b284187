//! The Gaussians: parameters and Adam's moments in the device's arena, and the cells in which those wait that find no room there.

mod amend;
mod contents;
mod deferred;
mod degrees;
mod kept;
mod moments;
mod paging;
mod parameters;
mod scene;
mod state;

pub use amend::{BoundingBox, Fate, Trained};
pub use kept::{LoadReport, Pieces};
pub(crate) use parameters::{Geometry, clear};
pub(crate) use scene::{Blocks, Choice};

use crate::device::Device;
use crate::error::TrainError;
use config::plan::Plan;
use config::training::{AdamSettings, TrainSettings, scene_extent};
use deferred::Deferred;
use degrees::Degrees;
use parameters::Parameters;
use scene::Scene;

/// Counted work and skipped work since the Gaussians were loaded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Gaussians that were projected and found out of view.
    pub culled: u64,
    /// Gaussian–tile instances.
    pub instances: u64,
    /// Gaussian–pixel evaluations of the forward blend (the backward repeats them).
    pub evaluations: u64,
    /// Instances not evaluated because their tile was already opaque.
    pub behind_opaque: u64,
    /// Steps that needed more than one band.
    pub banded_steps: u64,
    /// Gaussians whose gradient was not finite and was left out.
    pub non_finite_gradients: u64,
    /// Dead Gaussians moved onto live ones.
    pub relocated: u64,
    /// Gaussians added by splitting.
    pub added: u64,
    /// Gaussians removed.
    pub pruned: u64,
    /// Windows of cells that were trained.
    pub windows: u64,
    /// Bytes of cells written to their file and read from it.
    pub paged_bytes: u64,
    /// Times a Gaussian's own SH degree was raised because the residual asked for it.
    pub sh_raised: u64,
    /// SH coefficients that were not there to be evaluated and stepped, summed over Gaussians and steps (as of the last
    /// raise).
    pub sh_missing: u64,
}

/// The Gaussians of a scene with their optimiser's state.
pub(crate) struct Model {
    pub parameters: Parameters,
    /// One Gaussian on its way to the host.
    record: Vec<u8>,
    pub scene: Scene,
    /// Gaussians on the device.
    pub gaussians: usize,
    /// Updates since the Gaussians were loaded: one for each picture visited, or for each part of one.
    pub updates: u32,
    /// Whether the lazy Adam updates of all Gaussians are done.
    pub flushed: bool,
    pub deferred: Deferred,
    degrees: Degrees,
    /// Length scale of the scene, metres (see [`scene_extent`]); learning rates of positions are relative to it. 0: not measured.
    pub extent: f32,
    /// Gaussians have SH degrees of their own; else all have the plan's.
    own_degrees: bool,
    pub counters: Counters,
}

impl Model {
    /// No Gaussian, and room for those of the device's plan.
    pub fn new(device: &Device, settings: &TrainSettings) -> Self {
        let plan = device.plan();
        Self {
            parameters: Parameters::new(&device.arena, plan),
            record: vec![0; plan.record_bytes()],
            scene: Scene::new(plan),
            gaussians: 0,
            updates: 0,
            flushed: true,
            deferred: Deferred::new(&settings.adam),
            degrees: Degrees::new(plan.gaussians),
            extent: 1.0,
            own_degrees: settings.sh.raise_share < 1.0,
            counters: Counters::default(),
        }
    }

    /// Forgets what was trained of other Gaussians than those just loaded.
    fn restart(&mut self) {
        self.updates = 0;
        self.flushed = true;
        self.deferred.reset();
        self.degrees.reset();
        self.extent = 0.0;
        self.counters = Counters::default();
    }

    /// Number of Gaussians, those that are not on the device included.
    pub fn total(&self) -> usize {
        self.gaussians + self.scene.away
    }

    /// Those on the device.
    pub fn geometry<'a>(&self, device: &'a Device) -> &'a [Geometry] {
        &self.parameters.geometry(&device.arena)[..self.gaussians]
    }

    /// Those on the device.
    pub fn geometry_mut<'a>(&self, device: &'a mut Device) -> &'a mut [Geometry] {
        &mut self.parameters.geometry_mut(&mut device.arena)[..self.gaussians]
    }

    /// Copies Gaussian `from` to place `to`, which is another's or the first behind the last, without its first moments.
    pub fn copy(&mut self, device: &mut Device, from: usize, to: usize) {
        self.parameters.copy(&mut device.arena, from, to);
        self.scene.place(from, to);
    }

    /// Takes in that a step was taken, the `adam_step`th of Adam, with all rates multiplied by `decay`.
    pub fn stepped(&mut self, adam_step: u32, mean_rate: f32, decay: f32) {
        self.updates += 1;
        self.flushed = false;
        self.deferred.push(adam_step, mean_rate, decay);
    }

    /// Does the lazy Adam updates of all Gaussians, so that they may be read or moved.
    pub fn flush(&mut self, device: &mut Device) -> Result<(), TrainError> {
        if self.flushed || self.gaussians == 0 {
            return Ok(());
        }
        device.frame.gaussians = self.gaussians as u32;
        device.frame.step = self.updates + 1;
        self.deferred.write(&mut device.frame.deferred);
        device.catch_up()?;
        self.flushed = true;
        Ok(())
    }

    /// Measures the length scale of the scene, where that is not done, by the Gaussians and where the cameras are.
    pub fn measure_extent(&mut self, device: &Device, cameras: impl FnOnce() -> Vec<[f64; 3]>) {
        if self.extent > 0.0 {
            return;
        }
        if self.scene.is_paged() {
            self.extent = scene_extent(self.scene.means(), &cameras());
            return;
        }
        let means: Vec<[f32; 3]> = self.geometry(device).iter().map(|g| g.mean).collect();
        self.extent = scene_extent(&means, &cameras());
    }

    /// Holds the Gaussians for which `is_held(place)` says so: no gradient moves them.
    pub fn hold(&mut self, device: &mut Device, is_held: impl Fn(usize) -> bool) {
        for index in (0..self.gaussians).filter(|i| is_held(*i)) {
            self.parameters.hold(&mut device.arena, index);
        }
    }

    /// Forgets the moments of those on the device.
    pub fn forget_moments(&mut self, device: &mut Device) {
        for index in 0..self.gaussians {
            self.parameters.forget(&mut device.arena, index);
        }
    }

    /// Before the first step: where degrees are not raised by residual, every Gaussian has the highest at once.
    pub fn open_degrees(&mut self, device: &mut Device) {
        if !self.own_degrees {
            let degree = device.plan().sh_degree;
            for g in self.geometry_mut(device) {
                g.state = state::with_degree(g.state, degree);
            }
        }
        self.count_missing(device);
    }

    /// Raises the degree of those that ask most, when an occasion has come.
    pub fn raise_degrees(
        &mut self,
        device: &mut Device,
        progress: f32,
        settings: &TrainSettings,
    ) -> Result<(), TrainError> {
        if !self.own_degrees || !self.degrees.is_due(progress) {
            return Ok(());
        }
        self.flush(device)?;
        let limit = settings.sh.degree.min(device.plan().sh_degree);
        let unbias = unbias(&settings.adam, self.updates);
        let asking = degrees::Asking { of: self.gaussians, share: settings.sh.raise_share, limit, unbias };
        self.counters.sh_raised += self.degrees.raise(device, &self.parameters, &asking);
        self.count_missing(device);
        Ok(())
    }

    fn count_missing(&mut self, device: &Device) {
        self.degrees.count_missing(&self.parameters.geometry(&device.arena)[..self.gaussians], device.plan());
    }

    /// SH coefficients that a step does not touch, because no Gaussian has them.
    pub fn missing_coefficients(&self) -> u64 {
        self.degrees.missing
    }
}

/// What Adam multiplies first and second moments by after so many updates, which begin at zero.
fn unbias(adam: &AdamSettings, updates: u32) -> [f32; 2] {
    [adam.beta1, adam.beta2].map(|beta| 1.0 / (1.0 - f64::from(beta).powi(updates as i32)) as f32)
}

/// The SH degree that all Gaussians have, where they have one.
fn common_degree(plan: &Plan, own_degrees: bool) -> Option<u8> {
    (!own_degrees).then_some(plan.sh_degree)
}

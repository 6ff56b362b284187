//! Numbers that broke other renderers: for each case what is promised, and a function that tries it — on the device, on
//! the CPU reference, or both. The tests run them one by one (`tests/numerical_gpu.rs`, `tests/numerical_reference.rs`), and
//! `bench stress` runs them all on whatever device is there.

/// Ends the case as broken unless the condition holds.
macro_rules! promise {
    ($holds:expr $(,)?) => {
        let holds: bool = $holds;
        if !holds {
            return Err($crate::cases::Broken(stringify!($holds).to_owned()));
        }
    };
    ($holds:expr, $($words:tt)+) => {
        let holds: bool = $holds;
        if !holds {
            return Err($crate::cases::Broken(format!($($words)+)));
        }
    };
}

/// Ends the case as broken unless both are equal.
macro_rules! promise_eq {
    ($got:expr, $expected:expr $(,)?) => {
        promise_eq!($got, $expected, "{}", stringify!($got))
    };
    ($got:expr, $expected:expr, $($words:tt)+) => {{
        let (got, expected) = (&$got, &$expected);
        if got != expected {
            return Err($crate::cases::Broken(format!("{}: {got:?} instead of {expected:?}", format!($($words)+))));
        }
    }};
}

pub mod device;
pub mod extremes;
pub mod half;
pub mod instances;
mod list;
pub mod reference;
pub mod scenes;

pub use list::{CASES, ELSEWHERE};

use crate::gpu::{Gpu, GpuError};
use crate::trainer::TrainError;
use config::plan::PlanError;
use config::training::LossSettings;
use models::camera::View;
use models::cloud::GaussianCloud;

/// A promise that was not kept: which number, where.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Broken(pub String);

impl From<TrainError> for Broken {
    fn from(e: TrainError) -> Self {
        Self(e.to_string())
    }
}

impl From<GpuError> for Broken {
    fn from(e: GpuError) -> Self {
        Self(e.to_string())
    }
}

impl From<PlanError> for Broken {
    fn from(e: PlanError) -> Self {
        Self(e.to_string())
    }
}

/// What was counted while the promise held, or how it was broken.
pub type Outcome = Result<String, Broken>;

/// One promise.
#[derive(Clone, Copy)]
pub struct Case {
    /// What may come in.
    pub input: &'static str,
    /// What is promised then.
    pub promise: &'static str,
    /// Through training steps on the device.
    pub device: Option<fn(&Gpu) -> Outcome>,
    /// Through the reference.
    pub reference: Option<fn() -> Outcome>,
}

/// What a case went through.
#[derive(Clone, Copy, Debug, Default)]
pub struct Tally {
    scenes: u32,
    steps: u32,
    visible: u64,
    instances: u64,
}

impl Tally {
    /// A scene was rendered and trained.
    pub fn scene(&mut self, steps: u32, visible: usize, instances: u64) {
        self.scenes += 1;
        self.steps += steps;
        self.visible += visible as u64;
        self.instances += instances;
    }

    /// The reference's answer, counted.
    pub fn ask(
        &mut self,
        cloud: &GaussianCloud,
        view: &View,
        photo: &[[f32; 3]],
        loss: &LossSettings,
    ) -> scenes::Answer {
        let answer = scenes::answer(cloud, view, photo, loss);
        self.scene(1, answer.culled.iter().filter(|c| c.is_none()).count(), answer.instances as u64);
        answer
    }

    /// As a line; empty when the case counts nothing.
    pub fn said(&self) -> String {
        if self.scenes == 0 {
            return String::new();
        }
        let Self { scenes, steps, visible, instances } = self;
        format!("{scenes} scenes, {steps} steps, {visible} visible, {instances} instances")
    }
}

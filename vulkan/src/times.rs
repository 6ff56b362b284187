//! Milliseconds of each stage and of each kind of kernel, whoever runs them.

use crate::kernels::{GROUPS, Group};
use crate::stages::{DEVICE_TIMES, STAGE_NAMES, Stage};
use std::cell::Cell;

/// Times since they were last cleared.
pub(crate) struct Times {
    stage_ms: Cell<[f64; STAGE_NAMES.len()]>,
    group_ms: Cell<[f64; GROUPS]>,
    /// How many submissions a timed one stands for; 0: it is not timed.
    weight: Cell<f64>,
}

impl Times {
    pub fn new() -> Self {
        Self {
            stage_ms: Cell::new([0.0; STAGE_NAMES.len()]),
            group_ms: Cell::new([0.0; GROUPS]),
            weight: Cell::new(1.0),
        }
    }

    /// Milliseconds per stage.
    pub fn stage_ms(&self) -> [f64; STAGE_NAMES.len()] {
        self.stage_ms.get()
    }

    /// Milliseconds that each kind of kernel took (by `Group as usize`).
    pub fn group_ms(&self) -> [f64; GROUPS] {
        self.group_ms.get()
    }

    pub fn clear(&self) {
        self.group_ms.set([0.0; GROUPS]);
        self.stage_ms.set([0.0; STAGE_NAMES.len()]);
    }

    /// From here on times count `weight` times; with 0 none are taken.
    pub fn weigh(&self, weight: f64) {
        self.weight.set(weight);
    }

    /// Whether what comes is timed.
    pub fn are_taken(&self) -> bool {
        self.weight.get() > 0.0 || is_traced()
    }

    /// Adds what a stage took, and the kind of kernel that ran in it.
    pub fn add(&self, stage: Stage, group: Option<Group>, ms: f64) {
        let (mut stages, mut groups, ms) = (self.stage_ms.get(), self.group_ms.get(), ms * self.weight.get());
        stages[stage as usize] += ms;
        if let Some(group) = group {
            groups[group as usize] += ms;
        }
        self.stage_ms.set(stages);
        self.group_ms.set(groups);
    }
}

/// Whether somebody wants to know when every kernel ran.
pub(crate) fn is_traced() -> bool {
    tracing::enabled!(target: DEVICE_TIMES, tracing::Level::TRACE)
}

/// Tells when a stage ran, before now and how long.
pub(crate) fn tell(stage: Stage, ago_ns: u64, took_ns: u64) {
    tracing::trace!(target: DEVICE_TIMES, stage = stage as u64, ago_ns, took_ns);
}

//! At which size pictures are trained, and how many crops of them: what the device's plan holds.

use config::budget::Memory;
use config::plan::{Lanes, Plan, WORKING_SIDE};
use engine::device::DeviceRequest;
use engine::preset::SCALES;
use survey::card::name_list;
use survey::dataset::{Dataset, scaled};

use super::TrainJob;
use crate::error::JobError;

/// Room that must remain for Gaussians before pictures are made larger: a small survey's worth.
const GAUSSIANS_OF_A_CARD: usize = 100_000;
/// Pictures of fewer pixels a side show nothing.
const LEAST_SIDE: u32 = 8;
/// Lanes that share the work at most; fewer need less memory.
const MOST_LANES: Lanes = Lanes::CARD;

/// How large pictures are trained, as a share of their size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PictureScale {
    /// This, whatever the memory.
    Exactly(f64),
    /// That of a size of job, or less where its memory does not hold it.
    OfJob(f64),
    /// As large as the memory holds.
    AsHeld,
}

impl PictureScale {
    /// What was asked for.
    pub fn exact(self) -> Option<f64> {
        match self {
            Self::Exactly(scale) => Some(scale),
            _ => None,
        }
    }
}

/// Size of the largest picture by area.
pub(super) fn largest(set: &Dataset, frames: &[usize], scale: f64) -> Result<(u32, u32), JobError> {
    let sizes = frames.iter().map(|&i| scaled(&set.frames[i].view.intrinsics, scale));
    let sizes = sizes.collect::<Result<Vec<_>, _>>()?;
    Ok(sizes.iter().max_by_key(|k| k.pixels()).map_or((1, 1), |k| (k.width, k.height)))
}

/// Returns the frames that have something to learn from at `scale`; the others are named.
///
/// # Errors
/// There is none.
pub(super) fn large_enough(set: &Dataset, frames: Vec<usize>, scale: f64) -> Result<Vec<usize>, JobError> {
    let mut small = Vec::new();
    let mut left = Vec::with_capacity(frames.len());
    for i in frames {
        let lens = scaled(&set.frames[i].view.intrinsics, scale)?;
        match lens.width.min(lens.height) < LEAST_SIDE {
            true => small.push(&set.frames[i].name),
            false => left.push(i),
        }
    }
    if !small.is_empty() {
        let what = format!("fewer than {LEAST_SIDE} pixels a side at scale {scale}");
        if left.is_empty() {
            return Err(JobError::Request(format!("{}: its pictures have {what}; raise --scale", set.root.display())));
        }
        tracing::warn!("{}: {what}; left out", name_list(&small));
    }
    Ok(left)
}

impl TrainJob {
    /// The scale asked for; else the largest, up to that of the size of job, for which the device holds all pictures and, for a card,
    /// Gaussians worth the name; for more pictures than that a working size, and some of them wait in a file.
    pub(super) fn picture_scale(&self, set: &Dataset, is_card: bool) -> Result<f64, JobError> {
        let named = match self.pictures.scale {
            PictureScale::Exactly(scale) => return Ok(scale),
            PictureScale::OfJob(scale) => Some(scale),
            PictureScale::AsHeld => None,
        };
        let frames = set.select(&self.pictures.split, self.pictures.region.as_deref())?;
        let most_gaussians = self.memory.max_gaussians.map_or(usize::MAX, |n| n as usize);
        let wanted = if is_card { most_gaussians.min(GAUSSIANS_OF_A_CARD) } else { 0 };
        let most = named.unwrap_or(1.0);
        for scale in SCALES.into_iter().rev().filter(|scale| *scale <= most) {
            let all_on_device = DeviceRequest {
                device: None,
                memory: Memory {
                    view_slots: self.memory.view_slots.or(Some(frames.len() as u32)),
                    scene_gaussians: None,
                    ..self.memory
                },
                size: largest(set, &frames, scale)?,
                views: frames.len(),
                crops: 0,
                folder: None,
            };
            let some_in_file = Memory { view_slots: self.memory.view_slots, ..all_on_device.memory };
            let some_in_file = DeviceRequest { memory: some_in_file, ..all_on_device.clone() };
            let holds = |request: &DeviceRequest| {
                let plan = Plan::new(&request.plan_request(&self.recipe.training.sh, MOST_LANES));
                plan.is_ok_and(|p| p.gaussians >= wanted)
            };
            let (w, h) = all_on_device.size;
            // Whoever names a size of job means the pictures at that size.
            let may_wait = w.max(h) <= WORKING_SIDE || named.is_some();
            if holds(&all_on_device) || (may_wait && holds(&some_in_file)) {
                if is_card || scale < most {
                    let mib = self.memory.device_mib();
                    tracing::info!("pictures of {w}x{h} (scale {scale}), as large as {mib} MiB hold");
                }
                return Ok(scale);
            }
        }
        // Not even the smallest fits: the plan itself says what is missing.
        Ok(most)
    }

    /// Crops that find use: all of all pictures, at the most as many as the settings say.
    pub(super) fn crops(&self, set: &Dataset, frames: &[usize], scale: f64) -> Result<usize, JobError> {
        let settings = &self.recipe.training.crops;
        let mut all = 0;
        for &i in frames {
            let (whole, small) = (&set.frames[i].view.intrinsics, scaled(&set.frames[i].view.intrinsics, scale)?);
            all += settings.planned((whole.width, whole.height), (small.width, small.height));
        }
        Ok(all.min(settings.most) as usize)
    }
}

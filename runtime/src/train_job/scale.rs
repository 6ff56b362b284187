//! At which size pictures are trained, and how many crops of them: what the device's plan holds.

use config::plan::{Lanes, Plan, WORKING_SIDE};
use engine::device::DeviceRequest;
use engine::preset::SCALES;
use survey::dataset::{Dataset, scaled};

use super::TrainJob;
use crate::error::JobError;

/// Room that must remain for Gaussians before pictures are made larger: a small survey's worth.
const GAUSSIANS_OF_A_CARD: usize = 100_000;
/// Lanes that share the work at most; fewer need less memory.
const MOST_LANES: Lanes = Lanes::CARD;

/// Size of the largest picture by area.
pub(super) fn largest(set: &Dataset, frames: &[usize], scale: f64) -> Result<(u32, u32), JobError> {
    let sizes = frames.iter().map(|&i| scaled(&set.frames[i].view.intrinsics, scale));
    let sizes = sizes.collect::<Result<Vec<_>, _>>()?;
    Ok(sizes.iter().max_by_key(|k| k.pixels()).map_or((1, 1), |k| (k.width, k.height)))
}

impl TrainJob {
    /// The scale asked for; else the largest for which the device holds all pictures and, for a card, Gaussians worth the name;
    /// for more pictures than that a working size, and some of them wait in a file.
    pub(super) fn picture_scale(&self, set: &Dataset, is_card: bool) -> Result<f64, JobError> {
        if let Some(scale) = self.scale {
            return Ok(scale);
        }
        let frames = set.select(&self.split, self.region.as_deref())?;
        let wanted = if is_card { self.max_gaussians.unwrap_or(usize::MAX).min(GAUSSIANS_OF_A_CARD) } else { 0 };
        for scale in SCALES.into_iter().rev() {
            let all_on_device = DeviceRequest {
                device: None,
                device_mib: self.budget_mib(),
                size: largest(set, &frames, scale)?,
                views: frames.len(),
                crops: 0,
                view_slots: self.view_slots.or(Some(frames.len() as u32)),
                folder: None,
                max_gaussians: self.max_gaussians,
                scene_gaussians: None,
            };
            let some_in_file = DeviceRequest { view_slots: self.view_slots, ..all_on_device.clone() };
            let holds = |request: &DeviceRequest| {
                let plan = Plan::new(&request.plan_request(&self.training.sh, MOST_LANES));
                plan.is_ok_and(|p| p.gaussians >= wanted)
            };
            let (w, h) = all_on_device.size;
            if holds(&all_on_device) || (w.max(h) <= WORKING_SIDE && holds(&some_in_file)) {
                if is_card || scale < 1.0 {
                    tracing::info!("pictures of {w}x{h} (scale {scale}), as large as {} MiB hold", self.budget_mib());
                }
                return Ok(scale);
            }
        }
        // Not even the smallest fits: the plan itself says what is missing.
        Ok(1.0)
    }

    /// Crops that find use: all of all pictures, at the most as many as the settings say.
    pub(super) fn crops(&self, set: &Dataset, frames: &[usize], scale: f64) -> Result<usize, JobError> {
        let settings = &self.training.crops;
        let mut all = 0;
        for &i in frames {
            let (whole, small) = (&set.frames[i].view.intrinsics, scaled(&set.frames[i].view.intrinsics, scale)?);
            all += settings.planned((whole.width, whole.height), (small.width, small.height));
        }
        Ok(all.min(settings.most) as usize)
    }
}

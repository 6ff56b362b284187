//! What `--preset auto` chooses for a folder: by its pictures, the share of the scene that each shows, and what a step costs here.

use config::kernels::KernelChoice;
use engine::device::DeviceRequest;
use engine::energy::{Meter, shorter};
use engine::preset::{Choice, Room, Wanted, most_side, shown};
use models::camera::Pinhole;
use survey::dataset::Dataset;
use tuning::cost;
use tuning::devices;
use tuning::kernels;

use super::TrainJob;
use super::scale::{PictureScale, largest};
use crate::error::JobError;

/// Points and pictures sampled for the share of a scene that a picture shows, at the most; and the least of points that says
/// something.
const MOST_POINTS: usize = 2000;
const MOST_PICTURES: usize = 64;
const LEAST_POINTS: usize = 50;

impl TrainJob {
    /// The sizes, where they are to be chosen; those of an earlier run in the folder of results, where there was one. `None` where nothing
    /// may be measured: then the defaults hold.
    pub(super) fn chosen(&self, set: &Dataset) -> Result<Option<Choice>, JobError> {
        if !self.auto {
            return Ok(None);
        }
        let frames = set.select(&self.pictures.split, self.pictures.region.as_deref())?;
        let picture = largest(set, &frames, 1.0)?;
        let of_these = |kept: &Choice| (kept.picture, kept.views) == (picture, frames.len());
        if let Some(kept) = Choice::kept(&self.output.folder).filter(|kept| !self.output.fresh && of_these(kept)) {
            tracing::info!("{kept} (as this training began)");
            return Ok(Some(kept));
        }
        let choice = self.measured(set, &frames, picture)?;
        match &choice {
            Some(choice) => {
                choice.keep(&self.output.folder)?;
                tracing::info!("{choice}");
            }
            None => tracing::warn!("auto: what a step costs here is not known; the defaults of dgtr train are used"),
        }
        Ok(choice)
    }

    fn measured(&self, set: &Dataset, frames: &[usize], picture: (u32, u32)) -> Result<Option<Choice>, JobError> {
        if kernels::choice() == KernelChoice::Standard {
            return Ok(None);
        }
        let gpu = devices::open(self.device.as_deref()).map_err(vulkan::trainer::TrainError::from)?;
        let Some(cost) = cost::of(&gpu, kernels::config_of(&gpu)) else { return Ok(None) };
        let training = self.settings(frames.len());
        let seconds = shorter(training.seconds, Meter::of(&training)?.map(|meter| meter.seconds()));
        let device = DeviceRequest {
            device: None,
            memory: self.memory,
            size: picture,
            views: frames.len(),
            crops: 1,
            folder: None,
        };
        let wanted = Wanted {
            picture,
            most_side: most_side(picture, seconds),
            views: frames.len(),
            share: share(set, frames)?,
            device,
            sh: training.sh,
            resolution: training.resolution,
            schedule: self.recipe.training.steps_for(frames.len()),
            steps: self.budget.steps,
            seconds,
            max_gaussians: self.memory.max_gaussians,
            image_scale: self.pictures.scale.exact(),
        };
        Ok(wanted.choose(&cost, &Room::of(gpu.info(), self.memory.device_mib, None), gpu.info().lanes()))
    }

    /// What was said stays.
    pub(super) fn fill(&mut self, choice: &Choice) {
        self.memory.device_mib = self.memory.device_mib.or(Some(choice.device_mib));
        self.memory.max_gaussians = self.memory.max_gaussians.or(Some(choice.max_gaussians));
        if self.pictures.scale.exact().is_none() {
            self.pictures.scale = PictureScale::Exactly(choice.image_scale);
        }
        if self.recipe.training.seconds.is_none() {
            self.budget.seconds = self.budget.seconds.or(choice.seconds);
        }
    }
}

/// Share of the data set's points that one picture shows on the mean; where it has none, what so many pictures of a survey show.
fn share(set: &Dataset, frames: &[usize]) -> Result<f64, JobError> {
    let points = set.sparse_points_of(frames)?;
    if points.len() < LEAST_POINTS {
        return Ok(shown(frames.len()));
    }
    let every = |all: usize, most: usize| all.div_ceil(most).max(1);
    let points: Vec<_> = points.iter().step_by(every(points.len(), MOST_POINTS)).map(|p| p.position.into()).collect();
    let (mut seen, mut looked) = (0usize, 0usize);
    for &i in frames.iter().step_by(every(frames.len(), MOST_PICTURES)) {
        let (view, lens) = (Pinhole::from(&set.frames[i].view), set.frames[i].view.intrinsics);
        seen += points.iter().filter(|p| view.project(**p).is_some_and(|at| lens.contains(at))).count();
        looked += points.len();
    }
    Ok(if seen > 0 { seen as f64 / looked as f64 } else { shown(frames.len()) })
}

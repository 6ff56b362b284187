//! A flight's choice: made before the first picture, kept in the output folder, and held to by a flight that goes on.

use std::path::Path;

use config::kernels::KernelChoice;
use config::mission::{Aircraft, Mission};
use config::plan::WORKING_SIDE;
use config::preset::Preset;
use job::session;
use vulkan::gpu::{Gpu, GpuInfo};

use super::{Choice, Room, Wanted, shown};
use crate::device::DeviceRequest;
use crate::energy::{Meter, shorter};
use crate::model_path;
use tuning::cost;
use tuning::devices;
use tuning::kernels;
use tuning::model::CostModel;

/// Fills what the mission leaves to its device, and says what was chosen; `None` where the mission gives its numbers, and where nothing may
/// be or was measured: then the defaults of the mission file hold. A device that was never measured is, which takes seconds. Whoever owns
/// `out` [keeps](Choice::keep) the choice there.
pub fn of_flight(mission: &mut Mission, aircraft: &Aircraft, out: &Path) -> Option<Choice> {
    if !mission.memory.is_auto() {
        return None;
    }
    // Another flight's files will be put aside: nothing of it goes on.
    let goes_on =
        session::owner(out).is_none_or(|o| (o.mission, o.aircraft) == (mission.name.clone(), aircraft.id.clone()));
    if let Some(kept) = Choice::kept(out).filter(|_| goes_on) {
        tracing::info!("{kept} (as this flight began)");
        fill(mission, &kept);
        return Some(kept);
    }
    // One that began without a choice, by an earlier version or unmeasured, keeps the sizes it began with.
    if goes_on && (model_path(out).exists() || out.join("keyframes/transforms.json").exists()) {
        return None;
    }
    let Some(choice) = measured(mission, aircraft) else {
        if mission.memory.preset == Some(Preset::Auto) {
            tracing::warn!(
                "auto: what a step costs here is not known; the defaults of [memory] and [training] are used"
            );
        }
        return None;
    };
    tracing::info!("{choice}");
    fill(mission, &choice);
    Some(choice)
}

fn measured(mission: &Mission, aircraft: &Aircraft) -> Option<Choice> {
    if kernels::choice() == KernelChoice::Standard {
        return None;
    }
    // Whoever opens it for the flight says what is wrong with it.
    let gpu = devices::open(aircraft.device.as_deref()).ok()?;
    let cost = cost::of(&gpu, kernels::config_of(&gpu))?;
    choose(mission, &mission.region(aircraft), gpu.info(), &cost)
}

/// Fills the same as far as the device was measured before, for those who only plan.
pub fn foresee(mission: &mut Mission, gpu: &Gpu) -> Option<Choice> {
    if !mission.memory.is_auto() || kernels::choice() == KernelChoice::Standard {
        return None;
    }
    let (info, config) = (gpu.info(), kernels::known(gpu.info()).0);
    let regions = mission.aircraft.iter().map(|a| mission.region(a));
    // All aircraft share the plan: the one with the most ground decides.
    let region = regions.max_by(|a, b| area_m2(a).total_cmp(&area_m2(b))).unwrap_or_default();
    let choice = choose(mission, &region, info, &cost::known(info, config)?)?;
    fill(mission, &choice);
    Some(choice)
}

pub(super) fn choose(mission: &Mission, region: &[[f64; 2]], info: &GpuInfo, cost: &CostModel) -> Option<Choice> {
    let (memory, training) = (&mission.memory, &mission.training);
    let pictures = planned(mission, region);
    // Whatever the size, crops are read for their steps and take the room of one.
    let device = DeviceRequest { crops: 1, ..DeviceRequest::of_flight(mission, None) };
    let picture = (mission.camera.width, mission.camera.height);
    let wanted = Wanted {
        picture,
        // What the networks see, and what every flight was measured with.
        most_side: WORKING_SIDE,
        views: pictures,
        share: shown(pictures),
        device,
        sh: training.sh,
        resolution: training.resolution,
        schedule: training.steps,
        steps: None,
        // Whoever opens the engine says what is wrong with its energy.
        seconds: shorter(training.seconds, Meter::of(training).ok().flatten().map(|meter| meter.seconds())),
        max_gaussians: memory.max_gaussians,
        image_scale: memory.image_scale.map(f64::from),
    };
    wanted.choose(cost, &Room::of(info, memory.device_mib, Some(memory.host_mib)), info.lanes())
}

/// Key frames of the planned survey: one each `t_min_m` both ways over the region, and never more than the plan has room for.
fn planned(mission: &Mission, region: &[[f64; 2]]) -> usize {
    let (each, max) = (f64::from(mission.keyframes.t_min_m), mission.keyframes.max as usize);
    let count = area_m2(region) / (each * each);
    if count >= 1.0 && count.is_finite() { (count.ceil() as usize).min(max) } else { max }
}

fn area_m2(region: &[[f64; 2]]) -> f64 {
    let next = region.iter().cycle().skip(1);
    region.iter().zip(next).map(|(a, b)| 0.5 * (a[0] * b[1] - a[1] * b[0])).sum::<f64>().abs()
}

/// What was said stays.
fn fill(mission: &mut Mission, choice: &Choice) {
    let memory = &mut mission.memory;
    memory.device_mib = memory.device_mib.or(Some(choice.device_mib));
    memory.max_gaussians = memory.max_gaussians.or(Some(choice.max_gaussians));
    memory.image_scale = memory.image_scale.or(Some(choice.image_scale as f32));
    mission.training.seconds = mission.training.seconds.or(choice.seconds);
}

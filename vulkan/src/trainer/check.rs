//! Whether a device can be relied on, found out without training: one kernel against its reference, and a plan against what the
//! device refuses.

use super::{PictureStore, TrainError, Trainer};
use crate::arena::Arena;
use crate::gpu::{Gpu, GpuError};
use crate::kernel_config::KernelConfig;
use crate::kernels::{Kernel, SCAN_LANES};
use crate::layout::Push;
use crate::pipelines::Pipelines;
use crate::reference::camera::Camera;
use crate::reference::gaussian::Gaussian;
use crate::reference::loss::Target;
use crate::reference::project::{Culled, Limits, project};
use crate::reference::trainer::ReferenceTrainer;
use crate::synthetic::{cloud, photo, plain, posed, view};
use config::plan::{Plan, PlanRequest};
use config::training::scene_extent;

/// Gaussians that the kernel is tried on.
const TRIED: usize = 200;

/// Runs the projection on the device and compares it with its reference; returns on how many Gaussians.
///
/// # Errors
/// [`GpuError::ComputesNothing`], [`GpuError::ComputesWrong`], or what the driver says, as [`TrainError::Gpu`].
pub fn check_device(gpu: &Gpu) -> Result<usize, TrainError> {
    let (v, c) = (view(64, 48), cloud(3, TRIED, 0));
    let lanes = gpu.info().lanes();
    let request = PlanRequest { width: 64, height: 48, views: 0, sh_degree: 0, lanes, ..Default::default() };
    let plan = Plan::with_capacities(&request, TRIED, TRIED);
    let config = KernelConfig::standard(gpu.info());
    let mut trainer = Trainer::with_kernels(gpu, &plan, &plain(), config, &[Kernel::Project])?;
    trainer.load(&c)?;
    let device = &mut trainer.device;
    device.frame.plain();
    (device.frame.gaussians, device.frame.step) = (TRIED as u32, 1);
    device.frame.look(&v);
    device.write_frame();
    let recording = device.begin()?;
    recording.run(Kernel::Project, TRIED, Push::default());
    recording.submit()?;
    let keys = device.arena.copied::<u32>(device.arena.section("keys"));
    let projected = device.arena.copied::<[f32; 4]>(device.arena.section("projected"));
    if keys[..TRIED].iter().all(|k| *k == 0) {
        return Err(GpuError::ComputesNothing.into());
    }
    let camera = Camera::<f32>::of(&v);
    let agrees = |i: usize| {
        let reference = project(&Gaussian::of_row(&c, i), &camera, 0, 1.0, &Limits::default());
        let reference = match reference {
            Ok(reference) => reference,
            // The two cull differently by a fraction of a pixel at the picture's edge.
            Err(Culled::Outside) => return true,
            Err(_) => return keys[i] == u32::MAX,
        };
        let inside = (0..2).all(|k| reference.mean2d[k] >= 0.0 && reference.mean2d[k] <= camera.size[k] as f32);
        if keys[i] == u32::MAX && !inside {
            return true;
        }
        let [x, y, z, _] = projected[3 * i];
        let near = |a: f32, b: f32| (a - b).abs() <= 1e-3 * (1.0 + b.abs());
        keys[i] == z.to_bits()
            && near(x, reference.mean2d[0])
            && near(y, reference.mean2d[1])
            && near(z, reference.depth)
    };
    let differ = (0..TRIED).filter(|i| !agrees(*i)).count();
    match differ {
        0 => Ok(TRIED),
        _ => Err(GpuError::ComputesWrong { kernel: "project", differ, of: TRIED }.into()),
    }
}

/// Whole training steps on the device beside those of the reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingCheck {
    /// Steps.
    pub steps: u32,
    /// Loss of the last one on the device.
    pub loss: f32,
    /// The reference's, in f64.
    pub reference_loss: f64,
}

/// Trains a small scene for so many steps with kernels of `config`, and the same on the processor in f64.
///
/// # Errors
/// What the driver says, as [`TrainError::Gpu`].
pub fn check_training(gpu: &Gpu, config: KernelConfig, steps: u32) -> Result<TrainingCheck, TrainError> {
    let (v, c, settings) = (view(64, 48), cloud(5, TRIED, 3), plain());
    let photo = photo(5, &v);
    let lanes = gpu.info().lanes();
    let request = PlanRequest { width: 64, height: 48, views: 1, lanes, ..Default::default() };
    let plan = Plan::with_capacities(&request, TRIED, 64 * TRIED);
    let mut trainer = Trainer::with_config(gpu, &plan, &settings, config)?;
    trainer.load(&c)?;
    let mut pictures = PictureStore::new(&plan);
    pictures.add(trainer.device_mut(), &posed(&v, &photo), None)?;
    let extent = scene_extent(&c.means, &[v.pose.center.to_array()]);
    let mut reference =
        ReferenceTrainer::new(Gaussian::<f64>::of_cloud(&c), settings.clone(), extent, Limits::default());
    let (camera, rgb) = (Camera::<f64>::of(&v), photo.iter().map(|p| p.map(f64::from)).collect::<Vec<_>>());
    let mut check = TrainingCheck { steps, loss: f32::NAN, reference_loss: f64::NAN };
    for step in 0..steps {
        let target = Target { width: 64, rgb: &rgb, depth: None, kept: None, background: [0.0; 3] };
        check.loss = trainer.step(&mut pictures)?.loss;
        check.reference_loss = reference.step(&camera, &target, settings.progress(step, 0.0)).loss.total;
    }
    Ok(check)
}

/// How a plan fits a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlanFit {
    /// As it is meant.
    Whole,
    /// The device shows a kernel fewer texels than the plan's sections have: kernels read storage buffers, which is slower.
    StorageReads,
}

/// Whether the device takes the plan: sizes of workgroups, texels, what the driver adds to the buffer, a heap large enough.
/// Nothing is compiled and no memory allocated.
///
/// # Errors
/// The first thing the device refuses, and how to mend it.
pub fn check_plan(gpu: &Gpu, plan: &Plan) -> Result<PlanFit, GpuError> {
    let limits = &gpu.info().limits;
    limits.check_workgroup(KernelConfig::standard(gpu.info()).largest_workgroup().max(SCAN_LANES))?;
    let storage = Pipelines::needs_storage_reads(limits, plan)?;
    Arena::check(gpu, plan)?;
    Ok(if storage { PlanFit::StorageReads } else { PlanFit::Whole })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{DeviceLimits, Forced};

    #[test]
    fn a_device_is_compared_with_its_reference_and_one_without_effect_is_named() {
        let Ok(gpu) = Gpu::open(None) else { return needs::missing(needs::Need::Vulkan, "no Vulkan device") };
        let agreed = check_device(&gpu).unwrap();
        println!("{agreed} of {TRIED} agree");
        let Ok(gpu) = Gpu::open(None) else { return };
        let gpu = gpu.forced(Forced { computes_nothing: true, ..Forced::default() });
        assert_eq!(check_device(&gpu).err(), Some(TrainError::Gpu(GpuError::ComputesNothing)));
    }

    #[test]
    fn what_a_device_refuses_of_a_plan_is_said_before_anything_is_compiled() {
        let plan = Plan::new(&PlanRequest { views: 4, ..Default::default() }).unwrap();
        let refusing = |limits: DeviceLimits, padding: u64| {
            let gpu = Gpu::open_by_driver(None).ok()?.limited(limits);
            Some(check_plan(&gpu.forced(Forced { padding, ..Forced::default() }), &plan))
        };
        let limits = DeviceLimits { workgroup_lanes: 256, texel_elements: 1 << 27, storage_buffers: 8 };
        let Some(whole) = refusing(limits, 256) else { return needs::missing(needs::Need::Vulkan, "no Vulkan device") };
        assert_eq!(whole, Ok(PlanFit::Whole));
        let few = DeviceLimits { texel_elements: 1 << 16, ..limits };
        assert!(matches!(refusing(few, 0), Some(Err(GpuError::ViewTooLarge { .. }))));
        assert_eq!(refusing(DeviceLimits { storage_buffers: 13, ..few }, 0), Some(Ok(PlanFit::StorageReads)));
        assert!(matches!(refusing(limits, 1 << 20), Some(Err(GpuError::PlanMismatch { .. }))));
        let narrow = DeviceLimits { workgroup_lanes: 128, ..limits };
        assert!(matches!(refusing(narrow, 0), Some(Err(GpuError::WorkgroupTooLarge { .. }))));
    }
}

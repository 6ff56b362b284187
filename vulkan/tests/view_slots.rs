//! Training does not depend on how many of its views are on the device: the others wait in a file and come back as they were.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../tests/counting_allocator.rs"]
mod counting_allocator;
mod scenes;

use config::plan::{Plan, PlanRequest};
use counting_allocator::allocations;
use models::camera::{DepthPrior, View};
use models::cloud::GaussianCloud;
use scenes::device::{plain, posed};
use scenes::{cloud, photo, view};
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;
use vulkan::trainer::TrainError;

const VIEWS: u32 = 5;

/// A trainer for views of `view`'s size with so many slots on the device and the others in a file.
fn trainer(view: &View, slots: u32) -> Option<Fixture> {
    let Ok(gpu) = Gpu::open(None) else {
        needs::missing(needs::Need::Vulkan, "no Vulkan device");
        return None;
    };
    let k = view.intrinsics;
    let request = PlanRequest {
        device_mib: 64,
        width: k.width,
        height: k.height,
        views: VIEWS,
        view_slots: Some(slots),
        max_gaussians: Some(300),
        scene_gaussians: None,
        ..Default::default()
    };
    let mut settings = plain();
    settings.views.residual_share = 0.4;
    let mut trainer = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &settings).unwrap();
    trainer.load(&cloud(8, 300, 3)).unwrap();
    if request.view_file_bytes() > 0 {
        trainer.pictures.keep_in(tempfile::tempfile().unwrap());
    }
    Some(trainer)
}

fn prior(view: &View, slope: f32) -> DepthPrior {
    let (width, height) = (view.intrinsics.width, view.intrinsics.height);
    let depth: Vec<f32> = (0..width * height).map(|i| 5.0 + slope * (i % width) as f32).collect();
    DepthPrior { width, height, confidence: vec![0.8; depth.len()], depth }
}

/// Views with and without depth, one smaller, one whose depth comes later; then 40 steps. Losses, bits of the model, and how
/// often a view was read back.
fn trained(slots: u32) -> Option<(Vec<u32>, GaussianCloud, u64)> {
    let v = view(64, 48);
    let mut trainer = trainer(&v, slots)?;
    for seed in 0..VIEWS {
        let v = if seed == 3 { view(48, 32) } else { v };
        let depth = (seed % 2 == 0).then(|| prior(&v, 0.1));
        trainer.add_view(&posed(&v, &photo(seed.into(), &v)), depth.as_ref()).unwrap();
    }
    trainer.set_prior(1, Some(&prior(&v, -0.05))).unwrap();
    trainer.set_prior(2, None).unwrap();
    let shown = trainer.view_image(0).unwrap();
    assert_eq!(shown, posed(&v, &photo(0, &v)).image);
    let losses = (0..40).map(|_| trainer.step().unwrap().loss.to_bits()).collect();
    let mut model = GaussianCloud::with_capacity(3, 300);
    trainer.snapshot(&mut model).unwrap();
    Some((losses, model, trainer.pictures.read_back()))
}

#[test]
fn the_model_is_the_same_to_the_bit_however_few_views_are_on_the_device() {
    let Some((losses, model, none)) = trained(VIEWS) else { return };
    assert_eq!(none, 0, "all views are on the device");
    let read_back = [2, 3].map(|slots| {
        let (same_losses, same_model, read_back) = trained(slots).unwrap();
        assert_eq!(same_losses, losses, "{slots} slots");
        assert_eq!(same_model, model, "{slots} slots");
        read_back
    });
    assert!(read_back[0] > read_back[1] && read_back[1] > 5, "{read_back:?}");
}

#[test]
fn a_view_that_comes_back_allocates_nothing() {
    let v = view(64, 48);
    let Some(mut trainer) = trainer(&v, 2) else { return };
    for seed in 0..VIEWS {
        trainer.add_view(&posed(&v, &photo(seed.into(), &v)), None).unwrap();
    }
    // The first epoch fills the view order and measures the scene.
    (0..8).for_each(|_| _ = trainer.step().unwrap());
    let before = (allocations(), trainer.pictures.read_back());
    (0..30).for_each(|_| _ = trainer.step().unwrap());
    assert_eq!(allocations(), before.0);
    assert!(trainer.pictures.read_back() >= before.1 + 10);
    assert_eq!(trainer.device().bytes(), trainer.plan().total_bytes);
}

#[test]
fn a_file_that_is_missing_or_cut_is_an_error_and_never_another_picture() {
    let v = view(64, 48);
    let Some(mut forgotten) = trainer(&v, 2) else { return };
    let file = tempfile::tempfile().unwrap();
    let mut trainer = trainer(&v, 2).unwrap();
    trainer.pictures.keep_in(file.try_clone().unwrap());
    for seed in 0..VIEWS {
        trainer.add_view(&posed(&v, &photo(seed.into(), &v)), None).unwrap();
    }
    file.set_len(100).unwrap();
    let failed = (0..VIEWS).filter_map(|i| trainer.view_image(i as usize).err()).collect::<Vec<_>>();
    assert_eq!(failed.len(), VIEWS as usize - 1, "one that was on the device gave way, the last is whole");
    assert!(failed.iter().all(|e| matches!(e, TrainError::ViewFile(_)) && e.to_string().lines().count() == 1));
    assert!((0..20).any(|_| matches!(trainer.step(), Err(TrainError::ViewFile(_)))));

    // A disk that is full: nothing that was added before is lost.
    let full = std::fs::OpenOptions::new().read(true).write(true).open("/dev/full").unwrap();
    forgotten.pictures.keep_in(full);
    let picture = posed(&v, &photo(1, &v));
    assert!(matches!(forgotten.add_view(&picture, None), Err(TrainError::ViewFile(_))));
    assert!(matches!(forgotten.step(), Err(TrainError::NoViews)));
}

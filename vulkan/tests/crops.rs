//! Training on crops of larger pictures: the same step with another lens, whichever of them are on the device.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../tests/counting_allocator.rs"]
mod counting_allocator;
mod scenes;

use config::plan::{Plan, PlanRequest};
use config::training::CropSettings;
use counting_allocator::allocations;
use image::RgbImage;
use image::imageops::crop_imm;
use models::camera::View;
use models::cloud::GaussianCloud;
use scenes::device::{plain, posed};
use scenes::{cloud, photo, view};
use vulkan::fixture::Fixture;
use vulkan::gpu::Gpu;
use vulkan::trainer::{CropPlace, TrainError};

/// A trainer for two views of 64 × 48 and four crops, with so many slots on the device.
fn trainer(crops: CropSettings, slots: u32) -> Option<Fixture> {
    let Ok(gpu) = Gpu::open(None) else {
        needs::missing(needs::Need::Vulkan, "no Vulkan device");
        return None;
    };
    let request = PlanRequest {
        device_mib: 64,
        width: 64,
        height: 48,
        views: 2,
        crops: 4,
        view_slots: Some(slots),
        max_gaussians: Some(300),
        scene_gaussians: None,
        ..Default::default()
    };
    let mut settings = plain();
    settings.crops = crops;
    let mut trainer = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &settings).unwrap();
    trainer.load(&cloud(8, 300, 3)).unwrap();
    if request.view_file_bytes() > 0 {
        trainer.pictures.keep_in(tempfile::tempfile().unwrap());
    }
    Some(trainer)
}

/// What `view`'s camera shows at twice its size.
fn larger(view: &View) -> RgbImage {
    let twice = View { intrinsics: view.intrinsics.resized(128, 96), ..*view };
    posed(&twice, &photo(5, &twice)).image
}

fn quarter(whole: &RgbImage, x: u32, y: u32) -> (RgbImage, CropPlace) {
    (crop_imm(whole, x, y, 64, 48).to_image(), CropPlace { x, y, whole: whole.dimensions() })
}

fn model(trainer: &mut Fixture) -> GaussianCloud {
    let mut model = GaussianCloud::with_capacity(3, 300);
    trainer.snapshot(&mut model).unwrap();
    model
}

const CROPS_ONLY: CropSettings = CropSettings { most: 4, scale: None, from: 0.0, share: 1.0 };

#[test]
fn a_crop_of_the_whole_picture_trains_as_the_picture_does_to_the_bit() {
    let v = view(64, 48);
    let picture = posed(&v, &photo(1, &v));
    let after = |with_crop: bool| {
        let mut trainer = trainer(CROPS_ONLY, 6)?;
        trainer.add_view(&picture, None).unwrap();
        if with_crop {
            trainer.add_crop(0, &picture.image, None, CropPlace { x: 0, y: 0, whole: (64, 48) }).unwrap();
        }
        (0..20).for_each(|_| assert_eq!(trainer.step().unwrap().crop, with_crop.then_some(0)));
        Some(model(&mut trainer))
    };
    let Some(whole) = after(false) else { return };
    assert_eq!(after(true).unwrap(), whole);
}

#[test]
fn crops_and_views_give_the_same_bits_however_few_of_them_are_on_the_device() {
    let v = view(64, 48);
    let trained = |slots: u32| {
        let mut trainer = trainer(CropSettings { share: 0.75, ..CROPS_ONLY }, slots)?;
        for seed in 0..2 {
            trainer.add_view(&posed(&v, &photo(seed, &v)), None).unwrap();
        }
        let whole = larger(&v);
        for (view, x, y) in [(0, 0, 0), (1, 64, 0), (0, 64, 48), (1, 31, 17)] {
            let (image, place) = quarter(&whole, x, y);
            trainer.add_crop(view, &image, None, place).unwrap();
        }
        let looked_at: Vec<_> =
            (0..40).map(|_| trainer.step().unwrap()).map(|r| (r.view, r.crop, r.loss.to_bits())).collect();
        Some((looked_at, model(&mut trainer), trainer.pictures.read_back()))
    };
    let Some((looked_at, same, none)) = trained(6) else { return };
    assert_eq!(none, 0);
    assert_eq!(looked_at.iter().filter(|r| r.1.is_some()).count(), 30, "three steps of four");
    assert!((0..4).all(|crop| looked_at.iter().filter(|r| r.1 == Some(crop)).count() >= 7), "each of them");
    assert!(looked_at.iter().all(|r| r.1.is_none_or(|crop| crop % 2 == r.0)), "a crop is of its own view");
    let (few_looked_at, few, read_back) = trained(2).unwrap();
    assert_eq!((few_looked_at, few), (looked_at, same));
    assert!(read_back > 10, "{read_back}");
}

#[test]
fn a_crop_moves_with_its_view_and_allocates_nothing() {
    let v = view(64, 48);
    let Some(mut trainer) = trainer(CROPS_ONLY, 2) else { return };
    trainer.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
    let whole = larger(&v);
    for (x, y) in [(0, 0), (64, 0), (0, 48)] {
        let (image, place) = quarter(&whole, x, y);
        trainer.add_crop(0, &image, None, place).unwrap();
    }
    (0..6).for_each(|_| _ = trainer.step().unwrap());
    let before = (allocations(), trainer.pictures.read_back());
    (0..20).for_each(|_| _ = trainer.step().unwrap());
    assert_eq!(allocations(), before.0);
    assert!(trainer.pictures.read_back() > before.1);
    assert_eq!(trainer.device().bytes(), trainer.plan().total_bytes);
    // Turned away, the camera sees nothing; so do its crops.
    let mut away = v;
    away.pose.rotation *= glam::DQuat::from_rotation_y(std::f64::consts::PI);
    trainer.pictures.renew(0, away).unwrap();
    let report = trainer.step().unwrap();
    assert!(report.crop.is_some() && report.visible == 0, "{report:?}");
}

#[test]
fn a_crop_that_does_not_fit_is_an_error_and_none_is_added() {
    let v = view(64, 48);
    let Some(mut trainer) = trainer(CROPS_ONLY, 6) else { return };
    trainer.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
    let whole = larger(&v);
    let (image, place) = quarter(&whole, 64, 48);
    let refused = |trainer: &mut Fixture, view: usize, image: &RgbImage, place: CropPlace| {
        matches!(trainer.add_crop(view, image, None, place), Err(TrainError::BadView { .. }))
    };
    assert!(refused(&mut trainer, 1, &image, place), "no such view");
    assert!(refused(&mut trainer, 0, &image, CropPlace { x: 65, ..place }), "beyond the right edge");
    assert!(refused(&mut trainer, 0, &image, CropPlace { y: u32::MAX, ..place }), "beyond the lower edge");
    assert!(refused(&mut trainer, 0, &RgbImage::new(0, 0), place), "no pixels");
    assert!(refused(&mut trainer, 0, &whole, CropPlace { x: 0, y: 0, ..place }), "more pixels than planned");
    assert_eq!(trainer.pictures.crops(), 0);
    (0..4).for_each(|_| trainer.add_crop(0, &image, None, place).unwrap());
    assert_eq!(trainer.add_crop(0, &image, None, place), Err(TrainError::TooManyCrops { planned: 4 }));
    assert_eq!(trainer.pictures.crops(), 4);
}

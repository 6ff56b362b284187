//! A scene of more Gaussians than the device holds: exact while a part of it is there, whole in the end.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../tests/counting_allocator.rs"]
mod counting_allocator;
mod scenes;

use config::plan::{Plan, PlanRequest};
use config::training::{Strategy, TrainSettings};
use std::ops::ControlFlow;

use counting_allocator::allocations;
use glam::DVec3;
use models::camera::{OrthographicView, View};
use models::cloud::GaussianCloud;
use scenes::device::{model, open, plain, posed};
use scenes::photo;
use scenes::places::{look, three_places};
use vulkan::fixture::Fixture;
use vulkan::trainer::{CropPlace, Rendering, RunBudget, TrainError};

/// A trainer of `on_device` Gaussians at once, of a scene of so many, for three views of 64 × 48.
fn trainer(on_device: usize, scene: Option<usize>, settings: &TrainSettings) -> Option<Fixture> {
    let gpu = open()?;
    let request = PlanRequest {
        device_mib: 64,
        width: 64,
        height: 48,
        views: 3,
        max_gaussians: Some(on_device),
        scene_gaussians: scene,
        ..Default::default()
    };
    let mut trainer = Fixture::new(&gpu, &Plan::new(&request).unwrap(), settings).unwrap();
    if trainer.plan().is_paged() {
        trainer.keep_scene_in(tempfile::tempfile().unwrap());
    }
    Some(trainer)
}

/// So many updates in a window before the next is chosen.
fn windows_of(updates: u32) -> TrainSettings {
    let mut settings = plain();
    settings.cells.updates = updates;
    settings.density.strategy = Strategy::None;
    // The scene is as wide as its places are apart; a step is not.
    (settings.rates.mean_start, settings.rates.mean_end) = (1e-6, 1e-6);
    settings
}

#[test]
fn what_a_window_trains_is_what_a_trainer_of_the_whole_scene_would_to_the_bit() {
    let settings = windows_of(40);
    let Some(mut paged) = trainer(400, Some(900), &settings) else { return };
    paged.load(&three_places()).unwrap();
    // Cells have an order of their own.
    let in_cells = model(&mut paged);
    assert_eq!(in_cells.len(), 900);
    let mut whole = trainer(900, None, &settings).unwrap();
    whole.load(&in_cells).unwrap();
    for t in [&mut paged, &mut whole] {
        let v = look(1);
        t.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
        let last = (0..30).map(|_| t.step().unwrap()).last().unwrap();
        assert!(last.visible > 100 && last.gaussians == 900, "{last:?}");
    }
    let (cells, on_device) = paged.cells();
    assert!(cells > on_device && on_device > 0, "{on_device} of {cells}");
    assert!(model(&mut paged) == model(&mut whole));
}

#[test]
fn every_place_comes_to_its_turn_and_the_same_seed_gives_the_same_bytes() {
    let after = |updates: u32, snapshots: bool| {
        let mut t = trainer(400, Some(900), &windows_of(updates))?;
        t.load(&three_places()).unwrap();
        for place in 0..3 {
            let v = look(place);
            t.add_view(&posed(&v, &photo(place as u64, &v)), None).unwrap();
        }
        let mut losses = [[f32::INFINITY; 2]; 3];
        for _ in 0..160 {
            let report = t.step().unwrap();
            let [first, last] = &mut losses[report.view];
            *first = if first.is_finite() { *first } else { report.loss };
            *last = report.loss;
            if snapshots && report.settled {
                model(&mut t);
            }
        }
        assert!(losses.iter().all(|[first, last]| *last < 0.9 * first), "{losses:?}");
        assert_eq!(t.gaussians(), 900);
        Some(model(&mut t))
    };
    for updates in [1, 7] {
        let Some(model) = after(updates, false) else { return };
        assert!(model == after(updates, false).unwrap());
        assert!(model == after(updates, true).unwrap(), "a snapshot changed what followed");
    }
}

#[test]
fn a_picture_of_a_scene_in_cells_is_that_of_the_whole_scene_to_the_bit() {
    let (mut here, mut there) = (Rendering::default(), Rendering::default());
    // The last is seen from afar, where each part of a picture sees other cells, and is drawn in many windows.
    for (seed, on_device, larger, afar) in [(3, 400, 1.5, 0.0), (5, 320, 0.5, 0.0), (7, 150, -2.5, 30.0)] {
        let mut scene = three_places();
        // Small and large ones, some wider than the whole scene.
        for (i, s) in scene.log_scales.iter_mut().enumerate() {
            *s = s.map(|s| s.min(-2.0) + [-1.0, -0.5, 0.0, larger][(i / seed) % 4]);
        }
        scene.means.iter_mut().for_each(|m| m[2] += afar);
        scene.log_scales[17] = [8.0, 8.0, -1.0];
        let Some(mut paged) = trainer(on_device, Some(900), &plain()) else { return };
        paged.load(&scene).unwrap();
        let mut whole = trainer(900, None, &plain()).unwrap();
        whole.load(&model(&mut paged)).unwrap();
        for place in [0, 2, 0] {
            let mut v = look(place);
            v.intrinsics.cx += 11.0;
            v.intrinsics.fx *= 1.0 + 0.2 * afar;
            v.intrinsics.fy *= 1.0 + 0.2 * afar;
            for t in [(&mut paged, &mut here), (&mut whole, &mut there)] {
                t.0.render(&v, t.1).unwrap();
            }
            assert!(here.transmittance.iter().any(|t| *t < 0.5), "nothing was drawn");
            assert!(here == there, "{on_device} on the device, place {place}");
            let down = OrthographicView { pose: v.pose, width: 50, height: 40, pixels_per_metre: [9.0, 10.0] };
            paged.render_orthographic(&down, &mut here).unwrap();
            whole.render_orthographic(&down, &mut there).unwrap();
            assert!(here == there, "{on_device} on the device, place {place}, parallel rays");
        }
    }
}

#[test]
fn drawing_between_two_steps_changes_nothing_of_what_follows() {
    let after = |updates: u32, draws: bool| {
        let mut t = trainer(400, Some(900), &windows_of(updates))?;
        t.load(&three_places()).unwrap();
        for place in [0, 1] {
            let v = look(place);
            t.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
        }
        // Drawing ends a window that is over, and with that settles the order of cells: the last step is in the midst of one.
        for _ in 0..70 {
            // Where the lazy Adam updates are done anyway.
            if t.step().unwrap().settled && draws {
                t.render(&look(2), &mut Rendering::default()).unwrap();
            }
        }
        Some(model(&mut t))
    };
    for updates in [1, 32] {
        let Some(undisturbed) = after(updates, false) else { return };
        assert!(undisturbed == after(updates, true).unwrap(), "windows of {updates}");
    }
}

#[test]
fn a_scene_that_outgrows_the_device_goes_into_cells_and_grows_on() {
    let mut settings = windows_of(8);
    settings.density.strategy = Strategy::Relocate;
    settings.steps = 200;
    let Some(mut t) = trainer(600, Some(1400), &settings) else { return };
    let mut scene = three_places();
    scene.retain(|i| i % 3 != 0);
    t.load(&scene).unwrap();
    assert_eq!(t.gaussians(), 600);
    for place in 0..3 {
        let v = look(place);
        t.add_view(&posed(&v, &photo(place as u64, &v)), None).unwrap();
    }
    let mut most = 0;
    while t.schedule().progress() < 1.0 {
        most = most.max(t.step().unwrap().gaussians);
    }
    assert!(t.cells().0 > 0 && most > 700 && most <= 1400, "{most} Gaussians, {:?}", t.cells());
    let model = model(&mut t);
    assert_eq!(model.len(), t.gaussians());
    assert!((0..model.len()).all(|i| model.is_valid(i)));
}

#[test]
fn windows_allocate_nothing() {
    for updates in [1, 5] {
        let Some(mut t) = trainer(400, Some(900), &windows_of(updates)) else { return };
        t.load(&three_places()).unwrap();
        for place in 0..3 {
            let v = look(place);
            t.add_view(&posed(&v, &photo(place as u64, &v)), None).unwrap();
        }
        (0..4).for_each(|_| _ = t.step().unwrap());
        let before = allocations();
        (0..40).for_each(|_| _ = t.step().unwrap());
        assert_eq!(allocations() - before, 0, "windows of {updates}");
    }
}

/// Three places of many small Gaussians, seen from afar: of each a device of 150 holds a part.
fn three_places_afar() -> GaussianCloud {
    let mut scene = three_places();
    scene.log_scales.iter_mut().for_each(|s| *s = s.map(|s| s.min(-2.0) - 2.5));
    scene.means.iter_mut().for_each(|m| m[2] += 30.0);
    scene
}

/// A camera at each place that sees it as a whole.
fn look_from_afar(place: usize) -> View {
    let mut v = look(place);
    v.intrinsics.fx *= 7.0;
    v.intrinsics.fy *= 7.0;
    v
}

#[test]
fn a_step_is_a_picture_looked_at_however_many_parts_it_takes() {
    let mut settings = windows_of(1);
    settings.steps = 12;
    let Some(mut t) = trainer(150, Some(900), &settings) else { return };
    t.load(&three_places_afar()).unwrap();
    for place in 0..3 {
        let v = look_from_afar(place);
        t.add_view(&posed(&v, &photo(place as u64, &v)), None).unwrap();
    }
    let mut steps = Vec::new();
    let summary = t.run(&RunBudget::default(), &mut |report| {
        steps.push(report.step);
        ControlFlow::Continue(())
    });
    let summary = summary.unwrap();
    assert!(steps.len() >= 18, "{} updates", steps.len());
    assert!(steps.is_sorted() && steps[0] == 1 && (12..=13).contains(steps.last().unwrap()), "{steps:?}");
    assert_eq!((summary.steps, t.steps(), t.schedule().spent().0, t.schedule().progress()), (12, 12, 12, 1.0));
    assert_eq!(summary.counters.windows as usize, steps.len());
}

#[test]
fn crops_of_a_scene_in_cells_are_trained_in_parts_too() {
    let mut settings = windows_of(1);
    (settings.crops.from, settings.crops.share) = (0.0, 0.5);
    let Some(gpu) = open() else { return };
    let request = PlanRequest {
        device_mib: 64,
        width: 64,
        height: 48,
        views: 1,
        crops: 2,
        max_gaussians: Some(150),
        scene_gaussians: Some(900),
        ..Default::default()
    };
    let mut t = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &settings).unwrap();
    t.keep_scene_in(tempfile::tempfile().unwrap());
    t.pictures.keep_in(tempfile::tempfile().unwrap());
    t.load(&three_places_afar()).unwrap();
    let v = look_from_afar(0);
    t.add_view(&posed(&v, &photo(0, &v)), None).unwrap();
    let large = View { intrinsics: v.intrinsics.resized(128, 96), ..v };
    let picture = posed(&large, &photo(0, &large)).image;
    for x in [0, 64] {
        let place = CropPlace { x, y: 24, whole: (128, 96) };
        t.add_crop(0, &image::imageops::crop_imm(&picture, x, 24, 64, 48).to_image(), None, place).unwrap();
    }
    let of_crops = (0..40).filter(|_| t.step().unwrap().crop.is_some()).count();
    assert!((16..=20).contains(&of_crops), "{of_crops} of 40");
    let cells = t.cells();
    assert!(cells.1 > 0 && cells.1 < cells.0, "{cells:?}");
}

#[test]
fn a_file_that_fails_is_an_error_and_never_a_smaller_model() {
    let Some(mut t) = trainer(400, Some(900), &windows_of(4)) else { return };
    t.load(&three_places()).unwrap();
    for place in 0..3 {
        let v = look(place);
        t.add_view(&posed(&v, &photo(place as u64, &v)), None).unwrap();
    }
    (0..3).for_each(|_| _ = t.step().unwrap());
    // A disk that takes everything and gives nothing back.
    t.keep_scene_in(std::fs::File::options().read(true).write(true).open("/dev/null").unwrap());
    let error = (0..20).find_map(|_| t.step().err()).expect("the next window is read from the file");
    assert!(matches!(error, TrainError::SceneFile(_)), "{error}");
    let error = t.snapshot(&mut GaussianCloud::default()).unwrap_err();
    assert!(error.to_string().contains("last checkpoint"), "{error}");
    assert!(matches!(t.step(), Err(TrainError::SceneFile(_))));
    t.keep_scene_in(tempfile::tempfile().unwrap());
    t.load(&three_places()).unwrap();
    assert!(t.step().is_ok());
}

#[test]
fn a_drawing_that_fails_counts_no_gaussian_twice() {
    let mut failed = 0;
    for eighths in 1..8 {
        let Some(mut t) = trainer(400, Some(900), &windows_of(4)) else { return };
        let file = tempfile::tempfile().unwrap();
        t.keep_scene_in(file.try_clone().unwrap());
        t.load(&three_places()).unwrap();
        let v = look(0);
        t.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
        (0..2).for_each(|_| _ = t.step().unwrap());
        // Some cells are there, others are not.
        file.set_len(file.metadata().unwrap().len() * eighths / 8).unwrap();
        for _ in 0..2 {
            failed += u32::from(t.render(&look(2), &mut Rendering::default()).is_err());
            assert_eq!(t.gaussians(), 900, "{eighths} eighths of the file");
        }
    }
    assert!(failed > 0);
}

#[test]
fn what_cannot_be_trained_is_said_in_one_line() {
    let Some(mut t) = trainer(4, Some(900), &plain()) else { return };
    let mut scene = three_places();
    scene.log_scales.iter_mut().for_each(|s| *s = [3.0; 3]);
    t.load(&scene).unwrap();
    let v = look(0);
    t.add_view(&posed(&v, &photo(1, &v)), None).unwrap();
    let error = t.step().unwrap_err();
    assert!(matches!(error, TrainError::TooCrowded { gaussians: 4, .. }), "{error}");
    assert!(error.to_string().contains("device_mib"), "{error}");

    let mut t = trainer(400, Some(900), &plain()).unwrap();
    t.load(&three_places()).unwrap();
    let mut away = look(0);
    away.pose.center += DVec3::new(0.0, -9e5, 0.0);
    t.add_view(&posed(&away, &photo(1, &away)), None).unwrap();
    assert_eq!(t.step().unwrap_err(), TrainError::NothingInView);

    let mut ranked = plain();
    ranked.sh.raise_share = 0.3;
    let plan = Plan::new(&PlanRequest { max_gaussians: Some(300), scene_gaussians: Some(900), ..Default::default() });
    let refused = Fixture::new(t.device().gpu(), &plan.unwrap(), &ranked).unwrap_err();
    assert!(refused.to_string().contains("sh.raise_share = 0.3"), "{refused}");
}

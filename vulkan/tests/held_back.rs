//! Views that are kept back tell what is learnt by heart.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../tests/counting_allocator.rs"]
mod counting_allocator;
mod scenes;

use std::collections::BTreeSet;

use config::plan::{Plan, PlanRequest};
use config::training::{Strategy, TrainSettings};
use counting_allocator::allocations;
use glam::DVec3;
use models::camera::View;
use scenes::device::{model, open, plain, posed};
use scenes::{cloud, photo, view};
use vulkan::fixture::Fixture;
use vulkan::trainer::{CropPlace, Rendering};

const VIEWS: usize = 10;
const STEPS: u32 = 600;
/// Those that are kept back of ten.
const KEPT: [usize; 2] = [2, 7];

fn settings() -> TrainSettings {
    let mut settings = plain();
    settings.density.strategy = Strategy::None;
    settings.steps = STEPS;
    settings
}

fn trainer(settings: &TrainSettings) -> Option<Fixture> {
    let gpu = open()?;
    let request = PlanRequest {
        device_mib: 64,
        width: 64,
        height: 48,
        views: VIEWS as u32,
        crops: 1,
        max_gaussians: Some(400),
        ..Default::default()
    };
    Some(Fixture::new(&gpu, &Plan::new(&request).unwrap(), settings).unwrap())
}

/// A camera so many metres to the east.
fn look(east_m: f64) -> View {
    let mut v = view(64, 48);
    v.pose.center += DVec3::X * east_m;
    v
}

/// Ten pictures of one thing, seen from nearly the same place: what is learnt of some holds for all.
fn of_one_thing(settings: &TrainSettings) -> Option<Fixture> {
    let mut t = trainer(settings)?;
    let (thing, mut drawn) = (cloud(3, 200, 1), Rendering::default());
    t.load(&thing).unwrap();
    for k in 0..VIEWS {
        let v = look(0.01 * k as f64);
        t.render(&v, &mut drawn).unwrap();
        let mut picture = posed(&v, &photo(0, &v));
        for (pixel, rgb) in picture.image.pixels_mut().zip(drawn.rgb.chunks_exact(3)) {
            pixel.0 = std::array::from_fn(|c| (255.0 * rgb[c].clamp(0.0, 1.0)).round() as u8);
        }
        t.add_view(&picture, None).unwrap();
    }
    let mut first = thing.clone();
    first.sh.iter_mut().for_each(|c| *c *= 0.3);
    t.load(&first).unwrap();
    Some(t)
}

/// Ten pictures that have nothing in common, from all around: they can only be learnt by heart.
fn of_nothing(settings: &TrainSettings) -> Option<Fixture> {
    let mut t = trainer(settings)?;
    for k in 0..VIEWS {
        let v = look(0.6 * k as f64 - 2.7);
        t.add_view(&posed(&v, &photo(k as u64, &v)), None).unwrap();
    }
    t.load(&cloud(3, 300, 3)).unwrap();
    Some(t)
}

/// Views visited while the schedule goes from one progress to the other.
fn looked_at(t: &mut Fixture, until: f32) -> BTreeSet<usize> {
    let mut seen = BTreeSet::new();
    while t.schedule().progress() < until {
        seen.insert(t.step().unwrap().view);
    }
    seen
}

#[test]
fn what_holds_for_views_kept_back_is_learnt_on_and_what_does_not_is_left_out_more_and_more() {
    let Some(mut t) = of_one_thing(&settings()) else { return };
    looked_at(&mut t, 0.4);
    let found = t.validated().unwrap();
    assert!(found.views == 2 && found.holds > 0.6 && found.drop == 0.0, "{found:?}");
    let mut t = of_nothing(&settings()).unwrap();
    let before = looked_at(&mut t, 0.101);
    let between = looked_at(&mut t, 0.349);
    assert_eq!(t.validated(), None);
    let after = looked_at(&mut t, 0.5);
    assert_eq!(before.len(), VIEWS);
    assert!(between.len() == VIEWS - 2 && KEPT.iter().all(|view| !between.contains(view)), "{between:?}");
    assert_eq!(after.len(), VIEWS, "they are back");
    let found = t.validated().unwrap();
    assert!(found.holds < 0.0 && found.drop > 0.0, "{found:?}");
}

#[test]
fn views_kept_back_and_what_is_left_out_follow_the_steps_and_allocate_nothing() {
    let run = || {
        let mut t = of_nothing(&settings())?;
        (0..4).for_each(|_| _ = t.step().unwrap());
        let before = allocations();
        while t.schedule().progress() < 0.4 {
            t.step().unwrap();
        }
        assert_eq!(allocations() - before, 0);
        assert!(t.validated().unwrap().drop > 0.0);
        Some(model(&mut t))
    };
    let Some(first) = run() else { return };
    assert!(run().unwrap() == first, "the same seed, the same bytes");
    let mut without = settings();
    without.validation.share = 0.0;
    let mut t = of_nothing(&without).unwrap();
    looked_at(&mut t, 0.4);
    assert!(t.validated().is_none() && model(&mut t) != first);
}

#[test]
fn what_was_found_is_gone_with_a_load_and_goes_on_where_the_schedule_does() {
    let Some(mut t) = of_nothing(&settings()) else { return };
    looked_at(&mut t, 0.4);
    let (found, there, spent) = (t.validated(), model(&mut t), t.schedule().spent());
    assert!(found.is_some_and(|found| found.drop > 0.0));
    let mut after = |continued: bool| {
        t.load(&there).unwrap();
        assert_eq!(t.validated(), None);
        t.schedule_mut().continue_from(spent.0, spent.1);
        if continued {
            t.continue_validated(found);
        }
        (0..5).for_each(|_| _ = t.step().unwrap());
        (t.validated(), model(&mut t))
    };
    let (with, without) = (after(true), after(false));
    assert_eq!((with.0, without.0), (found, None));
    assert!(with.1 != without.1, "Gaussians are left out of each step again");
}

#[test]
fn short_schedules_and_those_who_say_what_is_left_out_keep_nothing_back() {
    let trained = |change: &dyn Fn(&mut TrainSettings)| {
        let mut settings = settings();
        change(&mut settings);
        let mut t = of_nothing(&settings)?;
        assert_eq!(looked_at(&mut t, 0.4).len(), VIEWS);
        assert_eq!(t.validated(), None);
        Some(model(&mut t))
    };
    let Some(short) = trained(&|s| s.steps = 490) else { return };
    assert!(short == trained(&|s| (s.steps, s.validation.share) = (490, 0.0)).unwrap(), "to the bit as without");
    trained(&|s| s.regularise.drop = 0.1);
    trained(&|s| s.validation.drop = 0.0);
}

#[test]
fn whoever_looks_at_crops_meanwhile_keeps_nothing_back_as_they_are_no_whole_pictures() {
    for (from, kept) in [(0.2, false), (0.4, true)] {
        let mut settings = settings();
        settings.crops.from = from;
        let Some(mut t) = of_nothing(&settings) else { return };
        t.pictures.keep_in(tempfile::tempfile().unwrap());
        let v = look(-2.7);
        let large = View { intrinsics: v.intrinsics.resized(128, 96), ..v };
        let part = image::imageops::crop_imm(&posed(&large, &photo(0, &large)).image, 32, 24, 64, 48).to_image();
        t.add_crop(0, &part, None, CropPlace { x: 32, y: 24, whole: (128, 96) }).unwrap();
        looked_at(&mut t, 0.37);
        assert_eq!(t.validated().is_some(), kept, "crops from {from}");
    }
}

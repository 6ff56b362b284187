//! A scene in cells grows while it is trained: what comes, moves and goes is the same as where the device holds everything.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::plan::{Plan, PlanRequest};
use config::training::Strategy;
use models::cloud::GaussianCloud;
use scenes::device::{model, open, plain, posed};
use scenes::photo;
use scenes::places::{APART, at, look, three_places};
use vulkan::fixture::Fixture;
use vulkan::trainer::{BoundingBox, Fate, TrainError, Trained};

/// A trainer that has room for 400 Gaussians, or all, of a scene of 1,300.
fn trainer(paged: bool) -> Option<Fixture> {
    let gpu = open()?;
    let request = PlanRequest {
        device_mib: 64,
        width: 64,
        height: 48,
        views: 3,
        max_gaussians: Some(if paged { 400 } else { 1300 }),
        scene_gaussians: paged.then_some(1300),
        ..Default::default()
    };
    let mut settings = plain();
    settings.density.strategy = Strategy::None;
    let mut trainer = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &settings).unwrap();
    if paged {
        trainer.keep_scene_in(tempfile::tempfile().unwrap());
    }
    Some(trainer)
}

fn add_view(t: &mut Fixture, place: usize) {
    let v = look(place);
    t.add_view(&posed(&v, &photo(place as u64, &v)), None).unwrap();
}

/// Means and rotations in an order of their own: cells have another one.
fn sorted(cloud: &GaussianCloud) -> Vec<[u32; 7]> {
    let row = |(m, r): (&[f32; 3], &[f32; 4])| [m[0], m[1], m[2], r[0], r[1], r[2], r[3]].map(f32::to_bits);
    let mut rows: Vec<[u32; 7]> = cloud.means.iter().zip(&cloud.rotations).map(row).collect();
    rows.sort_unstable();
    rows
}

/// Around a place.
fn around(place: usize) -> BoundingBox {
    let x = place as f32 * APART;
    BoundingBox {
        low: [x - 100.0, f32::NEG_INFINITY, f32::NEG_INFINITY],
        high: [x + 100.0, f32::INFINITY, f32::INFINITY],
    }
}

#[test]
fn what_comes_moves_and_goes_in_cells_is_what_does_where_the_device_holds_everything() {
    let amended = |paged: bool| {
        let mut t = trainer(paged)?;
        t.load(&three_places()).unwrap();
        let fate = |g: &Trained| match g.opacity_logit {
            o if o < 0.0 => Fate::Goes,
            o if o < 0.7 => {
                Fate::Moves { mean: [g.mean[0] + 40.0, g.mean[1] - 3.0, g.mean[2]], rotation: [0.0, 1.0, 0.0, 0.0] }
            }
            _ => Fate::Stays,
        };
        let gone = t.revise(&around(1), fate).unwrap();
        let mut more = at(2);
        more.means.iter_mut().for_each(|m| m[0] += 13.0);
        more.means[7][1] = f32::NAN;
        // Ground of which nothing stood anywhere yet.
        let mut beyond = at(3);
        beyond.retain(|i| i < 200);
        more.extend(&beyond);
        let report = t.extend(&more).unwrap();
        assert_eq!((report.loaded, report.dropped_non_finite, report.dropped_over_capacity), (499, 1, 0));
        let (mut seen, mut all) = (Vec::new(), 0);
        t.each(&around(2), |g| seen.push(g.mean.map(f32::to_bits))).unwrap();
        t.each(&BoundingBox::ALL, |_| all += 1).unwrap();
        seen.sort_unstable();
        Some((gone, seen, all, t.gaussians(), sorted(&model(&mut t))))
    };
    let Some(whole) = amended(false) else { return };
    let (gone, seen, all, gaussians, _) = &whole;
    assert!(
        *gone > 50 && seen.len() == 599 && all == gaussians && *gaussians == 900 - gone + 499,
        "{gone} {all} {gaussians}"
    );
    assert!(amended(true).unwrap() == whole);
}

#[test]
fn a_scene_that_outgrows_the_device_as_new_ground_comes_goes_into_cells_and_learns_it() {
    let grown = || {
        let mut t = trainer(true)?;
        t.load(&at(0)).unwrap();
        t.while_views_come();
        add_view(&mut t, 0);
        (0..12).for_each(|_| _ = t.step().unwrap());
        assert_eq!(t.cells(), (0, 0), "so far all of it is on the device");
        for place in [1, 2] {
            let before = model(&mut t);
            assert_eq!(t.extend(&at(place)).unwrap().loaded, 300);
            add_view(&mut t, place);
            assert_eq!(t.gaussians(), 300 * (1 + place));
            // Nobody else was touched.
            let now = sorted(&model(&mut t));
            assert!(sorted(&before).iter().all(|row| now.binary_search(row).is_ok()));
            let losses: Vec<(usize, f32)> = (0..24).map(|_| t.step().map(|r| (r.view, r.loss)).unwrap()).collect();
            let of_it: Vec<f32> = losses.iter().filter(|(view, _)| *view == place).map(|(_, loss)| *loss).collect();
            assert!(of_it.last() < of_it.first(), "{of_it:?}");
        }
        let (cells, on_device) = t.cells();
        assert!(on_device > 0 && cells > on_device, "{on_device} of {cells}");
        Some(model(&mut t))
    };
    let Some(model) = grown() else { return };
    assert!(grown().unwrap() == model, "the same steps, the same bytes");
}

#[test]
fn a_scene_in_cells_takes_no_more_than_it_has_room_for_and_never_loses_its_last_gaussian() {
    let Some(mut t) = trainer(true) else { return };
    t.load(&three_places()).unwrap();
    let more = (0..2).fold(GaussianCloud::with_capacity(3, 0), |mut all, place| {
        all.extend(&at(4 + place));
        all
    });
    let report = t.extend(&more).unwrap();
    assert_eq!((report.loaded, report.dropped_over_capacity, t.gaussians()), (400, 200, 1300));
    assert_eq!(t.revise(&BoundingBox::ALL, |_| Fate::Goes).unwrap(), 1299);
    assert_eq!((t.gaussians(), model(&mut t).len()), (1, 1));
}

#[test]
fn a_file_that_fails_while_gaussians_move_is_an_error_and_never_a_smaller_model() {
    let Some(mut t) = trainer(true) else { return };
    t.load(&three_places()).unwrap();
    add_view(&mut t, 0);
    (0..3).for_each(|_| _ = t.step().unwrap());
    t.keep_scene_in(std::fs::File::options().read(true).write(true).open("/dev/null").unwrap());
    let error = t.revise(&BoundingBox::ALL, |_| Fate::Goes).unwrap_err();
    assert!(matches!(error, TrainError::SceneFile(_)), "{error}");
    for error in
        [t.extend(&at(1)).map(drop), t.each(&BoundingBox::ALL, |_| {}), t.snapshot(&mut GaussianCloud::default())]
    {
        let error = error.unwrap_err();
        assert!(error.to_string().contains("last checkpoint"), "{error}");
    }
    t.keep_scene_in(tempfile::tempfile().unwrap());
    t.load(&three_places()).unwrap();
    assert!(t.extend(&at(3)).is_ok() && t.step().is_ok());
}

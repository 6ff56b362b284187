//! Promises of the whole aggregation, distillation included (skipped, with a word, where there is no Vulkan device).

use config::error::{Error, ErrorKind};
use geometry::geodesy::Geodetic;
use models::cloud::GaussianCloud;
use models::formats::model;

use super::*;
use crate::jobs::summary;
use crate::testing::{carpet, model, nadir, written};
use crate::{LocalModel, frame};

mod jobs;

const WEST: [[f64; 2]; 4] = [[-40.0, -20.0], [0.0, -20.0], [0.0, 20.0], [-40.0, 20.0]];
const EAST: [[f64; 2]; 4] = [[0.0, -20.0], [40.0, -20.0], [40.0, 20.0], [0.0, 20.0]];

/// Two aircraft that saw the same carpet in different light and laid their Gaussians not quite on the same grid.
fn pair() -> Vec<LocalModel> {
    let mut west = model("west", &WEST, carpet([-40.0, -20.0], [15.0, 20.0], 1.0));
    let mut east = model("east", &EAST, carpet([-14.6, -20.0], [40.4, 20.0], 1.0));
    east.cloud.sh.iter_mut().for_each(|v| *v += 0.6);
    for (m, xs) in [(&mut west, [-30.0, -3.0, -1.0]), (&mut east, [1.0, 4.0, 30.0])] {
        for (i, x) in xs.into_iter().enumerate() {
            m.header.views.push((format!("{}{i}.jpg", m.header.aircraft), nadir(x, 0.0, 16.0)));
        }
    }
    vec![west, east]
}

/// Aggregates models that arrived as files.
fn run(
    models: Vec<LocalModel>,
    settings: &GroundSettings,
    origin: Option<Geodetic>,
    out: &Path,
    cancelled: &dyn Fn() -> bool,
) -> Result<Outcome, AggregateError> {
    let dir = tempfile::tempdir().expect("temp dir");
    let members = models.iter().map(|m| written(dir.path(), m)).collect();
    super::run(members, settings, origin, out, cancelled)
}

fn settings() -> GroundSettings {
    GroundSettings {
        device_mib: 64,
        scale: 1.0,
        seam_m: 2.0,
        epochs: 30,
        rate: 2.0,
        between_views: false,
        // Where models go is registration's to say; here they stay.
        register: false,
        ..Default::default()
    }
}

fn skipped(outcome: &Outcome) -> bool {
    let skip = outcome.not_distilled.as_ref().is_some_and(|e| e.kind() == ErrorKind::Device);
    if skip {
        needs::missing(needs::Need::Vulkan, "no Vulkan device to distil on");
    }
    skip
}

#[test]
fn distillation_brings_the_seam_closer_to_both_teachers_and_leaves_the_rest_alone() {
    let dir = tempfile::tempdir().expect("temp dir");
    let outcome = run(pair(), &settings(), None, dir.path(), &|| false).expect("aggregate");
    if skipped(&outcome) {
        return;
    }
    let d = outcome.distilled.as_ref().expect("distilled");
    let l = &d.learnt;
    // Of the two views of each aircraft that see the border one is learnt and one is asked.
    assert_eq!((l.views, l.used, l.kept_back, l.steps), (6, 4, 2, 60));
    assert!(l.accepted > 0 && l.accepted <= l.cells, "{} of {} cells", l.accepted, l.cells);
    let gain = d.agreement.iter().flatten().map(|a| a[1] - a[0]).sum::<f64>();
    assert!(gain > 0.5, "{:?}", d.agreement);
    let (header, cloud) = model::read(&outcome.path).expect("global model");
    assert_eq!((cloud.len(), header.finished, header.views.len()), (outcome.gaussians, true, 6));
    // Beyond six cells of 2 m on both sides of the border everything was drawn and nothing moved.
    let merge_only = GroundSettings { epochs: 0, ..settings() };
    let merged = run(pair(), &merge_only, None, &dir.path().join("merged"), &|| false).expect("aggregate");
    let beside = |c: &GaussianCloud| {
        let rows: Vec<u32> = (0..c.len() as u32).filter(|i| c.means[*i as usize][0].abs() > 14.0).collect();
        c.rows(&rows)
    };
    let untouched = model::read(&merged.path).expect("merged model").1;
    assert_eq!(beside(&cloud), beside(&untouched));
    assert!(cloud != untouched);
    let page = summary::report(&outcome).to_html().expect("page");
    assert!(page.contains("seam seen by east") && page.contains("views that see no seam"));
    assert_eq!(summary::run_report("aggregate", &outcome, 0).skipped["views_without_seam"], 2);
}

#[test]
fn views_between_training_views_take_part_when_asked() {
    let dir = tempfile::tempdir().expect("temp dir");
    let both = GroundSettings { between_views: true, epochs: 1, ..settings() };
    let outcome = run(pair(), &both, None, dir.path(), &|| false).expect("aggregate");
    if skipped(&outcome) {
        return;
    }
    // Each side: -30 and -3 meet half-way at -16.5 and -3 and -1 at -2; at -30 alone there is no seam.
    let l = &outcome.distilled.as_ref().expect("distilled").learnt;
    assert_eq!((l.views, l.used, l.kept_back, l.steps), (10, 8, 2, 6));
}

#[test]
fn the_same_models_give_the_same_bytes() {
    let dir = tempfile::tempdir().expect("temp dir");
    let bytes = ["a", "b"].map(|name| {
        let out = dir.path().join(name);
        let outcome = run(pair(), &settings(), None, &out, &|| false).expect("aggregate");
        let (_, cloud) = model::read(&outcome.path).expect("global model");
        cloud
    });
    assert!(bytes[0] == bytes[1]);
}

#[test]
fn a_missing_device_still_leaves_the_merged_model() {
    let dir = tempfile::tempdir().expect("temp dir");
    let none = GroundSettings { device: Some("no such device".into()), ..settings() };
    let outcome = run(pair(), &none, None, dir.path(), &|| false).expect("merged");
    assert!(outcome.not_distilled.as_ref().is_some_and(|e| e.kind() == ErrorKind::Device));
    let (header, cloud) = model::read(&outcome.path).expect("global model");
    assert!(!header.finished && cloud.len() == outcome.gaussians && cloud.len() > 3000);
    assert!(!summary::report(&outcome).warnings.is_empty());
}

#[test]
fn a_single_model_becomes_the_global_one_unchanged() {
    let dir = tempfile::tempdir().expect("temp dir");
    let one = vec![pair().remove(0)];
    let cloud = one[0].cloud.clone();
    let outcome = run(one, &settings(), None, dir.path(), &|| false).expect("aggregate");
    assert_eq!(outcome.distilled.as_ref().map(|d| d.learnt.used), Some(0));
    assert_eq!(model::read(&outcome.path).expect("global model").1, cloud);
}

#[test]
fn models_around_different_origins_meet_in_one_frame() {
    let dir = tempfile::tempdir().expect("temp dir");
    let home = Geodetic { lat_deg: 47.0, lon_deg: 8.0, alt_m: 400.0 };
    let away = geometry::geodesy::EnuFrame::new(home).to_geodetic(glam::DVec3::new(500.0, 300.0, 5.0));
    let mut models = pair();
    models[0].header.origin = Some(home);
    models[1].header.origin = Some(home);
    let away_from_home = frame::Motion::between(home, away);
    away_from_home.cloud(&mut models[1].cloud);
    away_from_home.header(&mut models[1].header);
    models[1].header.origin = Some(away);
    let merge_only = GroundSettings { epochs: 0, ..settings() };
    let outcome = run(models, &merge_only, None, &dir.path().join("a"), &|| false).expect("aggregate");
    let straight = run(pair(), &merge_only, None, &dir.path().join("b"), &|| false).expect("aggregate");
    assert_eq!(outcome.kept, straight.kept);
    let read = |o: &Outcome| model::read(&o.path).expect("global model").1.means;
    let apart = read(&outcome).into_iter().zip(read(&straight)).map(|(a, b)| glam::Vec3::from(a).distance(b.into()));
    assert!(apart.fold(0.0, f32::max) < 1e-4);
    assert_eq!(outcome.header.origin, Some(home));
}

#[test]
fn models_that_do_not_belong_together_are_refused_by_name() {
    let dir = tempfile::tempdir().expect("temp dir");
    let refused = |models| run(models, &settings(), None, dir.path(), &|| false).expect_err("refused").to_string();
    assert!(refused(vec![]).contains("no models"));
    let mut models = pair();
    models[0].header.origin = Some(Geodetic { lat_deg: 47.0, lon_deg: 8.0, alt_m: 0.0 });
    assert!(refused(models.clone()).contains("east"));
    models[1].header.origin = Some(Geodetic { lat_deg: 48.0, lon_deg: 8.0, alt_m: 0.0 });
    assert!(refused(models).contains("111."));
    assert!(!dir.path().join("global.dgtr").exists());
}

//! Small clouds, models and cameras for tests.

use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::model::ModelHeader;

use config::ground::GroundSettings;

use super::LocalModel;
use super::block::Block;
use super::member::Member;
use super::merge::{Merged, merge};
use super::plan::Plan;
use super::planning::{lay_out, plan, publish};
use super::store::Store;

/// A grid of flat round Gaussians on z = 0, coloured by place.
pub fn carpet(low: [f64; 2], high: [f64; 2], spacing: f64) -> GaussianCloud {
    let count = |k: usize| ((high[k] - low[k]) / spacing).round() as usize;
    let mut cloud = GaussianCloud::with_capacity(0, count(0) * count(1));
    let s = (0.5 * spacing as f32).ln();
    for v in 0..count(1) {
        for u in 0..count(0) {
            let at = |k: usize, i: usize| (low[k] + (i as f64 + 0.5) * spacing) as f32;
            let (x, y) = (at(0, u), at(1, v));
            let sh = [(0.5 * x).sin(), (0.4 * y).cos(), (0.2 * (x + y)).sin()];
            cloud.push([x, y, 0.0], [s, s, s - 3.0], [1.0, 0.0, 0.0, 0.0], 3.0, &sh);
        }
    }
    cloud
}

/// A model with a region and no views.
pub fn model(name: &str, region: &[[f64; 2]], cloud: GaussianCloud) -> LocalModel {
    let header = ModelHeader { aircraft: name.into(), region: region.to_vec(), ..Default::default() };
    LocalModel { path: PathBuf::from(name), header, cloud, content: [0; 32] }
}

/// A model as it arrives: in a file of `dir`.
pub fn written(dir: &Path, local: &LocalModel) -> Member {
    let path = dir.join(&local.path).with_extension("dgtr");
    models::formats::model::write(&path, &local.header, &local.cloud).expect("write");
    Member::of(LocalModel::read(&path).expect("read"))
}

/// The plan of a merge in `store`, which has the models.
pub fn planned(members: &mut [Member], settings: &GroundSettings, store: &Store) -> Plan {
    let fits = store.path().expect("a folder").join("fits");
    let plan = plan(members, settings, None, store, fits, &|| true).expect("a plan").plan;
    lay_out(members, &plan, store, &|_| true).expect("laid out");
    publish(&plan, store).expect("published");
    plan
}

/// Models merged without more ado.
pub fn united(models: &[LocalModel], budget: usize) -> Merged {
    let dir = tempfile::tempdir().expect("temp dir");
    let mut members: Vec<Member> = models.iter().map(|m| written(dir.path(), m)).collect();
    merged(&mut members, budget)
}

/// The same, in one square.
pub fn merged(members: &mut [Member], budget: usize) -> Merged {
    let dir = tempfile::tempdir().expect("temp dir");
    let store = Store::folder(dir.path());
    let settings = GroundSettings {
        cell_m: 2048.0,
        max_gaussians: Some(budget),
        register: false,
        epochs: 0,
        border_m: 0.0,
        ..Default::default()
    };
    let plan = planned(members, &settings, &store);
    match plan.cells.as_slice() {
        [] => Merged::default(),
        [cell] => merge(&Block::new(&plan.inputs(cell), &store)).expect("merged"),
        more => panic!("{} squares", more.len()),
    }
}

/// A 64 × 48 camera looking straight down.
pub fn nadir(x: f64, y: f64, height: f64) -> View {
    View {
        intrinsics: Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 },
        pose: Pose { rotation: DQuat::from_rotation_x(std::f64::consts::PI), center: DVec3::new(x, y, height) },
    }
}

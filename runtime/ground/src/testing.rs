//! Small models for tests, and merges of them.

use std::path::{Path, PathBuf};

use models::cloud::GaussianCloud;
use models::formats::model::ModelHeader;

use config::ground::GroundSettings;

use super::LocalModel;
use super::block::Block;
use super::jobs::planning::{lay_out, plan, publish};
use super::member::Member;
use super::merge::{Merged, merge};
use super::plan::Plan;
use super::store::Store;
pub use crate::carpet::{carpet, nadir};

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
    let plan = plan(members, settings, None, store, fits, &|| false).expect("a plan").plan;
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

/// Merges models that lie in one square.
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

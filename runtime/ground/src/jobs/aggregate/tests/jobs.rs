//! Promises of cells as jobs: whoever does them, in whatever order, however often killed, the bytes are the same; who joins late costs
//! the cells around.

use std::collections::BTreeSet;

use models::ground_cell::CellKey;

use super::*;
use crate::{plan, testing};

/// A row of aircraft along the east, 40 m apart, each of which saw 60 × 40 m; the second one missed a yard.
fn row(n: usize) -> Vec<LocalModel> {
    let aircraft = |i: usize| {
        let x = 40.0 * i as f64;
        let mut cloud = carpet([x - 10.0, -20.0], [x + 50.0, 20.0], 1.0);
        let means = cloud.means.clone();
        let in_yard = |m: &[f32; 3]| i == 1 && (44.0..52.0).contains(&m[0]) && (-8.0..8.0).contains(&m[1]);
        cloud.retain(|row| !in_yard(&means[row]));
        cloud.sh.iter_mut().for_each(|v| *v += 0.1 * i as f32);
        let mut model = model(&format!("a{i}"), &[[x, -20.0], [x + 40.0, -20.0], [x + 40.0, 20.0], [x, 20.0]], cloud);
        let views = [-3.0, 3.0, 20.0, 37.0, 43.0].map(|dx| (format!("a{i}{dx}.jpg"), nadir(x + dx, 0.0, 16.0)));
        model.header.views.extend(views);
        model
    };
    (0..n).map(aircraft).collect()
}

fn in_cells() -> GroundSettings {
    GroundSettings { cell_m: 24.0, epochs: 2, ..settings() }
}

/// Plans into `store` and gives the plan.
fn planned(dir: &Path, models: &[LocalModel], settings: &GroundSettings, store: &Store) -> plan::Plan {
    let mut members: Vec<Member> = models.iter().map(|m| written(dir, m)).collect();
    testing::planned(&mut members, settings, store)
}

/// Makes a cell as a worker does, if it is not there; whether it was made.
fn work(store: &Store, plan: &plan::Plan, i: usize) -> bool {
    let there = join::sound(store, plan, &plan.cells[i].input).expect("asked");
    there.is_none() && make::make(&plan.inputs(&plan.cells[i]), store, None, &|| false).expect("made").is_some()
}

/// Joins and gives the file's bytes.
fn joined(store: &Store, plan: &plan::Plan, out: &Path) -> Result<Vec<u8>, AggregateError> {
    let inputs: Vec<Hash> = plan.cells.iter().map(|c| c.input).collect();
    let mut header = join::header_in(store, plan)?;
    header.finished = true;
    let path = out.join("joined.dgtr");
    let joined = join::join(store, plan, &inputs, header, &path)?;
    let (_, _, content) = model::read_with_hash(&path)?;
    assert_eq!(content, joined.content);
    Ok(std::fs::read(&path).expect("read"))
}

fn has_device() -> bool {
    let found = vulkan::gpu::Gpu::list().is_ok();
    if !found {
        needs::missing(needs::Need::Vulkan, "no Vulkan device to distil on");
    }
    found
}

#[test]
fn one_process_any_order_two_workers_and_a_killed_one_give_the_same_bytes() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().expect("temp dir");
    let (models, settings) = (row(3), in_cells());
    let outcome = run(models.clone(), &settings, None, &dir.path().join("one"), &|| false).expect("aggregate");
    let one = std::fs::read(&outcome.path).expect("read");
    let distilled = outcome.distilled.expect("distilled").learnt;
    assert!(outcome.cells[0] == outcome.cells[1] && outcome.cells[1] > 9, "{:?}", outcome.cells);
    assert!(distilled.steps > 0 && distilled.accepted > 0, "{distilled:?}");
    assert!(outcome.kept[0].fill > 0, "the yard is filled: {:?}", outcome.kept);

    let shuffled = Store::folder(&dir.path().join("shuffled"));
    let plan = planned(dir.path(), &models, &settings, &shuffled);
    let n = plan.cells.len();
    let step = [7, 11, 13].into_iter().find(|s| !n.is_multiple_of(*s)).expect("a step");
    let order: Vec<usize> = (0..n).map(|i| (n - 1 - i) * step % n).collect();
    assert_eq!(order.iter().collect::<BTreeSet<_>>().len(), n);
    order.into_iter().for_each(|i| assert!(work(&shuffled, &plan, i)));
    assert!(joined(&shuffled, &plan, dir.path()).expect("joined") == one);

    // Two workers who each do everything, at once; a third was killed before, in the midst of writing.
    let path = dir.path().join("two");
    let plan = planned(dir.path(), &models, &settings, &Store::folder(&path));
    let first = Store::folder(&path);
    (0..n / 2).for_each(|i| assert!(work(&first, &plan, i)));
    let last = path.join(plan.cells[n / 2 - 1].name());
    let whole = std::fs::read(&last).expect("read");
    std::fs::write(&last, &whole[..whole.len() / 2]).expect("cut");
    assert!(joined(&first, &plan, dir.path()).is_err_and(|e| e.to_string().contains("cells are missing")));
    std::thread::scope(|scope| {
        for k in 0..2 {
            let (path, plan) = (&path, &plan);
            scope.spawn(move || {
                let store = Store::folder(path);
                let order = |i: usize| if k == 0 { i } else { n - 1 - i };
                let made = (0..n).filter(|i| work(&store, plan, order(*i))).count();
                assert!(made <= n - n / 2 + 1, "what was there is left alone");
            });
        }
    });
    assert!(joined(&first, &plan, dir.path()).expect("joined") == one);
}

/// Keys of the cells that are made when these models are merged in this folder.
fn made(dir: &Path, models: &[LocalModel], settings: &GroundSettings) -> (BTreeSet<CellKey>, Outcome) {
    let store = dir.join("out").join(GROUND);
    let before: BTreeSet<_> = cells_in(&store);
    let outcome = run(models.to_vec(), settings, None, &dir.join("out"), &|| false).expect("aggregate");
    let plan = plan::Plan::of(&Store::folder(&store)).expect("a plan");
    let new = plan.cells.iter().filter(|c| !before.contains(&store.join(c.name())));
    let new: BTreeSet<CellKey> = new.map(|c| c.key).collect();
    assert_eq!(outcome.cells, [new.len(), plan.cells.len()]);
    assert_eq!(cells_in(&store).len(), plan.cells.len(), "what is of no use any more is gone");
    (new, outcome)
}

fn cells_in(store: &Path) -> BTreeSet<std::path::PathBuf> {
    let entries = std::fs::read_dir(store.join(plan::CELLS)).into_iter().flatten();
    entries.flatten().map(|e| e.path()).collect()
}

#[test]
fn who_joins_late_or_comes_again_costs_the_cells_around_and_no_others() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = GroundSettings { cell_m: 24.0, epochs: 0, ..settings() };
    let all = row(6);
    let (first, _) = made(dir.path(), &all[..5], &settings);
    assert_eq!(made(dir.path(), &all[..5], &settings).0.len(), 0, "nothing has changed");
    let (late, outcome) = made(dir.path(), &all, &settings);
    // The sixth shows the ground from 190 m on, in the square around 192 m and those beyond; one more to the west sees it, and north and
    // south of all regions, where the sixth is hardly farther than the fifth, another.
    let of = |x: f64| (x / 24.0 + 0.5).floor() as i32;
    assert!(late.iter().all(|key| key.x >= of(190.0) - 2), "{late:?}");
    assert!(late.len() < first.len() / 2 && !late.is_empty(), "{} of {}", late.len(), first.len());
    // As if all had been there from the start.
    let fresh = tempfile::tempdir().expect("temp dir");
    let (_, at_once) = made(fresh.path(), &all, &settings);
    assert!(std::fs::read(&outcome.path).expect("read") == std::fs::read(&at_once.path).expect("read"));
    // A new version of the first, which looks the same but for one Gaussian in the far west.
    let mut again = all.clone();
    again[0].cloud.opacity_logits[0] = 1.0;
    let (new, _) = made(dir.path(), &again, &settings);
    assert!(new.iter().all(|key| key.x <= of(-10.0) + 1) && !new.is_empty(), "{new:?}");
}

#[test]
fn a_cell_that_was_spoilt_is_made_again() {
    let dir = tempfile::tempdir().expect("temp dir");
    let settings = GroundSettings { cell_m: 24.0, epochs: 0, ..settings() };
    let models = row(2);
    let (_, outcome) = made(dir.path(), &models, &settings);
    let whole = std::fs::read(&outcome.path).expect("read");
    let spoilt: Vec<_> = cells_in(&dir.path().join("out").join(GROUND)).into_iter().take(2).collect();
    // One in its head, one in a column.
    for (path, at_end) in spoilt.iter().zip([false, true]) {
        let mut bytes = std::fs::read(path).expect("read");
        let at = if at_end { bytes.len() - 1 } else { 70 };
        bytes[at] ^= 1;
        std::fs::write(path, bytes).expect("write");
    }
    let outcome = run(models.clone(), &settings, None, &dir.path().join("out"), &|| false).expect("aggregate");
    assert!(std::fs::read(&outcome.path).expect("read") == whole);
}

#[test]
fn a_small_scene_is_one_cell_and_a_bound_holds_in_many() {
    let dir = tempfile::tempdir().expect("temp dir");
    let models = row(3);
    let merge_only = GroundSettings { cell_m: 300.0, epochs: 0, ..settings() };
    let one = run(models.clone(), &merge_only, None, &dir.path().join("one"), &|| false).expect("aggregate");
    assert_eq!(one.cells, [1, 1]);
    let bounded = GroundSettings { cell_m: 24.0, max_gaussians: Some(one.gaussians / 2), ..merge_only };
    let many = run(models, &bounded, None, &dir.path().join("many"), &|| false).expect("aggregate");
    assert!(many.gaussians <= one.gaussians / 2 && many.gaussians + many.cells[1] >= one.gaussians / 2);
    let over: usize = many.kept.iter().map(|k| k.over_budget).sum();
    assert_eq!(over + many.gaussians, one.gaussians);
}

#[test]
fn an_interrupted_merge_leaves_a_model_and_goes_on_where_it_was() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().expect("temp dir");
    let (models, settings) = (row(3), GroundSettings { epochs: 10, ..in_cells() });
    let at_once = run(models.clone(), &settings, None, &dir.path().join("a"), &|| false).expect("aggregate");
    let asked = std::cell::Cell::new(0);
    let twice = || {
        asked.set(asked.get() + 1);
        asked.get() >= 40
    };
    let stopped = run(models.clone(), &settings, None, &dir.path().join("b"), &twice).expect("aggregate");
    assert!(stopped.interrupted && !stopped.header.finished);
    assert_eq!(model::read(&stopped.path).expect("valid").1.len(), stopped.gaussians);
    let rest = run(models, &settings, None, &dir.path().join("b"), &|| false).expect("aggregate");
    assert!(rest.cells[0] > 0 && rest.cells[0] < rest.cells[1], "{:?}", rest.cells);
    assert!(std::fs::read(&rest.path).expect("read") == std::fs::read(&at_once.path).expect("read"));
}

//! A guard against slow creep that needs no clock: the work of a fixed scene, counted, stays within 2 % of what
//! `counted_work.txt` says. After a change that is meant: `DGTR_BLESS=1 cargo test --release -p vulkan --test
//! counted_work` writes the file anew.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod scenes;

use config::plan::sh_columns;
use config::training::RateSettings;
use scenes::device::{empty_trainer, plain, posed};
use scenes::{cloud, photo, view};
use std::ops::ControlFlow;
use std::path::Path;
use vulkan::stages::work::{Load, work};
use vulkan::stages::{STAGE_NAMES, STAGES};
use vulkan::trainer::RunBudget;

const STEPS: u64 = 12;
const TOLERANCE: f64 = 0.02;
const STILL: RateSettings = RateSettings {
    mean_start: 0.0,
    mean_end: 0.0,
    log_scale: 0.0,
    rotation: 0.0,
    opacity: 0.0,
    sh_dc: 0.0,
    sh_rest: 0.0,
    pose_rotation: 0.0,
    pose_translation: 0.0,
    exposure: 0.0,
    final_share: 1.0,
};

#[test]
fn counted_work_of_a_fixed_scene_stays_within_two_percent() {
    let v = view(160, 120);
    let mut settings = plain();
    // Nothing moves, so that another recipe is no other scene.
    settings.rates = STILL;
    let Some(mut t) = empty_trainer(3, 2000, &v, &settings) else { return };
    t.load(&cloud(41, 2000, 3)).unwrap();
    for seed in [1, 2] {
        t.add_view(&posed(&v, &photo(seed, &v)), None).unwrap();
    }
    let mut visible = 0;
    let summary = t
        .run(&RunBudget { steps: Some(STEPS as u32), seconds: None }, &mut |r| {
            visible += r.visible as u64;
            ControlFlow::Continue(())
        })
        .unwrap();
    let c = summary.counters;
    let load = Load {
        gaussians: 2000,
        visible: visible / STEPS,
        instances: c.instances / STEPS,
        evaluations: c.evaluations / STEPS,
        pixels: 160 * 120,
        sh_columns: sh_columns(3),
    };
    let mut counted = vec![
        ("visible".to_owned(), load.visible),
        ("instances".to_owned(), load.instances),
        ("evaluations".to_owned(), load.evaluations),
        ("behind_opaque".to_owned(), c.behind_opaque / STEPS),
    ];
    for (stage, name) in STAGES.iter().zip(STAGE_NAMES) {
        let w = work(*stage, &load);
        counted.push((format!("{name}_bytes"), w.bytes));
        counted.push((format!("{name}_operations"), w.operations));
    }
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/counted_work.txt");
    if std::env::var_os("DGTR_BLESS").is_some() {
        let lines: Vec<String> = counted.iter().map(|(name, n)| format!("{name} {n}\n")).collect();
        std::fs::write(&file, lines.concat()).unwrap();
    }
    let text = std::fs::read_to_string(&file).unwrap();
    let stored: Vec<(&str, f64)> =
        text.lines().map(|l| l.split_once(' ').unwrap()).map(|(name, n)| (name, n.parse().unwrap())).collect();
    assert_eq!(stored.len(), counted.len(), "{} names other figures", file.display());
    for ((name, got), (stored_name, expected)) in counted.iter().zip(stored) {
        assert_eq!(name, stored_name);
        let off = (*got as f64 - expected).abs() / expected.max(1.0);
        assert!(off <= TOLERANCE, "{name}: {got} per step, stored {expected}: {:.1} % apart", 100.0 * off);
    }
}

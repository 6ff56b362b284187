//! Promises of the plan's file.

use super::*;
use crate::testing::{self, carpet, model, written};

fn planned(store: &Store, dir: &std::path::Path) -> Plan {
    let region = [[0.0, 0.0], [40.0, 0.0], [40.0, 20.0], [0.0, 20.0]];
    let mut members = [written(dir, &model("a", &region, carpet([0.0, 0.0], [40.0, 20.0], 1.0)))];
    let settings = GroundSettings { cell_m: 24.0, seam_m: 2.0, epochs: 0, register: false, ..Default::default() };
    testing::planned(&mut members, &settings, store)
}

#[test]
fn a_plan_is_read_as_it_was_written_and_one_that_was_spoilt_is_not() {
    let dir = tempfile::tempdir().expect("temp dir");
    let store = Store::folder(&dir.path().join("store"));
    assert!(Plan::read(&store).expect("asked").is_none());
    assert!(Plan::of(&store).is_err_and(|e| e.to_string().contains("dgtr ground plan")));
    let plan = planned(&store, dir.path());
    assert!(plan.cells.len() > 1 && plan.models[0].pieces.len() == plan.cells.len());
    assert_eq!(Plan::of(&store).expect("read"), plan);
    let bytes = plan.bytes().expect("bytes");
    for (at, what) in
        [(0, "no plan"), (8, "another version"), (bytes.len() / 2, "checksum"), (bytes.len() - 1, "checksum")]
    {
        let mut spoilt = bytes.clone();
        spoilt[at] ^= 1;
        assert!(Plan::parse(&spoilt).is_err_and(|e| e.contains(what)), "{at}");
    }
    for length in [0, 7, 11, bytes.len() - 1] {
        assert!(Plan::parse(&bytes[..length]).is_err());
    }
}

#[test]
fn a_plan_that_says_what_cannot_be_is_refused() {
    let dir = tempfile::tempdir().expect("temp dir");
    let plan = planned(&Store::folder(&dir.path().join("store")), dir.path());
    let spoil: [fn(&mut Plan); 6] = [
        |p| p.squares.seam_m = f32::NAN,
        |p| p.squares.seams = 3,
        |p| p.coverage_m = 0.0,
        |p| p.models.clear(),
        |p| p.cells.reverse(),
        |p| p.models[0].pieces[0].rows = 0,
    ];
    for (i, spoil) in spoil.into_iter().enumerate() {
        let mut bad = plan.clone();
        spoil(&mut bad);
        assert!(Plan::parse(&bad.bytes().expect("bytes")).is_err_and(|e| e.contains("no plan can")), "{i}");
    }
}

#[test]
fn the_page_on_formats_states_this_version() {
    let page = include_str!("../../../../models/FORMATS.md");
    for what in ["plan of a merge", "cell of a merge"] {
        let row = format!("| {what} | {VERSION} |");
        assert!(page.contains(&row), "{row}");
    }
}

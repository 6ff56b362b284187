//! What a ground says of a stick with another session's model.

use uplink::keys::Identity;
use uplink::offer::{OfferedModel, Order, hex};

use super::supervised::mission;
use super::{dgtr, error_line};

/// Puts a final model of the mission's aircraft on its stick, made for the session `session`.
pub(super) fn put_on_stick(dir: &std::path::Path, session: [u8; 32]) {
    let path = dir.join("m.dgtr");
    std::fs::write(&path, [7; 9000]).unwrap();
    let mission = config::mission::Mission::read(&dir.join("mission.toml")).unwrap();
    let source = uplink::Source::of(&mission, "one", dir).unwrap();
    let order = Order { flight: 7, counter: 3 };
    let model = OfferedModel::open(&path, &mission.upload, &source, order, true).unwrap();
    let folder = dir.join("upload/supervised/one");
    std::fs::create_dir_all(folder.join("chunk")).unwrap();
    std::fs::write(folder.join("chunk").join(hex(&model.offer.chunks[0])), model.chunk(0).unwrap()).unwrap();
    std::fs::write(folder.join("offer"), model.offer.bound_to(&session, &Identity::unsigned()).encode()).unwrap();
}

#[test]
fn a_final_model_of_another_session_is_named_in_line_exit_code_run_json_and_report() {
    let dir = tempfile::tempdir().unwrap();
    let (mission, out) = (mission(dir.path()), dir.path().join("out"));
    put_on_stick(dir.path(), [9; 32]);
    let serve = |more: &[&str]| {
        let arguments = ["serve", "--mission", &mission, "--out", out.to_str().unwrap(), "--timeout", "1"];
        dgtr(&[&arguments[..], more].concat())
    };
    let refused = serve(&[]);
    assert_eq!(refused.status.code(), Some(4));
    let line = error_line(&refused);
    assert!(line.contains("one's final model of flight 7 is not of this session"), "{line}");
    assert!(line.contains("--again"), "{line}");
    let run: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("run.json")).unwrap()).unwrap();
    assert_eq!(run["outcome"], "interrupted");
    // The mission lies with what belongs to it: `dgtr survey --after` needs no more than the folder.
    assert_eq!(std::fs::read(out.join("mission.toml")).unwrap(), std::fs::read(&mission).unwrap());
    assert_eq!((&run["stale"][0], &run["missing"][0]), (&"one".into(), &"one".into()), "{run}");
    let report = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(report.contains("final model of flight 7 is not of this session"));
    // Asked for, it is fetched, and refused for what it is: no model.
    let again = serve(&["--again"]);
    assert_eq!(again.status.code(), Some(4));
    let run: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("run.json")).unwrap()).unwrap();
    assert!(run["received"]["models_damaged"] == 1 && run["stale"].as_array().is_some_and(Vec::is_empty), "{run}");
}

//! A folder of results that a training was made in before: it goes on with the same pictures alone.

use super::{data_set, dgtr, error_line, has_device, short_training};

#[test]
fn a_training_into_the_folder_of_another_is_refused_in_one_line_and_begins_anew_when_asked() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let (set, out) = (path("set"), path("out"));
    short_training(&set, &out, &[]);
    let model = std::fs::read(dir.path().join("out/model.dgtr")).unwrap();
    // The same again changes nothing, and is no fault.
    short_training(&set, &out, &[]);
    let file = dir.path().join("set/transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replace("40.0", "41.5")).unwrap();
    let few = ["--init", "random", "--max-gaussians", "500", "--budget-mib", "64", "--steps", "20", "--no-eval"];
    let output = dgtr(&[&["train", &set, "--out", &out], &few[..]].concat());
    let line = error_line(&output);
    assert_eq!(output.status.code(), Some(2), "{line}");
    assert!(line.contains("other poses") && line.contains("--fresh"), "{line}");
    assert!(std::fs::read(dir.path().join("out/model.dgtr")).unwrap() == model, "nothing was changed");
    // One that ended before it had a model of its own leaves the old one's record: it is still not these pictures' model.
    let nowhere = [&["train", &set, "--out", &out, "--fresh", "--device", "nowhere"], &few[..]].concat();
    assert!(!dgtr(&nowhere).status.success());
    let output = dgtr(&[&["train", &set, "--out", &out], &few[..]].concat());
    assert!(output.status.code() == Some(2) && error_line(&output).contains("other poses"));
    short_training(&set, &out, &["--fresh"]);
    assert!(std::fs::read(dir.path().join("out/model.dgtr")).unwrap() != model);
}

//! Training that begins with a model, and scenes larger than the device.

use std::path::Path;

use models::formats::model;

use super::{data_set, dgtr, error_line, has_device};

/// A training of `set` without held-out figures.
fn train<'a>(set: &'a str, out: &'a str, steps: &'a str, more: &[&'a str]) -> std::process::Output {
    let few = ["--max-gaussians", "1200", "--budget-mib", "64", "--no-eval", "--steps", steps];
    dgtr(&[&["train", set, "--out", out], &few[..], more].concat())
}

fn held(output: std::process::Output) {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn training_begins_with_a_model_of_more_gaussians_than_the_device_holds_and_goes_on_with_it() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let (set, first, second) = (path("set"), path("first"), path("second"));
    held(train(&set, &first, "10", &["--init", "random", "--scene-gaussians", "2000"]));
    let begun = path("first/model.dgtr");
    let (header, cloud) = model::read(Path::new(&begun)).unwrap();
    assert_eq!((cloud.len(), header.steps, header.finished), (2000, 10, true));
    held(train(&set, &second, "4", &["--from", &begun]));
    let (header, cloud) = model::read(&dir.path().join("second/model.dgtr")).unwrap();
    assert_eq!((cloud.len(), header.steps, header.views.len()), (2000, 4, 10));
    // The same command with more steps goes on with what is there.
    held(train(&set, &second, "7", &["--from", &begun]));
    assert_eq!(model::read(&dir.path().join("second/model.dgtr")).unwrap().0.steps, 7);
    // The same seed, the same bytes.
    let again = path("again");
    held(train(&set, &again, "4", &["--from", &begun]));
    held(train(&set, &again, "7", &["--from", &begun]));
    let [a, b] = ["second", "again"].map(|out| std::fs::read(dir.path().join(out).join("model.dgtr")).unwrap());
    assert!(a == b);
}

#[test]
fn a_model_that_training_cannot_begin_with_is_one_line_and_stays_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let (set, out, damaged) = (path("set"), path("out"), path("damaged.dgtr"));
    let mut cloud = models::cloud::GaussianCloud::with_capacity(0, 9);
    (0..9).for_each(|i| cloud.push([i as f32, 0.0, 0.0], [-2.0; 3], [1.0, 0.0, 0.0, 0.0], 0.0, &[0.1; 3]));
    std::fs::create_dir(&out).unwrap();
    let model = path("out/model.dgtr");
    model::write(Path::new(&model), &model::ModelHeader::default(), &cloud).unwrap();
    let bytes = std::fs::read(&model).unwrap();
    let mut garbled = bytes.clone();
    garbled[200] ^= 2;
    let refused = |more: &[&str], code: i32, why: &str| {
        let output = train(&set, &out, "4", more);
        assert_eq!(output.status.code(), Some(code), "{}", String::from_utf8_lossy(&output.stderr));
        let line = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(line.contains(why), "{line}");
        assert!(std::fs::read(&model).unwrap() == bytes);
        output
    };
    for (content, why) in [(&garbled[..], "damaged"), (&bytes[..bytes.len() - 9], "ends"), (b"dgtr", "ends")] {
        std::fs::write(&damaged, content).unwrap();
        let output = refused(&["--from", &damaged], 2, "damaged.dgtr");
        let line = error_line(&output);
        assert!(line.contains(why), "{line}");
    }
    refused(&["--from", &model, "--fresh"], 2, "--fresh replaces");
    refused(&["--from", &path("none.dgtr")], 2, "none.dgtr");
    refused(&["--from", &model, "--init", "random"], 2, "--init");
    let empty = path("empty.dgtr");
    model::write(Path::new(&empty), &model::ModelHeader::default(), &Default::default()).unwrap();
    refused(&["--from", &empty], 2, "no Gaussians");
}

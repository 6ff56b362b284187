//! Promises of `models/python/dgtr.py`: it reads what the library wrote, bit by bit, and refuses what is no exact model.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;
use std::process::{Command, Output};

use geometry::geodesy::Geodetic;
use models::cloud::{GaussianCloud, sh_coefficients};
use models::formats::model::{self, ModelHeader};

/// What the reader is asked for: all columns, one after the other, as bytes.
const DUMP: &str = "
import sys
sys.path.insert(0, sys.argv[1])
import dgtr
m = dgtr.read(sys.argv[2])
assert m.mission == 'park' and m.aircraft == 'west', (m.mission, m.aircraft)
assert m.origin == (47.5, 8.25, 430.0) and m.region.tolist() == [[0, 0], [2, 0], [2, 1]], (m.origin, m.region)
assert m.means.shape == m.log_scales.shape == (5, 3) and m.rotations.shape == (5, 4) and m.sh.shape == (5, 9, 3)
with open(sys.argv[3], 'wb') as out:
    for column in (m.means, m.log_scales, m.rotations, m.logits, m.sh):
        out.write(column.tobytes())
";

fn written(path: &Path) -> GaussianCloud {
    let header = ModelHeader {
        mission: "park".into(),
        aircraft: "west".into(),
        origin: Some(Geodetic { lat_deg: 47.5, lon_deg: 8.25, alt_m: 430.0 }),
        region: vec![[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]],
        ..ModelHeader::default()
    };
    let mut cloud = GaussianCloud::with_capacity(2, 5);
    for i in 0..5 {
        let x = i as f32 + 0.125;
        let sh: Vec<f32> = (0..3 * sh_coefficients(2)).map(|k| x * k as f32).collect();
        cloud.push([x, -x, 2.0 * x], [-x, -1.0, -2.0], [1.0, 0.0, 0.5, x], 0.5 - x, &sh);
    }
    model::write(path, &header, &cloud).expect("written");
    cloud
}

/// Returns a Python that has numpy: `python3`, or the system's, which sees the packages of apt.
fn python() -> &'static str {
    let has_numpy = |python: &&str| {
        let asked = Command::new(python).args(["-c", "import numpy"]).output();
        asked.is_ok_and(|output| output.status.success())
    };
    ["python3", "/usr/bin/python3"].into_iter().find(has_numpy).expect("numpy: sh runtime/setup.sh --tests brings it")
}

/// Runs the reader on `model`; what it read goes to `dump`.
fn read(model: &Path, dump: &Path) -> Output {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("python");
    let mut python = Command::new(python());
    python.args(["-c", DUMP]).args([folder.as_path(), model, dump]).output().expect("python3 starts")
}

#[test]
fn python_reads_a_model_bit_by_bit() {
    let dir = tempfile::tempdir().expect("a folder");
    let (path, dump) = (dir.path().join("model.dgtr"), dir.path().join("columns"));
    let cloud = written(&path);
    let output = read(&path, &dump);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let columns = [
        cloud.means.as_flattened(),
        cloud.log_scales.as_flattened(),
        cloud.rotations.as_flattened(),
        &cloud.opacity_logits,
        &cloud.sh,
    ];
    let expected: Vec<u8> = columns.concat().iter().flat_map(|value| value.to_le_bytes()).collect();
    assert!(std::fs::read(&dump).expect("columns") == expected, "a column differs");
}

#[test]
fn python_refuses_a_cut_model_and_another_file() {
    let dir = tempfile::tempdir().expect("a folder");
    let (path, dump) = (dir.path().join("model.dgtr"), dir.path().join("columns"));
    written(&path);
    let whole = std::fs::read(&path).expect("the model");
    for (bytes, why) in [(&whole[..whole.len() - 1], "do not hold 5 Gaussians"), (b"ply\n", "not a .dgtr model")] {
        std::fs::write(&path, bytes).expect("written");
        let output = read(&path, &dump);
        assert!(!output.status.success());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(said.contains(why), "{said}");
    }
}

//! Keys: made, printed and asked for by the mission's own commands.

use std::path::Path;
use std::process::Output;

use super::{dgtr, error_line};

/// A mission of two aircraft whose ground listens on `listen`.
fn mission(dir: &Path, listen: &str, keys: &[(&str, String)]) -> std::path::PathBuf {
    let key = |id: &str| {
        let found = keys.iter().find(|k| k.0 == id);
        found.map_or(String::new(), |k| format!("public_key = \"{}\"", k.1))
    };
    let aircraft = ["west", "east"].map(|id| {
        let region = "region_enu = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]";
        let link = "link = \"udpin:127.0.0.1:14550\"\ncamera = { folder = \"pictures\" }";
        format!("[[aircraft]]\nid = \"{id}\"\n{link}\n{region}\n{}\n", key(id))
    });
    let text = format!(
        "name = \"park\"\norigin = {{ lat_deg = 28.0, lon_deg = -82.0, alt_m = 0.0 }}\n\
         camera = {{ width = 64, height = 48, fx = 50.0, fy = 50.0, cx = 32.0, cy = 24.0 }}\n\
         upload = {{ listen = [\"{listen}\"] }}\nground = {{ {} }}\n{}",
        key("ground"),
        aircraft.concat()
    );
    let path = dir.join("mission.toml");
    std::fs::write(&path, text).unwrap();
    path
}

/// The public keys that `dgtr keys` prints, in its order.
fn printed_keys(output: &Output) -> Vec<String> {
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let keys = text.lines().filter_map(|l| l.strip_prefix("public_key = \"")?.strip_suffix('"').map(str::to_owned));
    keys.collect()
}

#[test]
fn a_mission_is_keyed_by_its_own_commands_and_refused_beyond_this_machine_without() {
    let dir = tempfile::tempdir().unwrap();
    let outside = "tcp/0.0.0.0:1";
    let path = mission(dir.path(), outside, &[]);
    let (path, out) = (path.to_str().unwrap(), dir.path().join("out"));
    let serve = || dgtr(&["serve", "--mission", path, "--out", out.to_str().unwrap(), "--timeout", "1"]);
    let refused = serve();
    assert_eq!(refused.status.code(), Some(2));
    let line = error_line(&refused);
    assert!(line.contains(outside) && line.contains("dgtr keys") && line.contains("insecure = true"), "{line}");
    let unkeyed = dgtr(&["doctor", "--mission", path]);
    let text = String::from_utf8_lossy(&unkeyed.stdout).into_owned();
    assert!(text.contains("missing  signatures"), "{text}");

    // The keys are made once, and printed again when asked for one.
    let keys = printed_keys(&dgtr(&["keys", "--mission", path]));
    assert_eq!(keys.len(), 3);
    assert_eq!(printed_keys(&dgtr(&["keys", "--mission", path, "--only", "west"])), keys[1..2]);
    assert_eq!(dgtr(&["keys", "--mission", path, "--only", "nobody"]).status.code(), Some(2));
    // Signed, but for all to read.
    let all: Vec<(&str, String)> = ["ground", "west", "east"].into_iter().zip(keys).collect();
    mission(dir.path(), outside, &all);
    assert!(error_line(&serve()).contains("tls/HOST:PORT"));
    let outside = "tls/0.0.0.0:1";
    mission(dir.path(), outside, &all);
    let keyed = String::from_utf8_lossy(&dgtr(&["doctor", "--mission", path]).stdout).into_owned();
    for line in ["ok       signatures", "ok       private key", "ok       encryption"] {
        assert!(keyed.contains(line), "{line}: {keyed}");
    }
    // Port 1 is not ours to listen on, or nobody comes in time: either way it is not refused for its keys.
    let served = error_line(&serve());
    assert!(!served.contains("keys"), "{served}");

    // One key forgotten, or another machine's in the place of ours.
    mission(dir.path(), outside, &all[..2]);
    assert!(error_line(&serve()).contains("aircraft[1].public_key"));
    std::fs::copy(dir.path().join("keys/west.key"), dir.path().join("keys/ground.key")).unwrap();
    mission(dir.path(), outside, &all);
    let swapped = serve();
    assert_eq!(swapped.status.code(), Some(2));
    assert!(error_line(&swapped).contains("ground.key"));
}

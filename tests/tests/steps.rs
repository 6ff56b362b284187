//! Steps that people copy out of the pages do what the pages say, as far as they need neither root nor an autopilot.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;
use std::process::Command;

/// SHA-256 of `PASSPHRASE`, by coreutils.
const KEY: &str = "de83558a9940af2ba850d37662c8cfb517e87590885d90cd933984a6a05af12b";

fn page(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace").join(".github").join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The lines of a page's shell blocks.
fn steps(page: &str) -> Vec<String> {
    let fences = page.split("```");
    let blocks = fences.skip(1).step_by(2).filter_map(|block| block.strip_prefix("sh\n"));
    let joined = blocks.map(|block| block.replace("\\\n", " ")).collect::<Vec<_>>().join("\n");
    joined.lines().map(str::to_owned).collect()
}

/// Runs those lines that begin with one of these words, in order, in a folder.
fn run(lines: &[String], words: &[&str], dir: &Path) {
    let wanted: Vec<&String> = lines.iter().filter(|line| words.iter().any(|word| line.starts_with(word))).collect();
    assert!(wanted.len() >= words.len(), "{words:?} are steps of the page: {lines:#?}");
    for line in wanted {
        let line = line.replace("LAT,LON,ALT", "47.4,8.5,488");
        let line = line.strip_prefix("dgtr ").map_or(line.clone(), |more| format!("\"$DGTR\" {more}"));
        let mut shell = Command::new("sh");
        shell.args(["-ec", &line]).current_dir(dir).env("DGTR", env!("CARGO_BIN_EXE_dgtr-under-test"));
        let output = shell.output().expect("sh");
        assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
    }
}

fn mission(path: &Path) -> toml::Table {
    std::fs::read_to_string(path).expect("mission.toml").parse().expect("TOML")
}

fn camera_folder(mission: &toml::Table) -> String {
    mission["aircraft"][0]["camera"]["folder"].as_str().expect("a folder").to_owned()
}

#[test]
fn the_software_in_the_loop_of_both_autopilots_begins_with_a_camera_that_looks_down_into_a_folder_that_is_there() {
    for name in ["ARDUPILOT.md", "PX4.md"] {
        let dir = tempfile::tempdir().expect("tempdir");
        run(&steps(&page(name)), &["dgtr init", "sed", "mkdir"], dir.path());
        let mission = mission(&dir.path().join("mission.toml"));
        assert_eq!(mission["mount"]["attitude"].as_str(), Some("fixed"), "{name}");
        let down = [0.0, -90.0, 0.0].map(toml::Value::Float).to_vec();
        assert_eq!(mission["mount"]["rotation_deg"], toml::Value::Array(down), "{name}");
        assert!(dir.path().join(camera_folder(&mission)).is_dir(), "{name}");
    }
}

#[test]
fn a_signing_key_is_made_of_its_passphrase() {
    let dir = tempfile::tempdir().expect("tempdir");
    run(&steps(&page("ARDUPILOT.md")), &["(umask"], dir.path());
    assert_eq!(std::fs::read_to_string(dir.path().join("link.key")).expect("link.key").trim(), KEY);
}

#[test]
fn an_installed_companion_has_its_camera_folder_where_the_service_may_read_it() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = |folder: &str| dir.path().join(folder).to_str().expect("UTF-8").to_owned();
    let mut unprivileged = page("INSTALL.md");
    for right in ["sudo -u dgtr ", "&& sudo chown -R dgtr: /etc/dgtr/keys", "sudo ", "-o dgtr -g dgtr "] {
        assert!(unprivileged.contains(right), "{right:?} is in the page");
        unprivileged = unprivileged.replace(right, "");
    }
    let here = unprivileged.replace("/etc/dgtr", &at("etc")).replace("/var/lib/dgtr", &at("lib"));
    let here = here.replace("/etc/systemd/system", &at("units"));
    let words = ["mkdir -p ", "dgtr init", "install -d -m", "sed", "dgtr keys", "dgtr plan"];
    run(&steps(&here), &words, dir.path());
    let bounds = std::fs::read_to_string(at("units/dgtr-fly.service.d/plan.conf")).expect("plan.conf");
    assert!(bounds.starts_with("[Service]\n") && bounds.contains("MemoryMax="), "{bounds}");
    let keys = std::fs::read_dir(at("etc/keys")).expect("keys").flatten().count();
    assert!(keys > 0, "a private key");
    let folder = camera_folder(&mission(&dir.path().join("etc/mission.toml")));
    assert!(Path::new(&folder).is_dir() && folder.starts_with(&at("lib")), "{folder}");
}

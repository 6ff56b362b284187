//! What the Debian packages hold is true: files that are there, units whose commands the program accepts, a rule for the
//! autopilot's port that udev can read. `tests/package.sh` builds and installs them.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use support::refused;

fn read(path: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Key and value of every setting of a unit or defaults file.
fn settings(text: &str) -> Vec<(&str, &str)> {
    let lines = text.lines().filter(|l| !l.starts_with(['#', '[']));
    lines.filter_map(|l| l.split_once('=')).collect()
}

fn setting<'a>(unit: &'a str, key: &str) -> &'a str {
    let found: Vec<&str> = settings(unit).into_iter().filter(|s| s.0 == key).map(|s| s.1).collect();
    assert_eq!(found.len(), 1, "{key}: {found:?}");
    found[0]
}

fn units() -> [String; 2] {
    ["dgtr-fly", "dgtr-serve"].map(|name| read(&format!("runtime/package/{name}.service")))
}

#[test]
fn every_file_of_a_package_is_there_or_made_by_the_script_that_builds_it() {
    let manifest: toml::Table = read("runtime/Cargo.toml").parse().expect("a manifest");
    let deb = &manifest["package"]["metadata"]["deb"];
    let script = read("tests/package.sh") + &read("tests/package/onnxruntime.sh");
    for asset in deb["assets"].as_array().expect("assets") {
        let source = asset[0].as_str().expect("a source");
        let runtime = Path::new(env!("CARGO_MANIFEST_DIR")).join("../runtime");
        match source.strip_prefix("../target/package/") {
            // The pages and completions are written into one folder.
            Some(made) => {
                let named = made.split('/').next().expect("a name");
                assert!(script.contains(named), "nothing makes {source}");
            }
            None if source == "target/release/dgtr" => {}
            None => assert!(runtime.join(source).is_file(), "{source} is not there"),
        }
    }
    for script in ["postinst", "prerm", "postrm"] {
        assert!(read(&format!("runtime/package/{script}")).contains("\nset -e\n"), "{script}");
    }
    let features = manifest["features"].as_table().expect("features");
    let onboard = deb["variants"]["onboard"]["features"].as_array().expect("features");
    let known = |f: &toml::Value| f.as_str().is_some_and(|f| features.contains_key(f) && f != "lab");
    assert!(onboard.iter().all(known), "{onboard:?}");
}

#[test]
fn the_program_accepts_what_the_units_start() {
    let dir = tempfile::tempdir().expect("tempdir");
    let defaults = read("runtime/package/dgtr.default");
    for unit in units() {
        let start = setting(&unit, "ExecStart").strip_prefix("/usr/bin/dgtr ").expect("our program");
        let mut arguments = Vec::new();
        for word in start.split(' ') {
            match word.strip_prefix('$') {
                // As systemd does: split at spaces.
                Some(variable) => arguments.extend(setting(&defaults, variable).split_whitespace().map(str::to_owned)),
                // A mission that is surely not there: the arguments are read before it is.
                None => arguments.push(word.replace("%S", "state").replace("/etc/dgtr/", "etc/")),
            }
        }
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        refused(dir.path(), &arguments, 2, &["etc/mission.toml"]);
    }
}

#[test]
fn the_arguments_that_the_defaults_file_suggests_are_accepted() {
    let dir = tempfile::tempdir().expect("tempdir");
    let suggested = ["--aircraft", "west", "--link", "serial:/dev/autopilot:921600"];
    let defaults = read("runtime/package/dgtr.default");
    assert!(suggested.iter().all(|word| defaults.contains(word)), "{defaults}");
    let arguments = [&["fly", "--mission", "none.toml", "--out", "out"], &suggested[..]].concat();
    refused(dir.path(), &arguments, 2, &["none.toml"]);
}

#[test]
fn a_unit_is_restarted_more_and_more_slowly_watched_bounded_and_shut_in() {
    let postinst = read("runtime/package/postinst");
    for unit in units() {
        let is = |key: &str, value: &str| assert_eq!(setting(&unit, key), value, "{key}");
        is("Type", "notify");
        is("Restart", "on-failure");
        is("StartLimitIntervalSec", "0");
        is("StateDirectory", "dgtr");
        is("ProtectSystem", "strict");
        is("NoNewPrivileges", "yes");
        is("CapabilityBoundingSet", "");
        for key in ["WatchdogSec", "RestartSteps", "RestartMaxDelaySec", "MemoryMax", "TimeoutStopSec"] {
            assert!(!setting(&unit, key).is_empty(), "{key}");
        }
        assert!(postinst.contains(&format!(
            "adduser --system --group --quiet --home /var/lib/dgtr --no-create-home {}",
            setting(&unit, "User")
        )));
        // Whoever closes the clock's device closes all that are not named.
        assert!(settings(&unit).iter().all(|s| s.0 != "ProtectClock" && s.0 != "DeviceAllow"));
        // 4 is a valid checkpoint.
        is("SuccessExitStatus", "4");
    }
    assert_eq!(setting(&units()[0], "SupplementaryGroups"), "dialout video render");
}

/// A rule: what it compares, and what it does.
type Rule<'a> = (BTreeMap<&'a str, &'a str>, BTreeMap<&'a str, &'a str>);

fn rule(line: &str) -> Rule<'_> {
    let (mut compares, mut does) = Rule::default();
    for token in line.split(", ") {
        let (key, rest) = token.split_at(token.find(['=', '!', '+']).unwrap_or_else(|| panic!("{line}: no operator")));
        let (operator, value) = rest.split_at(rest.find('"').unwrap_or_else(|| panic!("{line}: no value")));
        let value = value[1..].strip_suffix('"').unwrap_or_else(|| panic!("{line}: {token} is not closed"));
        match operator {
            "==" | "!=" => assert!(compares.insert(key, value).is_none(), "{line}: {key} twice"),
            "=" | "+=" => assert!(does.insert(key, value).is_none(), "{line}: {key} twice"),
            other => panic!("{line}: operator {other}"),
        }
    }
    (compares, does)
}

#[test]
fn the_rule_of_the_autopilots_port_is_well_formed_and_every_number_is_named_once() {
    let text = read("runtime/package/71-dgtr-autopilot.rules");
    let rules: Vec<Rule<'_>> = text.lines().filter(|l| !l.is_empty() && !l.starts_with('#')).map(rule).collect();
    let label = |name: &str| rules.iter().position(|r| r.1.get("LABEL") == Some(&name));
    let mut numbers = BTreeSet::new();
    for (i, (compares, does)) in rules.iter().enumerate() {
        if let Some(to) = does.get("GOTO") {
            assert!(label(to).is_some_and(|at| at > i), "{to} does not follow");
        }
        let Some(vendor) = compares.get("ENV{ID_VENDOR_ID}") else { continue };
        assert_eq!(does.get("GOTO"), Some(&"dgtr_autopilot"));
        for product in compares.get("ENV{ID_MODEL_ID}").unwrap_or(&"*").split('|') {
            let hexadecimal = |id: &str| id.len() == 4 && id.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
            assert!(hexadecimal(vendor) && (product == "*" || hexadecimal(product)), "{vendor}:{product}");
            assert!(numbers.insert((*vendor, product.to_owned())), "{vendor}:{product} twice");
        }
    }
    for (vendor, product) in [("1209", "5740"), ("1209", "5741"), ("26ac", "*"), ("2dae", "*"), ("3162", "*")] {
        assert!(numbers.contains(&(vendor, product.to_owned())), "{vendor}:{product}");
    }
    let named = label("dgtr_autopilot").map(|at| &rules[at + 1].1);
    assert_eq!(named.and_then(|does| does.get("SYMLINK")), Some(&"autopilot"));
    let before = &rules[label("dgtr_autopilot").expect("a label") - 1];
    assert_eq!((before.0.len(), before.1.get("GOTO")), (0, Some(&"dgtr_end")), "nobody else falls through");
}

#[test]
fn onnx_runtime_has_its_version_and_hashes_in_one_place_and_whoever_fetches_it_asks_for_them() {
    let pin = read("runtime/onnxruntime.txt");
    let lines: Vec<&str> =
        pin.lines().filter(|l| !l.starts_with('#')).map(|l| l.trim().trim_end_matches(" \\")).collect();
    let version = lines[0].strip_prefix("onnxruntime==").expect("a version");
    assert!(version.split('.').filter(|part| part.parse::<u32>().is_ok()).count() == 3, "{version}");
    let hashes: Vec<&str> = lines[1..].iter().filter_map(|l| l.strip_prefix("--hash=sha256:")).collect();
    assert_eq!(hashes.len(), lines.len() - 1, "{pin}");
    assert!(hashes.len() == 2 && hashes.iter().all(|h| h.len() == 64 && h.bytes().all(|b| b.is_ascii_hexdigit())));
    let scripts = [
        "runtime/setup.sh",
        "tests/package.sh",
        "tests/package/onnxruntime.sh",
        "tests/package/sandbox.sh",
        "tests/arm64.sh",
    ];
    let mut fetched = 0;
    for script in scripts {
        // A command goes on in the next line.
        let text = read(script).replace("\\\n", " ");
        for command in text.lines().filter(|l| l.contains("pip download") || l.contains("pip install")) {
            let is_pinned = command.contains("--require-hashes -r") && command.contains("onnxruntime");
            assert!(is_pinned, "{script}: {command}");
            fetched += 1;
        }
        assert!(!text.contains("github.com/microsoft/onnxruntime/releases"), "{script}");
    }
    assert_eq!(fetched, 2, "setup.sh and the packages'");
}

//! What somebody new meets: the questions of `dgtr init`, and a doctor that says how to mend whatever it finds.

use std::fs::File;
use std::io::Write;
use std::process::{Output, Stdio};

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

use super::{dgtr, error_line, program};

/// Runs `dgtr` with a terminal for its standard input, on which somebody has typed `answers`.
fn on_a_terminal(arguments: &[&str], answers: &str) -> Output {
    let person = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&person).unwrap();
    unlockpt(&person).unwrap();
    let name = ptsname(&person, Vec::new()).unwrap().into_string().unwrap();
    let terminal = File::options().read(true).write(true).open(name).unwrap();
    let mut person = File::from(person);
    person.write_all(answers.as_bytes()).unwrap();
    program().args(arguments).stdin(Stdio::from(terminal)).output().unwrap()
}

#[test]
fn on_a_terminal_a_mission_is_asked_for_and_without_one_it_is_refused_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("m.toml");
    let path = file.to_str().unwrap();
    let refused = dgtr(&["init", "--out", path]);
    assert_eq!((refused.status.code(), file.exists()), (Some(2), false));
    assert!(error_line(&refused).contains("--origin LAT,LON,ALT"), "{}", error_line(&refused));
    assert_eq!(String::from_utf8_lossy(&refused.stderr).lines().count(), 1);

    // An empty line takes what stands in brackets; what cannot be read is asked for again.
    let answers =
        "park\nnowhere\n-33.9, 18.4, 12\n\n1280x960\n200\n62\nwest=udpin:0.0.0.0:14550 east=tcpin:0.0.0.0:1\n";
    let output = on_a_terminal(&["init", "--out", path, "--area-m", "300,120"], answers);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    assert!(said.contains("[300,120]") && said.contains("give 3 numbers") && said.contains("1 to 170"), "{said}");
    let mission = config::mission::Mission::read(&file).unwrap();
    let ids: Vec<&str> = mission.aircraft.iter().map(|a| a.id.as_str()).collect();
    assert_eq!((mission.name.as_str(), mission.origin.lat_deg, mission.camera.width), ("park", -33.9, 1280));
    assert_eq!((ids, mission.region(&mission.aircraft[0])[2]), (vec!["west", "east"], [0.0, 60.0]));
    // It says what to do with it, and nothing is asked in vain.
    assert!(String::from_utf8_lossy(&output.stdout).contains("dgtr doctor --mission"));
    let there = on_a_terminal(&["init", "--out", path], "");
    assert!(there.status.code() == Some(2) && error_line(&there).contains("--out"), "{}", error_line(&there));

    // Whoever only presses Enter has a mission, too; whoever leaves (Ctrl-D) has none.
    let plain = dir.path().join("plain.toml");
    let plain = plain.to_str().unwrap();
    let left = on_a_terminal(&["init", "--out", plain], "park\n\x04");
    assert_eq!((left.status.code(), std::path::Path::new(plain).exists()), (Some(2), false));
    let entered = on_a_terminal(&["init", "--out", plain], &"\n".repeat(6));
    assert!(entered.status.success(), "{}", String::from_utf8_lossy(&entered.stderr));
    let plan = dgtr(&["plan", "--mission", plain]);
    assert_ne!(plan.status.code(), Some(2), "{}", String::from_utf8_lossy(&plan.stderr));
}

/// A machine without a device or a library, a network that is not there, and missions that protect nothing.
#[test]
fn whatever_the_doctor_finds_it_says_how_to_mend_it() {
    let dir = tempfile::tempdir().unwrap();
    let (mut found, mut noted) = (0, 0);
    let aircraft = "camera = { folder = \"c\" }\nregion_enu = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]\n";
    let key = format!("public_key = \"{}\"\n", "1".repeat(64));
    let missions = [
        ("", "udpin:0.0.0.0:14550", ""),
        ("upload = { listen = [\"tcp/0.0.0.0:7447\"] }\n", "carrier:pigeon", ""),
        ("upload = { listen = [\"tcp/0.0.0.0:7447\"], insecure = true }\n", "serial:/dev/null:57600", ""),
        ("upload = { listen = [\"tls/0.0.0.0:7447\"] }\nground = { public_key = \"KEY\" }\n", "tcpin:0.0.0.0:1", &key),
    ];
    for (n, (upload, link, key)) in missions.into_iter().enumerate() {
        let path = dir.path().join(format!("{n}.toml"));
        let text = format!(
            "name = \"park\"\norigin = {{ lat_deg = 28.0, lon_deg = -82.0, alt_m = 0.0 }}\n\
             camera = {{ width = 64, height = 48, fx = 50.0, fy = 50.0, cx = 32.0, cy = 24.0 }}\n{}\
             [[aircraft]]\nid = \"west\"\nlink = \"{link}\"\n{aircraft}{key}",
            upload.replace("KEY", &"2".repeat(64))
        );
        std::fs::write(&path, text).unwrap();
        let nowhere = dir.path().join("nowhere");
        let output = program()
            .args(["doctor", "--model", nowhere.to_str().unwrap(), "--mission", path.to_str().unwrap()])
            .env("DGTR_PROCESSOR", "driver")
            .envs(["VK_DRIVER_FILES", "VK_ICD_FILENAMES", "ORT_DYLIB_PATH"].map(|name| (name, &nowhere)))
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        assert_eq!(output.status.code(), Some(3), "{said}{}", String::from_utf8_lossy(&output.stderr));
        for line in said.lines().filter(|line| !line.starts_with("ok")) {
            let (_, mend) = line.split_once("; ").unwrap_or_else(|| panic!("{line}"));
            assert!(mend.split_whitespace().count() > 1, "{line}");
            if line.starts_with("missing") { found += 1 } else { noted += 1 }
        }
    }
    assert!(found > 12 && noted > 6, "{found} missing, {noted} notes");
}

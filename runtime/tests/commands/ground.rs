//! Promises of a merge as jobs: what the three commands print and return, and that they give what one process gives.

use super::*;

/// Three models side by side, without views: nothing needs a device.
fn models(dir: &Path) -> Vec<String> {
    let model = |i: usize| {
        let west = 160.0 * i as f32;
        let mut cloud = GaussianCloud::with_capacity(0, 60 * 40);
        for n in 0..60 * 40 {
            let mean = [west - 40.0 + 4.0 * (n % 60) as f32, 4.0 * (n / 60) as f32 - 80.0, 0.0];
            cloud.push(mean, [0.7; 3], [1.0, 0.0, 0.0, 0.0], 3.0, &[0.1 * i as f32; 3]);
        }
        let (w, e) = (f64::from(west), f64::from(west + 160.0));
        let region = vec![[w, -80.0], [e, -80.0], [e, 80.0], [w, 80.0]];
        let path = dir.join(format!("a{i}.dgtr"));
        model::write(&path, &ModelHeader { aircraft: format!("a{i}"), region, ..Default::default() }, &cloud).unwrap();
        path.display().to_string()
    };
    (0..3).map(model).collect()
}

fn lines(output: &Output) -> Vec<String> {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).lines().map(str::to_owned).collect()
}

#[test]
fn three_commands_give_the_model_that_one_process_gives() {
    let dir = tempfile::tempdir().unwrap();
    let models = models(dir.path());
    let models: Vec<&str> = models.iter().map(String::as_str).collect();
    let at = |name: &str| dir.path().join(name).display().to_string();
    let (store, out, one) = (at("store"), at("merged"), at("one"));
    let how = ["--epochs", "0", "--cell-m", "64"];
    let plan = [&["ground", "plan"], &models[..], &["--store", &store], &how].concat();
    let keys = lines(&dgtr(&plan));
    assert!(keys.len() >= 8 && keys.contains(&"0/0/0".to_owned()), "{keys:?}");

    let early = dgtr(&["ground", "join", "--store", &store, "--out", &out]);
    let told = error_line(&early);
    assert_eq!(early.status.code(), Some(1));
    assert!(told.contains(&format!("{0} of {0} cells are missing: {1}", keys.len(), keys[0])), "{told}");
    assert!(!Path::new(&out).join("global.dgtr").exists());

    // By key, by share, and all that is left.
    let made = lines(&dgtr(&["ground", "cell", "0/0/0", "--store", &store]));
    assert!(made.len() == 1 && made[0].starts_with("0/0/0 ") && made[0].ends_with("made"), "{made:?}");
    let share = lines(&dgtr(&["ground", "cell", "--share", "1/3", "--store", &store]));
    assert_eq!(share.len(), (keys.len() - 1).div_ceil(3));
    let all = lines(&dgtr(&["ground", "cell", "--all", "--store", &store]));

    assert!(all.len() == keys.len() && all.iter().any(|l| l.ends_with("was there")));
    assert_eq!(lines(&dgtr(&plan)).len(), 0, "there is nothing left to do");

    let joined = lines(&dgtr(&["ground", "join", "--store", &store, "--out", &out]));
    let aggregate = [&["aggregate"], &models[..], &["--out", &one], &how].concat();
    lines(&dgtr(&aggregate));
    let [joined_file, one_file] = [&out, &one].map(|dir| Path::new(dir).join("global.dgtr"));
    assert!(std::fs::read(&joined_file).unwrap() == std::fs::read(&one_file).unwrap());
    let (_, cloud, content) = model::read_with_hash(&joined_file).unwrap();
    assert_eq!(joined[0], format!("{}: {} Gaussians out of 3 models", joined_file.display(), cloud.len()));
    assert_eq!(joined[1], blake3::Hash::from_bytes(content).to_hex().as_str());
}

#[test]
fn what_cannot_be_done_is_said_in_a_line() {
    let dir = tempfile::tempdir().unwrap();
    let models = models(dir.path());
    let store = dir.path().join("store").display().to_string();
    let refused = |arguments: &[&str], code: i32, what: &str| {
        let output = dgtr(arguments);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {told}");
        assert!(told.contains(what), "{arguments:?}: {told}");
    };
    refused(&["ground", "cell", "--all", "--store", &store], 2, "run `dgtr ground plan`");
    refused(&["ground", "join", "--store", &store, "--out", &store], 2, "run `dgtr ground plan`");
    lines(&dgtr(&["ground", "plan", &models[0], "--store", &store, "--epochs", "0"]));
    refused(&["ground", "cell", "0/77/-3", "--store", &store], 2, "0/77/-3");
    refused(&["ground", "cell", "here", "--store", &store], 2, "LEVEL/X/Y");
    refused(&["ground", "cell", "--share", "4/4", "--store", &store], 2, "I/N");
    refused(&["ground", "cell", "--store", &store], 2, "required");
    refused(&["ground", "plan", &models[0], "--store", "s3://"], 2, "s3://");
}

/// Thousands of Gaussians over a thousand kilometres make a job each; asked to stop, the merge went on for an hour.
#[test]
fn a_merge_of_very_many_cells_obeys_a_request_to_stop_and_keeps_what_is_made() {
    let dir = tempfile::tempdir().unwrap();
    let mut cloud = GaussianCloud::with_capacity(0, 8000);
    for i in 0..8000 {
        let along = |step: f64| ((f64::from(i) * step).fract() * 2e6 - 1e6) as f32;
        cloud.push([along(0.754_877_666), along(0.569_840_291), 0.0], [0.7; 3], [1.0, 0.0, 0.0, 0.0], 3.0, &[0.1; 3]);
    }
    let (path, out) = (dir.path().join("strewn.dgtr"), dir.path().join("out"));
    model::write(&path, &ModelHeader::default(), &cloud).unwrap();
    let mut command = program();
    command.arg("aggregate").arg(&path).arg("--out").arg(&out).args(["--epochs", "0"]);
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let made = || std::fs::read_dir(out.join("ground/cells")).map_or(0, Iterator::count);
    let until = Instant::now() + Duration::from_secs(120);
    while made() < 20 {
        assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
        assert!(Instant::now() < until, "nothing was made");
        std::thread::sleep(Duration::from_millis(20));
    }
    let pid = rustix::process::Pid::from_child(&child);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    let ended = child.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(4));
    assert!(String::from_utf8_lossy(&ended.stderr).contains("run the same command again"));
    assert!((20..8000).contains(&made()), "{} cells", made());
}

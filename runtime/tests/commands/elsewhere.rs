//! What an input names that is no file, or lies elsewhere: refused in one line and never waited for, and nothing is written elsewhere.

use std::fs::File;
use std::path::PathBuf;

use super::*;

/// However busy the machine is; a reader that waits for a pipe's other end waits for ever.
const PATIENCE: Duration = Duration::from_secs(300);

/// Runs `dgtr` in `folder` to its end.
#[track_caller]
fn ended(folder: &Path, arguments: &[&str]) -> Output {
    let [out, err] = ["stdout", "stderr"].map(|name| folder.join(name));
    let mut command = program();
    command.current_dir(folder).args(arguments).stdin(Stdio::null());
    command.stdout(File::create(&out).unwrap()).stderr(File::create(&err).unwrap());
    let mut child = command.spawn().unwrap();
    let until = Instant::now() + PATIENCE;
    let status = loop {
        match child.try_wait().unwrap() {
            Some(status) => break status,
            None if Instant::now() >= until => {
                child.kill().unwrap();
                child.wait().unwrap();
                panic!("{arguments:?} waits for ever");
            }
            None => std::thread::sleep(Duration::from_millis(20)),
        }
    };
    Output { status, stdout: std::fs::read(out).unwrap(), stderr: std::fs::read(err).unwrap() }
}

/// `set/transforms.json` with the first frame's picture and mask.
fn naming(folder: &Path, picture: &str, mask: Option<&str>) {
    let path = folder.join("set/transforms.json");
    let mut set: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    set["frames"][0]["file_path"] = picture.into();
    match mask {
        Some(mask) => set["frames"][0]["mask_path"] = mask.into(),
        None => drop(set["frames"][0].as_object_mut().unwrap().remove("mask_path")),
    }
    std::fs::write(path, set.to_string()).unwrap();
}

#[test]
fn a_pipe_a_terminal_and_a_device_as_picture_or_mask_are_refused_and_nobody_waits_for_them() {
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let pipe = dir.path().join("set/images/pipe.png");
    rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, 0o600.into(), 0).unwrap();
    std::os::unix::fs::symlink("/dev/zero", dir.path().join("set/images/zero.png")).unwrap();
    let train = ["train", "set", "--out", "out", "--init", "random", "--steps", "1", "--fresh", "-q"];
    for special in ["images/pipe.png", "images/zero.png", "/dev/ptmx", "/dev/zero"] {
        for (picture, mask) in [(special, None), ("images/00.png", Some(special))] {
            naming(dir.path(), picture, mask);
            let output = ended(dir.path(), &train);
            let line = error_line(&output);
            assert_eq!(output.status.code(), Some(2), "{special}, {mask:?}: {line}");
            assert!(line.contains(special) && line.contains("no regular file"), "{special}, {mask:?}: {line}");
        }
    }
}

#[test]
fn cameras_whose_names_lead_out_of_the_folder_of_results_are_drawn_in_it() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let mut cloud = GaussianCloud::with_capacity(0, 25);
    for n in 0..25 {
        let mean = [(n % 5) as f32, (n / 5) as f32, 0.0];
        cloud.push(mean, [-1.0; 3], [1.0, 0.0, 0.0, 0.0], 3.0, &[0.5; 3]);
    }
    model::write(&dir.path().join("m.dgtr"), &ModelHeader::default(), &cloud).unwrap();
    std::fs::create_dir(dir.path().join("above")).unwrap();
    let away = dir.path().join("away");
    let names = ["images/..", "..", "a/../..", "../../x.png", &format!("{}/..", away.display()), "images/b.png"];
    let pose = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(2.0, 2.0, 10.0) };
    let matrix = pose_to_opengl(&pose);
    for name in names {
        let frame = |name: &str| format!(r#"{{"file_path": {name:?}, "transform_matrix": {matrix:?}}}"#);
        let frames = [frame(name), frame("y/c.png")].join(",");
        let cameras = format!(r#"{{"fl_x": 40, "cx": 24, "cy": 18, "w": 48, "h": 36, "frames": [{frames}]}}"#);
        std::fs::write(dir.path().join("cameras.json"), cameras).unwrap();
        let out = dir.path().join("above/out");
        let output = ended(dir.path(), &["render", "m.dgtr", "--cameras", "cameras.json", "--out", "above/out", "-q"]);
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
        assert_eq!(names_in(&dir.path().join("above")), ["out"], "{name}");
        assert_eq!(names_in(dir.path()), ["above", "cameras.json", "m.dgtr", "stderr", "stdout"], "{name}");
        assert_eq!(files_below(&out).len(), 4, "{name}: {:?}", files_below(&out));
        std::fs::remove_dir_all(&out).unwrap();
    }
}

#[test]
fn what_a_name_would_make_a_terminal_do_reaches_neither_output_nor_error() {
    let dir = tempfile::tempdir().unwrap();
    let mut cloud = GaussianCloud::with_capacity(0, 1);
    cloud.push([0.0; 3], [-1.0; 3], [1.0, 0.0, 0.0, 0.0], 3.0, &[0.5; 3]);
    model::write(&dir.path().join("m.dgtr"), &ModelHeader::default(), &cloud).unwrap();
    let name = "a\u{1b}[2J\u{9b}31m\u{7}.ply";
    let written = ended(dir.path(), &["export", "m.dgtr", "--to", "ply", "--out", name, "-q"]);
    assert!(written.status.success() && dir.path().join(name).exists());
    // The file is called so; it is shown as this.
    let shown = "a\\u001b[2J\\u009b31m\\u0007";
    let told = String::from_utf8(written.stdout).unwrap();
    assert!(told.starts_with(&format!("{shown}.ply: 1 Gaussians")) && told.ends_with('\n'), "{told:?}");
    let missing = "a\u{1b}[2J\u{9b}31m\u{7}\nINFO all is well.toml";
    let refused = ended(dir.path(), &["plan", "--mission", missing]);
    let line = error_line(&refused);
    assert!(line.contains(shown) && line.contains("INFO all is well.toml"), "{line:?}");
    for told in [told.trim_end(), &line] {
        assert!(!told.contains(|c: char| c.is_control()), "{told:?}");
    }
}

fn names_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

fn files_below(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}

/// A field of Protocol Buffers that holds bytes.
fn field(number: u8, content: &[u8]) -> Vec<u8> {
    assert!(content.len() < 128 && number < 16);
    [&[number << 3 | 2, content.len() as u8], content].concat()
}

#[test]
fn a_network_with_weights_in_another_file_is_refused_wherever_that_file_lies() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let networks = dir.path().join("networks");
    std::fs::create_dir(&networks).unwrap();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/networks");
    let whole = std::fs::read(shipped.join("mean_square.onnx")).unwrap();
    let manifest = std::fs::read_to_string(shipped.join("mean_square.toml")).unwrap();
    let without_hash: Vec<&str> = manifest.lines().filter(|line| !line.starts_with("blake3")).collect();
    std::fs::write(networks.join("mean_square.toml"), without_hash.join("\n")).unwrap();
    let network = networks.join("mean_square.onnx");
    std::fs::write(&network, &whole).unwrap();
    let train = ["train", "set", "--out", "out", "--init", "random", "--steps", "1", "-q"];
    let trained = ended(dir.path(), &train);
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    let eval = ["eval", "out/model.dgtr", "set", "-q", "--metric", "networks/mean_square.toml"];
    let measured = ended(dir.path(), &eval);
    assert!(measured.status.success(), "{}", String::from_utf8_lossy(&measured.stderr));
    for place in ["w.bin", "networks/w.bin"] {
        std::fs::write(dir.path().join(place), [7; 4]).unwrap();
    }
    for location in ["w.bin", "../w.bin", "/etc/passwd"] {
        // A graph's tensor called "w", of four bytes (types 3 = INT8), data_location EXTERNAL; fields of two messages in a row are one message's.
        let place = [field(1, b"location"), field(2, location.as_bytes())].concat();
        let tensor = [vec![1 << 3, 4, 2 << 3, 3], field(8, b"w"), field(13, &place), vec![14 << 3, 1]].concat();
        let outside = field(7, &field(5, &tensor));
        std::fs::write(&network, [whole.clone(), outside].concat()).unwrap();
        let output = ended(dir.path(), &eval);
        let line = error_line(&output);
        assert_eq!(output.status.code(), Some(2), "{location}: {line}");
        assert!(line.contains("weights") && line.contains(location), "{location}: {line}");
    }
}

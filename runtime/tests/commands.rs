//! Promises of the command line: exit codes, one line per error, valid files at every moment. Where there is no Vulkan
//! device, what needs one is skipped and says so.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3};
use image::{Rgb, RgbImage};
use models::camera::Pose;
use models::cloud::GaussianCloud;
use models::formats::flight_plan::{FlightPlan, Waypoint};
use models::formats::model::{self, ModelHeader};
use models::formats::transforms::pose_to_opengl;

#[path = "commands/again.rs"]
mod again;
#[path = "commands/begun.rs"]
mod begun;
#[path = "commands/checked.rs"]
#[cfg(feature = "lab")]
mod checked;
#[path = "commands/crowded.rs"]
mod crowded;
#[path = "commands/earlier.rs"]
mod earlier;
#[path = "commands/elsewhere.rs"]
mod elsewhere;
#[path = "commands/first_steps.rs"]
mod first_steps;
#[path = "commands/ground.rs"]
mod ground;
#[path = "commands/keys.rs"]
mod keys;
#[path = "commands/listening.rs"]
mod listening;
#[path = "commands/manual.rs"]
#[cfg(feature = "lab")]
mod manual;
#[path = "commands/measured.rs"]
mod measured;
#[path = "commands/observed.rs"]
mod observed;
#[path = "commands/report.rs"]
#[cfg(feature = "lab")]
mod report;
#[path = "commands/supervised.rs"]
mod supervised;
#[path = "commands/surveyed.rs"]
mod surveyed;
#[path = "commands/viewing.rs"]
mod viewing;

/// `dgtr`, which measures no kernels and leaves the user's cache folder alone.
fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_dgtr"));
    command.env(config::kernels::VARIABLE, "default");
    command
}

fn dgtr(arguments: &[&str]) -> Output {
    program().args(arguments).output().unwrap()
}

fn error_line(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    let lines: Vec<&str> = text.lines().filter(|l| l.starts_with("dgtr: ")).collect();
    assert_eq!(lines.len(), 1, "{text}");
    lines[0].to_owned()
}

fn has_device() -> bool {
    let found = vulkan::gpu::Gpu::list().is_ok();
    if !found {
        needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
    }
    found
}

/// Twelve nadir pictures of a painted plane, 40 m up, 4 m apart.
fn data_set(root: &Path) {
    std::fs::create_dir_all(root.join("images")).unwrap();
    let frames: Vec<String> = (0..12)
        .map(|i| {
            let (east, north) = (f64::from(i % 4) * 4.0, f64::from(i / 4) * 4.0);
            let image = RgbImage::from_fn(48, 36, |x, y| {
                let (e, n) = (east + f64::from(x) - 23.5, north - f64::from(y) + 17.5);
                let stripe = |v: f64| if (v / 6.0).floor() as i64 % 2 == 0 { 200 } else { 60 };
                Rgb([stripe(e), stripe(n), 90])
            });
            image.save(root.join(format!("images/{i:02}.png"))).unwrap();
            let center = DVec3::new(east, north, 40.0);
            let m = pose_to_opengl(&Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center });
            format!(r#"{{"file_path":"images/{i:02}.png","transform_matrix":{m:?}}}"#)
        })
        .collect();
    let text = format!(
        r#"{{"fl_x":40,"fl_y":40,"cx":24,"cy":18,"w":48,"h":36,"enu_origin_wgs84":{{"lat":46.0,"lon":7.0,"alt":500.0}},"frames":[{}]}}"#,
        frames.join(",")
    );
    std::fs::write(root.join("transforms.json"), text).unwrap();
}

#[test]
fn a_mission_written_by_init_is_accepted_by_plan_and_fly() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("m.toml");
    let path = file.to_str().unwrap();
    let told = ["--origin=-33.9,18.4,12", "--picture", "1280x960", "--fov-deg", "62", "--preset", "tiny"];
    let fleet = ["--aircraft", "west=udpin:127.0.0.1:0", "--aircraft", "east=carrier:pigeon", "--area-m", "300,120"];
    let init = |more: &[&str]| dgtr(&[&["init", "--out", path], &told[..], &fleet, more].concat());
    let first = init(&[]);
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    let text = std::fs::read_to_string(&file).unwrap();
    // A file that is there is left alone, and a mission that cannot be flown is not written.
    assert_eq!(init(&["--name", "other"]).status.code(), Some(2));
    assert_eq!(std::fs::read_to_string(&file).unwrap(), text);
    let other = dir.path().join("other.toml");
    let refused = init(&["--name", "a/b", "--out", other.to_str().unwrap()]);
    assert_eq!((refused.status.code(), other.exists()), (Some(2), false));
    let plan = dgtr(&["plan", "--mission", path]);
    let (said, error) = (String::from_utf8_lossy(&plan.stdout), String::from_utf8_lossy(&plan.stderr));
    assert!(
        said.contains(
            "48 views and 512 crops of 320 x 240, 49 of them on the device at once, SH degree 3, 96 MiB allowed"
        ),
        "{said}{error}"
    );
    // The mission is accepted; what is refused is the link.
    let out = dir.path().join("out");
    let fly = dgtr(&["fly", "--mission", path, "--aircraft", "east", "--out", out.to_str().unwrap()]);
    assert_eq!(fly.status.code(), Some(2));
    assert!(error_line(&fly).contains("carrier"), "{}", error_line(&fly));
    // Where a recording cannot be written nothing is opened.
    let out = out.to_str().unwrap();
    let fly = dgtr(&["fly", "--mission", path, "--aircraft", "east", "--out", out, "--record", "/nonexistent/f.mcap"]);
    assert_eq!((fly.status.code(), error_line(&fly).contains("/nonexistent/f.mcap")), (Some(2), true));
    let sim = dgtr(&["sim", "--mission", path, "--aircraft", "east", "--autopilot", "nowhere"]);
    assert_eq!((sim.status.code(), error_line(&sim).contains("nowhere")), (Some(2), true));
}

#[test]
fn the_reference_of_settings_needs_no_other_argument() {
    let reference = dgtr(&["init", "--reference"]);
    let text = String::from_utf8_lossy(&reference.stdout).into_owned();
    assert!(reference.status.success() && text.contains("heartbeat_timeout_s = 5.0"), "{text}");
}

/// The pictures land on a card, so that nothing needs to listen.
#[test]
fn a_plan_is_flown_by_the_simulator_with_a_picture_at_each_waypoint() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let origin = geometry::geodesy::Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 500.0 };
    let mission = "name = \"m\"\norigin = { lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }\n\
                   camera = { width = 32, height = 24, fx = 30.0, fy = 30.0, cx = 16.0, cy = 12.0 }\n\
                   [[aircraft]]\nid = \"one\"\nlink = \"tcpin:1\"\ncamera = { folder = \"c\" }\n\
                   region_enu = [[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]\n";
    std::fs::write(path("m.toml"), mission).unwrap();
    let frame = geometry::geodesy::EnuFrame::new(origin);
    let places = [DVec3::new(0.0, 0.0, 35.0), DVec3::new(30.0, 0.0, 35.0), DVec3::new(30.0, 25.0, 45.0)];
    let waypoint =
        |p: &DVec3| Waypoint { position: frame.to_geodetic(*p), yaw_deg: None, picture: true, every_m: None };
    let waypoints = places.iter().map(waypoint).collect();
    let plan = FlightPlan { home: origin, speed_m_s: 5.0, pitch_deg: Some(-90.0), waypoints, landing: None };
    plan.write(&mut std::fs::File::create(path("again.plan")).unwrap()).unwrap();
    let card = path("card");
    let flown =
        dgtr(&["sim", "--mission", &path("m.toml"), "--plan", &path("again.plan"), "--card", &card, "--perfect"]);
    assert!(flown.status.success(), "{}", String::from_utf8_lossy(&flown.stderr));
    let taken = models::formats::transforms::read(&dir.path().join("card/truth.json")).unwrap();
    assert_eq!(taken.shots.len(), places.len());
    for (shot, place) in taken.shots.iter().zip(places) {
        assert!((shot.pose.center - place).length() < 0.5 && shot.pose.forward().z < -0.999, "{shot:?}");
    }
}

#[test]
fn bad_input_is_one_line_and_exit_code_2() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    std::fs::write(path("bad.dgtr"), b"dgtr\r\n\x1a\n rubbish that is no model").unwrap();
    data_set(&dir.path().join("set"));
    let cases: [(&[&str], &str); 9] = [
        (&["export", &path("none.dgtr"), "--to", "ply"], "none.dgtr"),
        (&["export", &path("bad.dgtr"), "--to", "ply"], "bad.dgtr"),
        (&["import", &path("set/images/00.png")], "00.png"),
        (&["eval", &path("bad.dgtr"), &path("nowhere"), "--json"], "nowhere"),
        (&["eval", &path("bad.dgtr"), &path("set"), "--split", "valid"], "valid"),
        (&["train", &path("nowhere"), "--out", &path("out")], "nowhere"),
        (&["plan", "--budget-mib", "1"], "MiB"),
        (&["train", &path("set"), "--out", "s3://bucket/field"], "--out s3://bucket/field: is an address"),
        (&["export", &path("bad.dgtr"), "--to", "ply", "--out", "https://example.org/a.ply"], "give a path"),
    ];
    for (arguments, named) in cases {
        let output = dgtr(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(error_line(&output).contains(named), "{arguments:?}");
        assert!(output.stdout.is_empty(), "{arguments:?}");
    }
    assert_eq!(dgtr(&["no-such-command"]).status.code(), Some(2));
    assert_eq!(dgtr(&["--help"]).status.code(), Some(0));
}

#[test]
fn a_device_that_is_not_there_is_exit_code_3() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let set = dir.path().to_string_lossy().into_owned();
    let out = dir.path().join("out").to_string_lossy().into_owned();
    for arguments in [&["train", &set, "--out", &out][..], &["plan"]] {
        let output = dgtr(&[arguments, &["--device", "no such device"]].concat());
        assert_eq!(output.status.code(), Some(3), "{}", String::from_utf8_lossy(&output.stderr));
        error_line(&output);
    }
}

#[test]
fn export_and_import_give_the_model_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let mut cloud = GaussianCloud::with_capacity(1, 1);
    cloud.push([1.0, 2.0, 3.0], [-1.0; 3], [1.0, 0.0, 0.0, 0.0], 0.5, &[0.1; 12]);
    let origin = Some(geometry::geodesy::Geodetic { lat_deg: 46.5, lon_deg: 7.25, alt_m: 500.125 });
    model::write(&dir.path().join("m.dgtr"), &ModelHeader { origin, ..Default::default() }, &cloud).unwrap();
    assert!(dgtr(&["export", &path("m.dgtr"), "--to", "ply"]).status.success());
    assert!(dgtr(&["import", &path("m.ply"), "--out", &path("back.dgtr")]).status.success());
    let (header, back) = model::read(&dir.path().join("back.dgtr")).unwrap();
    assert_eq!((header.origin, &back), (origin, &cloud));
    assert!(dgtr(&["export", &path("m.dgtr"), "--to", "spz"]).status.success());
    assert!(dgtr(&["import", &path("m.spz"), "--out", &path("rounded.dgtr")]).status.success());
    let (_, rounded) = model::read(&dir.path().join("rounded.dgtr")).unwrap();
    assert_eq!((rounded.means, rounded.log_scales), (cloud.means, cloud.log_scales), "these are representable");
    assert!(dgtr(&["export", &path("m.dgtr"), "--to", "delivery"]).status.success());
    let (header, delivered) = model::read(&dir.path().join("m.delivery.dgtr")).unwrap();
    assert_eq!((header.origin, delivered.len()), (origin, 1), "read wherever a .dgtr is");
    let misplaced = dgtr(&["export", &path("m.dgtr"), "--to", "ply", "--fine"]);
    assert_eq!(misplaced.status.code(), Some(2));
    assert!(error_line(&misplaced).contains("--to delivery"));
}

#[test]
fn the_plan_is_printed_as_a_table_and_as_json() {
    let table = String::from_utf8(dgtr(&["plan", "--budget-mib", "300"]).stdout).unwrap();
    assert!(table.contains("Gaussians") && table.contains("total"), "{table}");
    let json: serde_json::Value =
        serde_json::from_slice(&dgtr(&["plan", "--budget-mib", "300", "--json"]).stdout).unwrap();
    assert!(json["total_bytes"].as_u64().unwrap() <= 300 << 20);
}

#[test]
fn training_improves_on_naive_guesses_and_its_report_says_what_it_took() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let output = dgtr(&[
        "train",
        &path("set"),
        "--out",
        &path("out"),
        "--init",
        "random",
        "--max-gaussians",
        "3000",
        "--steps",
        "150",
        "--budget-mib",
        "64",
        "--seed",
        "5",
    ]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report = job::run_json::RunReport::read(&dir.path().join("out")).unwrap();
    assert_eq!((report.outcome.as_str(), report.steps, report.views), ("done", 150, 10));
    assert!(
        report.memory.device_bytes_peak > 0 && report.memory.device_bytes_peak <= report.memory.device_bytes_planned
    );
    assert!(report.stage_ms.contains_key("train") && report.memory.host_rss_peak > 0);
    assert!(report.more["coverage"]["percent"].is_u64() && dir.path().join("out/coverage.geojson").is_file());
    let save = path("eval");
    let output = dgtr(&["eval", &path("out/model.dgtr"), &path("set"), "--json", "--baselines", "--save", &save]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let answer: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    assert!((number(&answer["psnr"]) - report.psnr.unwrap()).abs() < 1e-9, "train and eval agree");
    assert!(number(&answer["psnr"]) > number(&answer["baselines"]["mean_color"]["psnr"]), "{answer}");
    assert_eq!(answer["views"].as_array().unwrap().len(), 2);
    // The figures are those of the saved pictures.
    let (mut sum, mut n) = (0.0, 0.0);
    for view in answer["views"].as_array().unwrap() {
        let name = view["name"].as_str().unwrap();
        let open = |p: &Path| models::metrics::to_f32(&image::open(p).unwrap().into_rgb8());
        let rendered = open(&dir.path().join("eval").join(name));
        sum += models::metrics::psnr(&rendered, &open(&dir.path().join("set/images").join(name)));
        n += 1.0;
    }
    assert!((sum / n - number(&answer["psnr"])).abs() < 1e-9);
    let frames = path("frames");
    assert!(
        dgtr(&["render", &path("out/model.dgtr"), "--cameras", &path("set/transforms.json"), "--out", &frames])
            .status
            .success()
    );
    let depth = image::open(dir.path().join("frames/00_depth.png")).unwrap();
    assert_eq!(depth.color(), image::ColorType::L16);
}

/// A short training of `set` without held-out figures.
fn short_training(set: &str, out: &str, more: &[&str]) -> job::run_json::RunReport {
    let few = ["--init", "random", "--max-gaussians", "500", "--budget-mib", "64", "--steps", "20", "--no-eval"];
    let output = dgtr(&[&["train", set, "--out", out], &few[..], more].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    job::run_json::RunReport::read(Path::new(out)).unwrap()
}

#[test]
fn the_same_seed_writes_the_same_bytes_and_every_picture_is_decoded_once() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let files = ["a", "b"].map(|out| {
        // A checkpoint wherever one can be leaves no trace.
        let every = if out == "a" { "30" } else { "0.000001" };
        let report = short_training(&path("set"), &path(out), &["--checkpoint-seconds", every]);
        assert_eq!((report.views, &report.more["pictures_decoded"]), (10, &10.into()));
        assert!(report.more["train_seconds"].as_f64().unwrap() > 0.0);
        std::fs::read(dir.path().join(out).join("model.dgtr")).unwrap()
    });
    assert!(files[0] == files[1]);
}

#[test]
fn a_folder_is_thinned_by_the_key_frame_rule_of_a_flight_when_asked() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let settings = path("settings.toml");
    std::fs::write(&settings, "[keyframes]\nt_min_m = 6.0\n").unwrap();
    let report = short_training(&path("set"), &path("out"), &["--keyframes", "--settings", &settings]);
    // Rows of four pictures, 4 m apart, numbers 0 and 8 held out.
    let left_out = report.skipped["pictures_too_close"] + report.skipped["pictures_covered"];
    assert!(report.views < 10 && report.views + left_out == 10, "{report:?}");
    assert_eq!(report.more["pictures_decoded"], report.views);
}

#[test]
fn an_interrupted_training_leaves_a_valid_model_and_the_same_command_continues_it() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let (set, out, file) = (path("set"), path("out"), dir.path().join("out/model.dgtr"));
    let train = |steps: &'static str| {
        let mut c = program();
        c.args(["train", &set, "--out", &out, "--init", "random", "--max-gaussians", "500", "--budget-mib", "64"]);
        c.args(["--steps", steps, "--no-eval"]).stderr(Stdio::piped()).stdout(Stdio::piped());
        c
    };
    let mut child = train("1000000").spawn().unwrap();
    let began = Instant::now();
    // Wait until the first Gaussians are on disc, then let it take some steps.
    while model::read_header(&file).map_or(0, |m| m.1) == 0 && began.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(700));
    let pid = rustix::process::Pid::from_raw(child.id() as i32).unwrap();
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(4));
    let (header, cloud) = model::read(&file).unwrap();
    assert!(!header.finished && header.steps > 0 && !cloud.is_empty(), "{header:?}");
    let goal: &'static str = Box::leak((header.steps + 5).to_string().into_boxed_str());
    let output = train(goal).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let (continued, _) = model::read(&file).unwrap();
    assert!(continued.finished && continued.steps == header.steps + 5, "{} after {}", continued.steps, header.steps);
    // Other pictures in the same folder are not silently replaced.
    let output = dgtr(&["train", &set, "--out", &out, "--split", "all"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(error_line(&output).contains("--fresh"));
}

#[test]
fn a_damaged_cache_of_workgroup_sizes_costs_a_warning_and_not_the_run() {
    if !has_device() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    data_set(&dir.path().join("set"));
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let (set, out) = (path("set"), path("out"));
    let file = dir.path().join("dgtr/kernels.toml");
    std::fs::create_dir_all(dir.path().join("dgtr")).unwrap();
    std::fs::write(&file, "[[device]]\nwide = ").unwrap();
    let few = ["--init", "random", "--max-gaussians", "300", "--budget-mib", "64", "--steps", "3", "--no-eval"];
    let command = &mut program();
    command.env(config::kernels::VARIABLE, "auto").env("XDG_CACHE_HOME", dir.path());
    let output = command.args(["train", &set, "--out", &out]).args(few).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let warnings: Vec<&str> = said.lines().filter(|l| l.contains("WARN")).collect();
    assert!(warnings.len() == 1 && warnings[0].contains("kernels.toml"), "{said}");
}

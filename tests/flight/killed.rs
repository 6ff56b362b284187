//! `kill -9` at random moments: what was promised before is there afterwards, no temporary file stays, and the model in the end is
//! that of a flight nobody killed. The child is this test program once more, with the real session, key frames and checkpoints.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use config::mission::CameraSettings;
use disk::Disk;
use engine::{Reconstruct, model_path};
use glam::{DQuat, DVec3};
use hal::camera::Picture;
use job::session::{Owner, Session};
use models::camera::{Pose, PoseSigma, PosedImage, View};
use vulkan::trainer::RunBudget;

use super::fault_table::ORIGIN;
use super::rehearsal::{Ledger, Promise, intrinsics};
use crate::keyframe_store::KeyFrame;

/// Tells the child where to fly.
const FOLDER: &str = "DGTR_KILLED_FOLDER";
/// Kills in all; set it to 200 for the long run.
const KILLS: &str = "DGTR_KILLS";
const FRAMES: usize = 24;
/// Steps after each key frame.
const STEPS: u64 = 20;
const LENS: CameraSettings = CameraSettings::pinhole(96, 72, 80.0);

fn frame(i: usize) -> KeyFrame {
    let mut pixels = vec![0; (3 * LENS.width * LENS.height) as usize];
    blake3::Hasher::new().update(&i.to_le_bytes()).finalize_xof().fill(&mut pixels);
    let posed = PosedImage {
        name: format!("{i:03}.png"),
        time_ns: i as u64,
        image: image::RgbImage::from_raw(LENS.width, LENS.height, pixels).expect("as many pixels"),
        view: View {
            intrinsics: intrinsics(&LENS),
            pose: Pose { rotation: DQuat::IDENTITY, center: DVec3::new(5.0 * i as f64, 0.0, 40.0) },
        },
        mask: None,
        sigma: PoseSigma { position_m: [1.0; 3], rotation_rad: [0.1; 3] },
    };
    KeyFrame { file: Picture::Rgb(posed.image.clone()), posed }
}

/// Flies to the end in `out`, from wherever an earlier start came to.
fn fly(out: &Path, promised: impl FnMut(Promise) + Send + 'static) {
    let (command, mission, aircraft) = ("fly".into(), "killed".into(), "one".into());
    let owner = Owner { command, mission, aircraft, origin: [0.0; 3], picture: [LENS.width, LENS.height] };
    let disk = Disk::default();
    let _session = Session::begin(&disk, out, &owner).expect("nobody else is here");
    let (mut ledger, mut store) = Ledger::open(&disk, &LENS, ORIGIN, out).expect("opens whatever a kill left");
    ledger.promised = Box::new(promised);
    for i in 0..FRAMES {
        if ledger.keyframes() <= i {
            store.add(&frame(i)).expect("stored");
            ledger.add(frame(i).posed, false).expect("taken in");
        }
        let until = STEPS * (i as u64 + 1);
        if ledger.steps_total() >= until && i + 1 < FRAMES {
            continue;
        }
        ledger.build(&|| false).expect("built");
        while ledger.steps_total() < until {
            let budget = RunBudget { steps: None, seconds: None };
            ledger.train(&budget, &mut |_| ControlFlow::Break(())).expect("trained");
        }
        ledger.checkpoint(out, i + 1 == FRAMES).expect("saved");
    }
}

/// Not a test of its own: what the tests below start and kill.
#[test]
#[ignore = "started by other tests"]
fn child() {
    let Some(out) = std::env::var_os(FOLDER).map(PathBuf::from) else { return };
    fly(&out, |promise| match promise {
        Promise::KeyFrame(name) => println!("promised key frame {name}"),
        Promise::Checkpoint(steps) => println!("promised checkpoint {steps}"),
    });
    println!("promised all");
}

fn start(out: &Path, said: &Path) -> std::process::Child {
    let program = std::env::current_exe().expect("this program");
    let mut command = Command::new(program);
    command.args(["fly::killed::child", "--exact", "--ignored", "--nocapture", "--test-threads=1"]);
    let said = std::fs::File::create(said).expect("a file");
    command.env(FOLDER, out).stdin(Stdio::null()).stdout(said).stderr(Stdio::null()).spawn().expect("starts")
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|e| e.file_name().into_string().ok()).collect()
}

#[test]
fn kill_9_at_random_moments_loses_nothing_promised_leaves_no_file_and_ends_with_the_same_model() {
    let kills: u32 = std::env::var(KILLS).ok().and_then(|n| n.parse().ok()).unwrap_or(20);
    let folder = tempfile::tempdir().expect("folder");
    let (undisturbed, said) = (folder.path().join("undisturbed"), folder.path().join("said"));
    fly(&undisturbed, |_| {});
    let whole = std::fs::read(model_path(&undisturbed)).expect("a model");
    // How long a flight of a process takes that nobody kills: some machines sync in no time. The shortest of a few: of one that a busy
    // machine held up nearly all kills would come after the end.
    let timed = (0..4).map(|i| {
        let begun = Instant::now();
        assert!(start(&folder.path().join(format!("timed-{i}")), &said).wait().expect("ends").success());
        begun.elapsed()
    });
    let flies = timed.min().expect("some");
    let (mut flight, mut killed, mut in_work, mut swept) = (0, 0, 0, 0);
    let (mut key_frames, mut steps): (Vec<String>, u64) = (Vec::new(), 0);
    while killed < kills {
        let out = folder.path().join(format!("flight-{flight}"));
        let mut child = start(&out, &said);
        // Seeded, and anywhere between the start and some time after the end.
        let chance = f64::from(blake3::hash(&killed.to_le_bytes()).as_bytes()[0]) / 255.0;
        std::thread::sleep(flies.mul_f64(1.5 * chance));
        child.kill().expect("killed");
        child.wait().expect("gone");
        killed += 1;
        let text = std::fs::read_to_string(&said).expect("what it said");
        let mut all = false;
        // Only whole lines: the last may have been cut by the kill.
        for line in text.split_inclusive('\n').filter_map(|line| line.strip_suffix('\n')) {
            if let Some((_, name)) = line.split_once("promised key frame ") {
                key_frames.push(name.to_owned());
            } else if let Some((_, n)) = line.split_once("promised checkpoint ") {
                steps = n.parse().expect("a number");
            }
            all |= line.contains("promised all");
        }
        in_work += u32::from(!all && !key_frames.is_empty());
        let folders = [out.clone(), out.join("keyframes"), out.join("keyframes/images")];
        let left = |what: &str| folders.iter().flat_map(|f| names(f)).filter(|n| n.contains(what)).count();
        swept += left(".dgtr-");
        if all {
            assert_eq!(std::fs::read(model_path(&out)).expect("a model"), whole, "flight {flight}");
            assert_eq!((left(".dgtr-"), left(".damaged-")), (0, 0), "flight {flight}");
            (flight, key_frames, steps) = (flight + 1, Vec::new(), 0);
            continue;
        }
        if !out.is_dir() {
            continue;
        }
        // The next start, without flying on.
        let disk = Disk::default();
        disk.sweep(&out);
        let (ledger, _) = Ledger::open(&disk, &LENS, ORIGIN, &out).expect("opens");
        assert_eq!((left(".dgtr-"), left(".damaged-")), (0, 0), "flight {flight} after kill {killed}");
        let lost: Vec<_> = key_frames.iter().filter(|k| !ledger.names().any(|n| n == k.as_str())).collect();
        assert!(lost.is_empty() && ledger.steps_total() >= steps, "lost {lost:?}, {steps} steps promised");
    }
    let out = folder.path().join(format!("flight-{flight}"));
    assert!(start(&out, &said).wait().expect("ends").success());
    assert_eq!(std::fs::read(model_path(&out)).expect("a model"), whole, "the last flight");
    println!("{killed} kills, {in_work} of them in the midst of {} flights, {swept} temporary files swept", flight + 1);
    assert!(in_work > kills / 10, "only {in_work} of {kills} kills met a flight at work");
}

#[test]
fn a_second_process_is_refused_while_the_first_flies() {
    let folder = tempfile::tempdir().expect("folder");
    let (out, said) = (folder.path().join("out"), folder.path().join("said"));
    let (command, mission, aircraft) = ("fly".into(), "killed".into(), "one".into());
    let owner = Owner { command, mission, aircraft, origin: [0.0; 3], picture: [LENS.width, LENS.height] };
    let session = Session::begin(&Disk::default(), &out, &owner).expect("free");
    assert!(!start(&out, &said).wait().expect("ends").success(), "two processes in one folder");
    assert!(!out.join("keyframes").exists());
    drop(session);
    assert!(start(&out, &said).wait().expect("ends").success(), "free again");
}

//! `kill -9` at random moments of the real programs: `dgtr fly` behind a simulated aircraft, `dgtr serve` behind three that
//! deliver. The next start opens whatever was left, no temporary file outlives it, nothing that was promised is lost, and in the
//! end there is a model; on the ground every final model, byte for byte, and the scene that a ground nobody killed merges.
//!
//! A few kills each; `DGTR_KILLS=200` makes it the long run.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

use config::mission::Mission;
use job::run_json::RunReport;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use models::formats::transforms;
use support::{Running, change_mission, free_port, small_mission, wait_until};
use uplink::keys::Identity;
use uplink::{Offerer, Source};

const PATIENCE: Duration = Duration::from_secs(300);
/// Kills of one flight or one session of the ground; then it is left alone to its end.
const KILLS_EACH: u32 = 16;

fn kills() -> u32 {
    std::env::var("DGTR_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(3)
}

/// SplitMix64 (Steele, Lea and Flood 2014): moments from a seed.
struct Moments(u64);

impl Moments {
    fn between(&mut self, least_ms: u64, most_ms: u64) -> Duration {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        Duration::from_millis(least_ms + (z ^ (z >> 31)) % (most_ms - least_ms))
    }
}

/// All files below `folder`.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A process that is killed, and what the kill before it left behind.
struct Victim {
    running: Running,
    started: SystemTime,
    log: PathBuf,
}

impl Victim {
    fn start(at: &Path, arguments: &[&str], log: &str) -> Self {
        let (log, started) = (at.join(log), SystemTime::now());
        Self { running: Running::start(at, arguments, &log), started, log }
    }

    /// Kills it so long after its start, or after it has said something; false when it had come to its end before.
    fn killed(&mut self, words: Option<&str>, wait: Duration) -> bool {
        let (mut said, given_up) = (words.is_none().then(Instant::now), Instant::now() + PATIENCE);
        while said.is_none_or(|at| at.elapsed() < wait) {
            assert!(Instant::now() < given_up, "never said {words:?}: {}", self.said());
            if self.running.0.try_wait().expect("a child").is_some() {
                return false;
            }
            std::thread::sleep(Duration::from_millis(5));
            said = said.or_else(|| words.is_some_and(|w| self.said().contains(w)).then(Instant::now));
        }
        self.running.0.kill().expect("killed");
        self.running.0.wait().expect("gone");
        true
    }

    fn said(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Once it has written anything it has opened its folders: the temporary files there are its own. Nothing was damaged,
    /// ever. Returns whether it got so far, and how many temporary files it left itself.
    fn opened(&self, folders: &[&Path]) -> (bool, usize) {
        let all: Vec<PathBuf> = folders.iter().flat_map(|f| files(f)).collect();
        let damaged: Vec<_> = all.iter().filter(|p| name(p).contains(".damaged-")).collect();
        assert!(damaged.is_empty(), "a kill damages nothing: {damaged:?}\n{}", self.said());
        let written = |p: &PathBuf| p.metadata().and_then(|m| m.modified()).is_ok_and(|at| at > self.started);
        if !all.iter().any(written) {
            return (false, 0);
        }
        let temporary: Vec<String> = all.iter().map(|p| name(p)).filter(|n| n.starts_with(".dgtr-")).collect();
        let own = format!(".dgtr-{}-", self.running.0.id());
        let others: Vec<_> = temporary.iter().filter(|n| !n.starts_with(&own)).collect();
        assert!(others.is_empty(), "left by the start before: {others:?}\n{}", self.said());
        (true, temporary.len())
    }
}

/// The names of the key frames that a flight said it had: they are on disk by then.
fn promised(said: &str) -> impl Iterator<Item = String> + '_ {
    // Only whole lines: the last may have been cut by the kill.
    let lines = said.split_inclusive('\n').filter_map(|line| line.strip_suffix('\n'));
    lines.filter_map(|line| line.split_once("key frame ")?.1.split_once(": ")).map(|(_, name)| stem(name))
}

fn stem(name: &str) -> String {
    Path::new(name).file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// What is there of a flight: every promised key frame with its picture, and the checkpoint, if there ever was one.
fn check_flight(out: &Path, promised: &[String], had_model: &mut bool) {
    if !promised.is_empty() {
        let list = transforms::read(&out.join("keyframes/transforms.json")).expect("a list");
        let kept: Vec<String> = list.shots.iter().map(|s| stem(&s.path)).collect();
        let lost: Vec<_> = promised.iter().filter(|p| !kept.contains(p)).collect();
        assert!(lost.is_empty(), "lost {lost:?}");
        for shot in &list.shots {
            models::picture::decode(&out.join("keyframes").join(&shot.path)).expect("a whole picture");
        }
    }
    let checkpoint = out.join("model.dgtr");
    *had_model |= checkpoint.exists();
    if *had_model {
        model::read(&checkpoint).expect("a whole checkpoint");
    }
}

#[test]
fn a_flight_that_is_killed_again_and_again_loses_nothing_promised_and_ends_with_a_model() {
    let (wanted, mut moments) = (kills(), Moments(1));
    let (mut killed, mut at_work, mut flights, mut temporary) = (0, 0, 0, 0);
    while killed < wanted {
        let dir = tempfile::tempdir().expect("tempdir");
        let at = dir.path();
        small_mission(at);
        change_mission(
            at,
            &[
                ("-20.0", "-12.0"),
                ("20.0]", "12.0]"),
                ("[20.0", "[12.0"),
                ("t_min_m = 6.0", "t_min_m = 2.0"),
                ("seconds = 600.0", "seconds = 1.0"),
                ("device_mib = 96", "device_mib = 96, disk_mib = 1000"),
                ("origin =", "link = { standing_limit_s = 8.0, battery_swap_s = 0.0 }\norigin ="),
            ],
        );
        // Long enough for all kills, and on the ground for as long as it takes: the last start may come after the landing.
        let speed = if wanted > KILLS_EACH { "2" } else { "4" };
        let sim = ["sim", "--mission", "mission.toml", "--link", "pty:port", "--speed", speed, "--linger", "600"];
        let sim = [&sim[..], &["--forward-overlap", "0.9"]].concat();
        let _sim = Running::start(at, &sim, &at.join("sim.log"));
        wait_until("the port", &at.join("sim.log"), PATIENCE, || at.join("port").exists());
        let fly = ["fly", "--mission", "mission.toml", "--out", "out", "--silence", "60"];
        let out = at.join("out");
        let (mut known, mut had_model, mut ended) = (Vec::new(), false, false);
        for n in 0..KILLS_EACH.min(wanted - killed) {
            let mut job = Victim::start(at, &fly, &format!("fly-{n}.log"));
            // While it opens; in flight, once there is enough for a model; then wherever chance has it.
            let (words, most_ms) = match n {
                0 => (None, 2000),
                1 => (Some("key frame 3"), 2000),
                _ if n % 2 == 0 => (Some("listening on"), 4000),
                _ => (None, 5000),
            };
            ended = !job.killed(words, moments.between(50, most_ms));
            if ended {
                break;
            }
            killed += 1;
            let (opened, left) = job.opened(&[&out]);
            known.extend(promised(&job.said()));
            at_work += u32::from(opened);
            temporary += left;
            check_flight(&out, &known, &mut had_model);
        }
        let mut last = Victim::start(at, &fly, "fly-last.log");
        let code = last.running.code(PATIENCE);
        assert_eq!(code, Some(0), "flight {flights}, ended before: {ended}: {}", last.said());
        // The stick is swept with the first offer of a start.
        assert_eq!(last.opened(&[&out, &at.join("upload")]).1, 0, "temporary files after the end");
        known.extend(promised(&last.said()));
        check_flight(&out, &known, &mut had_model);
        let (header, cloud) = model::read(&out.join("model.dgtr")).expect("a model");
        assert!(header.finished && cloud.len() > 500 && header.views.len() >= known_distinct(&known), "{header:?}");
        flights += 1;
    }
    println!(
        "{killed} kills of dgtr fly, {at_work} of them at work, in {flights} flights; {temporary} temporary files left"
    );
    assert!(2 * at_work >= killed, "only {at_work} of {killed} kills met a flight at work");
}

fn known_distinct(names: &[String]) -> usize {
    names.iter().collect::<std::collections::HashSet<_>>().len()
}

const AIRCRAFT: [&str; 3] = ["west", "middle", "east"];
/// Borders of the regions from west to east, metres.
const BORDERS: [f64; 4] = [-60.0, -20.0, 20.0, 60.0];

/// A mission of three aircraft on this machine. What each may send is bounded, so that there is something to interrupt.
fn ground_mission(at: &Path) -> Mission {
    let port = free_port();
    let mut text = format!(
        r#"
name = "park"
origin = {{ lat_deg = 28.0, lon_deg = -82.0, alt_m = 0.0 }}
camera = {{ width = 64, height = 48, fx = 50.0, fy = 50.0, cx = 32.0, cy = 24.0 }}
ground = {{ epochs = 0 }}
[upload]
connect = ["tcp/127.0.0.1:{port}"]
listen = ["tcp/127.0.0.1:{port}"]
max_kib_s = 150
chunk_kib = 16
poll_s = 0.1
retry_min_s = 0.1
retry_max_s = 0.3
checkpoint_s = 0.5
"#
    );
    for (i, id) in AIRCRAFT.iter().enumerate() {
        let (w, e) = (BORDERS[i], BORDERS[i + 1]);
        text += &format!(
            "[[aircraft]]\nid = \"{id}\"\nlink = \"udpin:127.0.0.1:{}\"\ncamera = {{ folder = \"{id}\" }}\n\
             region_enu = [[{w:.1}, -20.0], [{e:.1}, -20.0], [{e:.1}, 20.0], [{w:.1}, 20.0]]\n",
            14550 + i
        );
    }
    std::fs::write(at.join("mission.toml"), &text).expect("written");
    Mission::parse(&text, at).expect("a mission")
}

/// A carpet of Gaussians over an aircraft's region and ten metres beyond; no two stages share a chunk.
fn local_model(at: &Path, number: usize, stage: f32) -> PathBuf {
    let (west, east) = (BORDERS[number] - 10.0, BORDERS[number + 1] + 10.0);
    let mut cloud = GaussianCloud::with_capacity(0, 4800);
    let (columns, rows) = (120, 40);
    for i in 0..columns * rows {
        let x = west + (east - west) * (f64::from(i % columns) + 0.5) / f64::from(columns);
        let y = f64::from(i / columns) - 19.5;
        let shade = [(0.5 * x).sin() as f32 + stage, (0.4 * y).cos() as f32, (0.2 * (x + y)).sin() as f32];
        cloud.push(
            [x as f32, y as f32, 0.0],
            [-1.0 + 0.001 * stage, -1.0, -4.0],
            [1.0, 0.001 * stage, 0.0, 0.0],
            3.0,
            &shade,
        );
    }
    let header = ModelHeader { mission: "park".into(), aircraft: AIRCRAFT[number].into(), ..ModelHeader::default() };
    let path = at.join(format!("{}-{stage}.dgtr", AIRCRAFT[number]));
    model::write(&path, &header, &cloud).expect("written");
    path
}

/// Offers a checkpoint and soon the final model, as an aircraft does.
struct Aircraft {
    offerer: Offerer,
    received: PathBuf,
    checkpoint: PathBuf,
    last: PathBuf,
}

impl Aircraft {
    fn fly(at: &Path, mission: &Mission, number: usize) -> Self {
        let aircraft = AIRCRAFT[number].to_owned();
        let received = at.join("out/received").join(&aircraft).join("model.dgtr");
        let flight_number = Some(at.join(format!("{aircraft}.flight")));
        let (mission_name, disk) = (mission.name.clone(), Default::default());
        let source = Source {
            mission: mission_name,
            aircraft,
            identity: Identity::unsigned(),
            flight_number,
            session: None,
            disk,
            territory: None,
        };
        let offerer = Offerer::start(&mission.upload, source).expect("offerer");
        let [checkpoint, last] = [1.0, 2.0].map(|stage| local_model(at, number, stage));
        offerer.offer(&checkpoint);
        Self { offerer, received, checkpoint, last }
    }

    fn land(&self) {
        self.offerer.offer_final(&self.last);
    }

    /// What the ground has signed for is there, whole.
    fn check(&self, out: &Path) {
        if self.offerer.status().delivered {
            let lost = |e| panic!("{} was promised: {e}; there are {:#?}", self.received.display(), files(out));
            let here = std::fs::read(&self.received).unwrap_or_else(lost);
            let offered = [&self.checkpoint, &self.last].map(|path| std::fs::read(path).expect("offered"));
            assert!(offered.contains(&here), "not what was offered");
        }
    }
}

/// Whether the session has written its report: the next start would begin another one.
fn is_over(out: &Path) -> bool {
    RunReport::read(out).is_ok_and(|r| r.outcome == "done")
}

/// What a ground ends with, as often as it is killed: its models and the merged one.
fn ground(at: &Path, mission: &Mission, tally: &mut Tally, moments: &mut Moments, kills: u32) -> Vec<Vec<u8>> {
    let aircraft: Vec<Aircraft> = (0..AIRCRAFT.len()).map(|n| Aircraft::fly(at, mission, n)).collect();
    let (out, serve) = (at.join("out"), ["serve", "--mission", "mission.toml", "--out", "out"]);
    let landing = Instant::now() + Duration::from_secs(2);
    let mut landed = false;
    for n in 0..kills {
        let mut job = Victim::start(at, &serve, &format!("serve-{n}.log"));
        let alive = job.killed(None, moments.between(50, 3000));
        if !landed && Instant::now() > landing {
            aircraft.iter().for_each(Aircraft::land);
            landed = true;
        }
        if alive {
            let (opened, left) = job.opened(&[&out]);
            tally.killed += 1;
            tally.at_work += u32::from(opened);
            tally.temporary += left;
        } else {
            assert_eq!(job.running.code(PATIENCE), Some(0), "{}", job.said());
        }
        aircraft.iter().for_each(|a| a.check(&out));
        if is_over(&out) {
            break;
        }
    }
    if !landed {
        aircraft.iter().for_each(Aircraft::land);
    }
    if !is_over(&out) {
        let mut last = Victim::start(at, &serve, "serve-last.log");
        assert_eq!(last.running.code(PATIENCE), Some(0), "{}", last.said());
        assert_eq!(last.opened(&[&out]).1, 0, "temporary files after the end");
    }
    for a in &aircraft {
        assert!(a.offerer.wait_delivered(PATIENCE, || false), "{} was not told", a.received.display());
        assert!(std::fs::read(&a.received).expect("a model") == std::fs::read(&a.last).expect("offered"));
        let chunks = a.received.with_file_name("chunk");
        assert_eq!(files(&chunks).len(), 0, "{}", chunks.display());
    }
    let kept = aircraft.iter().map(|a| a.received.clone()).chain([out.join("global.dgtr")]);
    let kept = kept.map(|path| std::fs::read(path).expect("there")).collect();
    aircraft.into_iter().for_each(|a| a.offerer.shutdown());
    kept
}

#[derive(Default)]
struct Tally {
    killed: u32,
    at_work: u32,
    temporary: usize,
}

#[test]
fn a_ground_that_is_killed_again_and_again_ends_with_every_final_model_and_the_same_scene() {
    let (wanted, mut moments, mut tally) = (kills(), Moments(2), Tally::default());
    let session = |tally: &mut Tally, moments: &mut Moments, kills| {
        let dir = tempfile::tempdir().expect("tempdir");
        ground(dir.path(), &ground_mission(dir.path()), tally, moments, kills)
    };
    let undisturbed = session(&mut Tally::default(), &mut moments, 0);
    let mut sessions = 0;
    while tally.killed < wanted {
        let most = KILLS_EACH.min(wanted - tally.killed);
        let kept = session(&mut tally, &mut moments, most);
        assert!(kept == undisturbed, "session {sessions} ended with something else");
        sessions += 1;
    }
    let Tally { killed, at_work, temporary } = tally;
    println!(
        "{killed} kills of dgtr serve, {at_work} of them at work, in {sessions} sessions; {temporary} temporary files left"
    );
    assert!(2 * at_work >= killed, "only {at_work} of {killed} kills met a ground at work");
}

//! One of three aircraft stops on the way: what it left is dealt to the others, who fly again, and the ground merges what all of them
//! brought, the failed one's checkpoint too. Everything is the real program, training included; only vehicles and cameras are simulated.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::collections::HashSet;
use std::path::Path;
use std::time::Duration;

use config::mission::Mission;
use glam::DVec2;
use job::run_json::RunReport;
use models::formats::model;
use support::{Running, free_port, run, wait_until};
use survey::coverage::{CoverageMap, CoverageRegion};

const PATIENCE: Duration = Duration::from_secs(120);
/// 120 m by 78 m.
const FIELD: &str =
    r#"{"type":"Polygon","coordinates":[[[8.5,47.4],[8.5016,47.4],[8.5016,47.4007],[8.5,47.4007],[8.5,47.4]]]}"#;
/// Simulated seconds per second.
const SPEED: &str = "6";
/// Side of the squares in each of which the merged model has a Gaussian, metres.
const SIDE_M: f64 = 4.0;

/// The survey's mission with the least training, and a network on this machine.
fn small(at: &Path) {
    let planned = std::fs::read_to_string(at.join("plan/mission.toml")).expect("a mission");
    let port = free_port();
    let mut text = planned;
    for (table, more) in [
        ("[memory]", "device_mib = 96\nhost_mib = 1024\nmax_gaussians = 20000\nview_slots = 4"),
        ("[keyframes]", "t_min_m = 2.0\nmax = 160"),
        ("[training]", "steps = 60\nseconds = 4.0"),
        ("[link]", "battery_swap_s = 0.0"),
        ("[ground]", "epochs = 0\nregister = false\nsilence_s = 6.0"),
        (
            "[upload]",
            &format!(
                "connect = [\"tcp/127.0.0.1:{port}\"]\nlisten = [\"tcp/127.0.0.1:{port}\"]\npoll_s = 0.2\nretry_min_s = 0.1\n\
                 retry_max_s = 0.5\ncheckpoint_s = 1.0"
            ),
        ),
    ] {
        match text.contains(&format!("\n{table}\n")) {
            true => text = text.replace(&format!("\n{table}\n"), &format!("\n{table}\n{more}\n")),
            false => text = text.replacen("\n[[aircraft]]", &format!("\n{table}\n{more}\n\n[[aircraft]]"), 1),
        }
    }
    std::fs::write(at.join("mission.toml"), text).expect("written");
}

/// An aircraft in the air: its vehicle with the camera, and the job beside them.
struct Craft {
    id: &'static str,
    _sim: Running,
    job: Running,
    log: std::path::PathBuf,
}

impl Craft {
    fn start(at: &Path, id: &'static str, plans: &str, flight: u32) -> Self {
        let port = format!("{id}/port{flight}");
        let log = at.join(format!("{id}-{flight}.log"));
        std::fs::create_dir_all(at.join(id)).expect("a folder");
        let (plan, link) = (format!("{plans}/{id}.plan"), format!("pty:{port}"));
        let sim =
            ["sim", "--mission", "mission.toml", "--aircraft", id, "--link", &link, "--plan", &plan, "--speed", SPEED];
        let sim_log = at.join(format!("{id}-{flight}-sim.log"));
        let sim = Running::start(at, &[&sim[..], &["--linger", "1"]].concat(), &sim_log);
        wait_until("the port", &sim_log, PATIENCE, || at.join(&port).exists());
        let (link, out) = (format!("serial:{port}:921600"), format!("{id}/out"));
        let fly =
            ["fly", "--mission", "mission.toml", "--aircraft", id, "--link", &link, "--out", &out, "--silence", "6"];
        Self { id, _sim: sim, job: Running::start(at, &fly, &log), log }
    }

    fn says(&self, words: &str) -> bool {
        std::fs::read_to_string(&self.log).is_ok_and(|said| said.contains(words))
    }

    fn lands(mut self) {
        let code = self.job.code(PATIENCE);
        assert_eq!(code, Some(0), "{}: {}", self.id, std::fs::read_to_string(&self.log).unwrap_or_default());
    }
}

fn serve(at: &Path, log: &str) -> Running {
    let log = at.join(log);
    let ground = Running::start(at, &["serve", "--mission", "mission.toml", "--out", "ground"], &log);
    wait_until("the ground", &log, PATIENCE, || at.join("ground/mission.toml").exists());
    ground
}

fn regions(mission: &Mission) -> Vec<Vec<DVec2>> {
    mission.aircraft.iter().map(|a| mission.region(a).into_iter().map(DVec2::from).collect()).collect()
}

/// Of these regions the share that the views of a model cover, and the share whose squares hold one of its Gaussians.
fn whole(model: &Path, mission: &Mission, regions: &[Vec<DVec2>]) -> (f64, f64, HashSet<String>) {
    let (header, cloud) = model::read(model).expect("a model");
    let square = |p: DVec2| (p / SIDE_M).floor().as_ivec2();
    let held: HashSet<_> = cloud.means.iter().map(|[x, y, _]| square(DVec2::new((*x).into(), (*y).into()))).collect();
    let (mut all, mut covered, mut squares, mut full) = (0.0, 0.0, 0usize, 0usize);
    for region in regions {
        let ground = CoverageRegion::new(region.clone()).expect("a region");
        let mut map = CoverageMap::new(&ground, 0.0, mission.coverage).expect("a map");
        header.views.iter().for_each(|(_, view)| map.add(view));
        let area = geometry::polygon::signed_area(region).abs();
        (all, covered) = (all + area, covered + area * map.covered_share());
        let (low, high) = region.iter().fold((DVec2::MAX, DVec2::MIN), |(l, h), p| (l.min(*p), h.max(*p)));
        let (low, high) = (square(low), square(high));
        for at in (low.x..=high.x).flat_map(|x| (low.y..=high.y).map(move |y| glam::IVec2::new(x, y))) {
            if geometry::polygon::contains(region, (at.as_dvec2() + 0.5) * SIDE_M) {
                (squares, full) = (squares + 1, full + usize::from(held.contains(&at)));
            }
        }
    }
    let names = header.views.into_iter().map(|(name, _)| name).collect();
    (covered / all, full as f64 / squares as f64, names)
}

#[test]
fn what_one_of_three_left_is_flown_by_the_others_and_the_merged_model_is_complete() {
    let dir = tempfile::tempdir().expect("tempdir");
    let at = dir.path();
    std::fs::write(at.join("field.geojson"), FIELD).expect("written");
    let survey =
        ["survey", "field.geojson", "--aircraft", "3", "--picture", "192x144", "--fov-deg", "60", "--gsd", "25"];
    let survey = [&survey[..], &["--home-height", "430", "--endurance", "40", "--out", "plan"]].concat();
    let planned = run(at, &survey);
    assert!(planned.status.success(), "{}", String::from_utf8_lossy(&planned.stderr));
    small(at);
    let before = Mission::read(&at.join("mission.toml")).expect("a mission");

    let mut ground = serve(at, "ground-1.log");
    let [a1, mut a2, a3] = ["a1", "a2", "a3"].map(|id| Craft::start(at, id, "plan", 1));
    // On the way, when the ground has something of it, its battery falls out.
    let here = at.join("ground/received/a2/model.dgtr");
    wait_until("part of the second flight", &a2.log, PATIENCE, || a2.says("key frame 6:") && here.is_file());
    a2.job.0.kill().expect("killed");
    drop(a2);
    a1.lands();
    a3.lands();
    let log = at.join("ground-1.log");
    let said = || std::fs::read_to_string(&log).unwrap_or_default();
    wait_until("the silence being noticed", &log, PATIENCE, || said().contains("a2 has not been heard of for"));
    let here = |id: &str| said().contains(&format!("received {id}'s final model"));
    wait_until("the others' models", &log, PATIENCE, || here("a1") && here("a3"));
    ground.interrupt();
    assert_eq!(ground.code(PATIENCE), Some(4), "{}", said());
    let (first, ..) = whole(&at.join("ground/global.dgtr"), &before, &regions(&before));
    assert!((0.5..0.97).contains(&first), "{first} was covered");

    let after = run(at, &["survey", "--after", "ground"]);
    let told = String::from_utf8_lossy(&after.stdout).into_owned();
    assert!(after.status.success() && told.contains("what a2 left is dealt to the others"), "{told}{after:?}");
    std::fs::copy(at.join("ground-after-1/mission.toml"), at.join("mission.toml")).expect("copied");
    let now = Mission::read(&at.join("mission.toml")).expect("a mission");
    assert_eq!(now.lost(), ["a2"]);
    let mut ground = serve(at, "ground-2.log");
    let again = ["a1", "a3"].map(|id| Craft::start(at, id, "ground-after-1", 2));
    again.into_iter().for_each(Craft::lands);
    let code = ground.code(PATIENCE);
    let said = std::fs::read_to_string(at.join("ground-2.log")).unwrap_or_default();
    assert_eq!(code, Some(0), "{said}");
    let run = RunReport::read(&at.join("ground")).expect("run.json");
    assert_eq!((run.outcome.as_str(), &run.more["missing"]), ("done", &serde_json::json!([])), "{said}");
    let (covered, full, names) = whole(&at.join("ground/global.dgtr"), &now, &regions(&before));
    println!(
        "covered {:.1} %, and {:.2} % in the end, {:.2} % of the squares are full",
        100.0 * first,
        100.0 * covered,
        100.0 * full
    );
    assert!(covered >= 0.98 && full >= 0.98, "{covered} covered, {full} full:\n{said}");
    // Every view of every aircraft's model took part.
    let each: Vec<_> = ["a1", "a2", "a3"].map(|id| at.join(format!("ground/received/{id}/model.dgtr"))).into();
    let views: usize = each.iter().map(|path| model::read_header(path).expect("a model").0.views.len()).sum();
    assert_eq!(names.len(), views, "{said}");
    for (id, flights) in [("a1", 2), ("a2", 1), ("a3", 2)] {
        assert!(names.iter().any(|name| name.contains(&format!("{id}_"))), "{id} of {flights} flights: {names:?}");
    }
}

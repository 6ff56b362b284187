//! What the ground knows of every aircraft, on the live page: what is under way, and what the models that are here say.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};

use config::mission::Mission;
use models::formats::model::{self, ModelHeader};
use pages::report::Thumbnail;
use pages::report::ground::Shot;
use pages::watch::Watch;
use survey::coverage::{CoverageMap, CoverageRegion};

use super::watchdog::{COVERED_PCT, Watchdog};
use super::{Progress, Received};

/// What is said of an aircraft that nobody has heard of.
const NOTHING: &str = "nothing has arrived yet";

/// Which file was looked at last.
type Seen = Option<(SystemTime, u64)>;

/// Keeps the page up to date.
pub struct Board<'a> {
    mission: &'a Mission,
    out: PathBuf,
    watch: Watch,
    seen: Vec<Seen>,
    /// Whose last model leaves ground.
    short: Vec<bool>,
    /// When what is under way began to come, and how many of its chunks were here.
    under_way: Vec<Option<(Instant, usize)>>,
    started: Instant,
    told: Option<(usize, usize)>,
    watchdog: Watchdog,
    /// Percent of each region that the newest model covers.
    covered: Vec<Option<u32>>,
}

impl<'a> Board<'a> {
    /// A page on which no aircraft has been heard of.
    pub fn new(mission: &'a Mission, out: &Path) -> Self {
        let ids: Vec<&str> = mission.aircraft.iter().map(|a| a.id.as_str()).collect();
        let watch = Watch::of(mission, &ids, NOTHING, out);
        watch.update(|page| {
            page.title = format!("Mission {}: ground", mission.name);
            for craft in &mut page.aircraft {
                craft.plot.axes = ["seconds", "steps of the models that arrived"];
                // No picture comes to the ground: its room, times all aircraft, is given back.
                craft.thumbnail = Thumbnail::default();
            }
        });
        Self {
            mission,
            out: out.to_owned(),
            watch,
            seen: vec![None; ids.len()],
            short: vec![false; ids.len()],
            under_way: vec![None; ids.len()],
            started: Instant::now(),
            told: None,
            watchdog: Watchdog::new(mission, out),
            covered: vec![None; ids.len()],
        }
    }

    /// What is shown.
    pub fn watch(&self) -> &Watch {
        &self.watch
    }

    /// Everybody's state while the ground works on what is here.
    pub fn say(&self, words: &'static str) {
        self.watch.update(|page| page.subtitle = words.to_owned());
    }

    /// Notes a round of reception.
    pub fn round(&mut self, progress: &Progress) {
        if self.told.replace((progress.finished, progress.aircraft)) != self.told {
            let words = format!("{} of {} final models are here", progress.finished, progress.aircraft);
            self.watch.update(|page| page.subtitle = words);
        }
        let here: HashMap<&str, &Received> = progress.received.iter().map(|r| (r.aircraft.as_str(), r)).collect();
        let transfers = progress.transfers.iter().map(|t| (t.0.as_str(), (t.1, t.2)));
        let transfers: HashMap<&str, (usize, usize)> = transfers.collect();
        for (i, aircraft) in self.mission.aircraft.iter().enumerate() {
            let here = here.get(aircraft.id.as_str()).copied();
            let under_way = transfers.get(aircraft.id.as_str()).copied();
            let left_s = self.left_s(i, under_way);
            if let Some(received) = here {
                self.look(i, received);
            }
            let heard = progress.last_heard.get(i).copied().unwrap_or_default();
            let finished = here.is_some_and(|r| r.finished);
            for line in self.watchdog.look(i, &heard, finished, self.covered[i], Instant::now()) {
                // The log's warnings stand on the page and in the report, too.
                tracing::warn!("{line}");
            }
            let (short, trouble) = (self.short[i], self.watchdog.state(i));
            self.watch.craft(i, |craft| {
                craft.battery = heard.condition.and_then(|condition| condition.battery_pct).or(craft.battery);
                (craft.chunks, craft.schedule.left_s) = (under_way, left_s);
                craft.bytes = here.map(|r| r.size);
                craft.schedule.progress = under_way.map(|(n, of)| n as f32 / of.max(1) as f32);
                craft.link = if under_way.is_some() { "receiving" } else { "idle" };
                craft.state = match (here, under_way) {
                    (Some(r), None) if r.finished && short => "final model is here, ground was left",
                    (Some(r), None) if r.finished => "final model is here",
                    (_, Some(_)) => "sending a model",
                    (Some(_), None) => "checkpoint is here, still flying or training",
                    (None, None) if heard.ago.is_some() => "no model is here yet",
                    (None, None) => NOTHING,
                };
                craft.state = trouble.unwrap_or(craft.state);
            });
        }
    }

    /// Seconds until a model is here, by the pace of its chunks so far.
    fn left_s(&mut self, i: usize, under_way: Option<(usize, usize)>) -> Option<f64> {
        let Some((here, of)) = under_way else {
            self.under_way[i] = None;
            return None;
        };
        let (since, before) = *self.under_way[i].get_or_insert((Instant::now(), here));
        let came = here.saturating_sub(before);
        (came > 0).then(|| since.elapsed().as_secs_f64() * of.saturating_sub(here) as f64 / came as f64)
    }

    /// Reads what a model says of itself, once.
    fn look(&mut self, i: usize, received: &Received) {
        let file = std::fs::metadata(&received.path);
        let Ok(changed) = file.and_then(|f| f.modified()).map(|at| (at, received.size)) else { return };
        if self.seen[i].replace(changed) == Some(changed) {
            return;
        }
        // One that cannot be read is refused where it counts.
        if let Ok((header, gaussians)) = model::read_header(&received.path) {
            let covered_pct = self.show(i, &header, gaussians as u64);
            self.covered[i] = covered_pct.filter(|_| !header.views.is_empty());
            // Nothing more comes after the last model: whoever deals with it should know now, while the others still fly. One without
            // views does not say what it covers.
            let last = covered_pct.filter(|_| received.finished && !header.views.is_empty());
            let short = last.and_then(|percent| self.left_ground(i, percent));
            self.short[i] = short.is_some();
            if let Some(line) = short {
                tracing::warn!("{line}");
            }
        }
    }

    /// What to say of an aircraft whose last model covers so much of its region.
    fn left_ground(&self, i: usize, covered_pct: u32) -> Option<String> {
        let id = &self.mission.aircraft[i].id;
        let deal = match self.mission.aircraft.len() {
            1 => String::new(),
            _ => format!("; `dgtr survey --after {} --without {id}` deals the rest to the others", self.out.display()),
        };
        let line = || format!("{id} left ground: its final model covers {covered_pct} % of its region{deal}");
        (covered_pct < COVERED_PCT).then(line)
    }

    /// Shows a model; percent of its region that it covers.
    fn show(&self, i: usize, header: &ModelHeader, gaussians: u64) -> Option<u32> {
        let region = self.mission.region(&self.mission.aircraft[i]);
        let rules = self.mission.coverage;
        // Where the aircraft took off the ground does not know.
        let ground_m = rules.ground_m.map_or(0.0, f64::from);
        let map = CoverageRegion::new(region.into_iter().map(Into::into).collect())
            .and_then(|region| CoverageMap::new(&region, ground_m, rules))
            .map(|mut map| {
                header.views.iter().for_each(|(_, view)| map.add(view));
                map
            });
        let elapsed_s = self.started.elapsed().as_secs_f64();
        let mut covered_pct = None;
        self.watch.update(|page| {
            page.ground.forget(i);
            header.views.iter().for_each(|(_, view)| page.ground.add(Shot::of(i, view, ground_m)));
            covered_pct = map.ok().map(|map| (100.0 * page.ground.survey(i, &map)) as u32);
            let Some(craft) = page.aircraft.get_mut(i) else { return };
            craft.covered = covered_pct;
            craft.key_frames = Some(header.views.len() as u64);
            (craft.gaussians, craft.schedule.steps) = (Some(gaussians), Some(header.steps));
            craft.plot.curve.push(elapsed_s, header.steps as f64);
        });
        covered_pct
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use uplink::heartbeat::Condition;
    use uplink::receive::LastHeard;

    use super::super::tests::mission;
    use super::*;
    use crate::testing::{carpet, model, nadir};

    /// Of an aircraft whose pictures were taken from `low` to `high`, every four metres.
    fn received(folder: &Path, id: &str, [low, high]: [[i32; 2]; 2], finished: bool) -> Received {
        let local = model(id, &[], carpet([-40.0, -20.0], [40.0, 20.0], 1.0));
        let middles = (low[0]..high[0]).step_by(4).flat_map(|x| (low[1]..high[1]).step_by(4).map(move |y| [x, y]));
        let view = |[x, y]: [i32; 2]| (format!("{x},{y}.jpg"), nadir(f64::from(x) + 2.0, f64::from(y) + 2.0, 30.0));
        let header = ModelHeader { views: middles.map(view).collect(), finished, ..local.header };
        let path = folder.join(format!("{id}.dgtr"));
        model::write(&path, &header, &local.cloud).expect("write");
        let size = std::fs::metadata(&path).expect("metadata").len();
        Received { aircraft: id.into(), path, finished, size, bound: true }
    }

    #[test]
    fn who_left_ground_is_told_when_the_last_model_is_here_and_not_before() {
        let folder = tempfile::tempdir().expect("temp dir");
        let mission = mission(folder.path());
        let out = folder.path().join("out");
        let mut board = Board::new(&mission, &out);
        let mut states = |models: Vec<Received>| {
            board.round(&Progress {
                finished: 0,
                aircraft: 2,
                transfers: Vec::new(),
                bytes: 0,
                received: models,
                last_heard: Vec::new(),
            });
            board.watch().freeze().aircraft.iter().map(|craft| craft.state).collect::<Vec<_>>()
        };
        let whole = received(folder.path(), "east", [[0, -20], [40, 20]], true);
        let half = |finished| received(folder.path(), "west", [[-40, -20], [-32, 20]], finished);
        let flying = "checkpoint is here, still flying or training";
        assert_eq!(states(vec![half(false), whole.clone()]), [flying, "final model is here"]);
        assert_eq!(states(vec![half(true), whole]), ["final model is here, ground was left", "final model is here"]);
        let line = board.left_ground(0, 52).expect("a line");
        assert!(line.starts_with("west left ground: its final model covers 52 % of its region"), "{line}");
        assert!(line.contains(&format!("`dgtr survey --after {} --without west`", out.display())), "{line}");
        assert_eq!(board.left_ground(0, COVERED_PCT), None);
    }

    #[test]
    fn an_aircraft_that_falls_silent_is_shown_as_that_while_the_others_fly_and_as_before_when_it_is_back() {
        let folder = tempfile::tempdir().expect("temp dir");
        let mission = mission(folder.path());
        let mut board = Board::new(&mission, &folder.path().join("out"));
        let half = received(folder.path(), "west", [[-40, -20], [-32, 20]], false);
        let mut state = |ago_s: u64| {
            let heard =
                |ago_s| LastHeard { ago: Some(Duration::from_secs(ago_s)), condition: Some(Condition::default()) };
            let last_heard = vec![heard(ago_s), heard(1)];
            let (transfers, received) = (Vec::new(), vec![half.clone()]);
            board.round(&Progress { finished: 0, aircraft: 2, transfers, bytes: 0, received, last_heard });
            board.watch().freeze().aircraft.iter().map(|craft| craft.state).collect::<Vec<_>>()
        };
        let flying = ["checkpoint is here, still flying or training", "no model is here yet"];
        assert_eq!(state(2), flying);
        assert_eq!(state(61), ["silent", "no model is here yet"]);
        assert_eq!(state(1), flying);
    }
}

//! What the ground knows of every aircraft, on the live page: what is under way, and what the models that are here say.

use std::collections::HashMap;
use std::path::Path;
use std::time::{Instant, SystemTime};

use config::mission::Mission;
use models::formats::model::{self, ModelHeader};
use pages::report::Thumbnail;
use pages::report::ground::Shot;
use pages::watch::Watch;
use survey::coverage::{CoverageMap, CoverageRegion};

use super::{Progress, Received};

/// Which file was looked at last.
type Seen = Option<(SystemTime, u64)>;

/// Keeps the page up to date.
pub struct Board<'a> {
    mission: &'a Mission,
    watch: Watch,
    seen: Vec<Seen>,
    /// When what is under way began to come, and how many of its chunks were here.
    under_way: Vec<Option<(Instant, usize)>>,
    started: Instant,
    told: Option<(usize, usize)>,
}

impl<'a> Board<'a> {
    /// A page on which no aircraft has been heard of.
    pub fn new(mission: &'a Mission, out: &Path) -> Self {
        let ids: Vec<&str> = mission.aircraft.iter().map(|a| a.id.as_str()).collect();
        let watch = Watch::of(mission, &ids, "nothing has arrived yet", out);
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
            watch,
            seen: vec![None; ids.len()],
            under_way: vec![None; ids.len()],
            started: Instant::now(),
            told: None,
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
            self.watch.craft(i, |craft| {
                (craft.chunks, craft.schedule.left_s) = (under_way, left_s);
                craft.bytes = here.map(|r| r.size);
                craft.schedule.progress = under_way.map(|(n, of)| n as f32 / of.max(1) as f32);
                craft.link = if under_way.is_some() { "receiving" } else { "idle" };
                craft.state = match (here, under_way) {
                    (Some(r), None) if r.finished => "final model is here",
                    (_, Some(_)) => "sending a model",
                    (Some(_), None) => "checkpoint is here, still flying or training",
                    (None, None) => craft.state,
                };
            });
            if let Some(received) = here {
                self.look(i, received);
            }
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
            self.show(i, &header, gaussians as u64);
        }
    }

    fn show(&self, i: usize, header: &ModelHeader, gaussians: u64) {
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
        self.watch.update(|page| {
            page.ground.forget(i);
            header.views.iter().for_each(|(_, view)| page.ground.add(Shot::of(i, view, ground_m)));
            let covered = map.ok().map(|map| page.ground.survey(i, &map));
            let Some(craft) = page.aircraft.get_mut(i) else { return };
            craft.covered = covered.map(|share| (100.0 * share) as u32);
            craft.key_frames = Some(header.views.len() as u64);
            (craft.gaussians, craft.schedule.steps) = (Some(gaussians), Some(header.steps));
            craft.plot.curve.push(elapsed_s, header.steps as f64);
        });
    }
}

//! A mission whose ground was dealt anew because an aircraft failed: which of the models that are here already count as the last.
//!
//! Whoever does not fly any more has said all it has to say, a checkpoint too. A final model of another region is of the flight before:
//! its aircraft goes on from there, and brings one of both flights.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use config::mission::Mission;
use disk::Disk;
use models::formats::FormatError;
use models::formats::model;
use uplink::receive::Received;

use super::RECEIVED;

/// Corners nearer to each other are one, metres.
const SAME_M: f64 = 0.01;
/// What a folder of the ground holds of one aircraft: the model, and what vouches for it.
const OF_AN_AIRCRAFT: [&str; 2] = ["model.dgtr", "offer"];

/// Judges the models of a mission that was dealt anew.
pub(super) struct Redealt<'a> {
    mission: &'a Mission,
    lost: &'a [String],
    /// Whether the final model of this file, written then, is of the region that its aircraft has now.
    known: HashMap<PathBuf, (SystemTime, bool)>,
    has_told: bool,
}

impl<'a> Redealt<'a> {
    /// Of `mission`; one that was dealt once leaves everything as its aircraft say.
    pub(super) fn new(mission: &'a Mission) -> Self {
        Self { mission, lost: mission.lost(), known: HashMap::new(), has_told: false }
    }

    /// Whether this aircraft does not fly any more.
    pub(super) fn is_lost(&self, id: &str) -> bool {
        self.lost.iter().any(|lost| lost == id)
    }

    /// The models with whether more will follow, as it is since the mission was dealt anew.
    pub(super) fn judged(&mut self, mut received: Vec<Received>) -> Vec<Received> {
        if self.lost.is_empty() {
            return received;
        }
        for model in &mut received {
            model.finished = self.is_lost(&model.aircraft) || model.finished && self.is_of_this_dealing(model);
        }
        received
    }

    /// Who does not fly any more and is awaited all the same, since nothing of it is here: what is to be said of each, once.
    pub(super) fn awaited(&mut self, received: &[Received]) -> Vec<String> {
        if std::mem::replace(&mut self.has_told, true) {
            return Vec::new();
        }
        let is_missing = |id: &&String| received.iter().all(|r| r.aircraft != **id);
        let line = |id: &String| {
            format!(
                "{id} does not fly any more ([survey] lost), and no model of it is here; give the --out of its flight's ground, bring its \
                 stick, or take it out of the mission"
            )
        };
        self.lost.iter().filter(is_missing).map(line).collect()
    }

    fn is_of_this_dealing(&mut self, received: &Received) -> bool {
        let Ok(written) = std::fs::metadata(&received.path).and_then(|file| file.modified()) else { return true };
        if let Some((_, is)) = self.known.get(&received.path).filter(|(at, _)| *at == written) {
            return *is;
        }
        let own = self.mission.aircraft(Some(&received.aircraft)).map(|aircraft| self.mission.region(aircraft));
        let is = match (own, model::read_header(&received.path)) {
            // A model made by hand names no region, and one that cannot be read is refused where it counts.
            (Ok(own), Ok((header, _))) => header.region.is_empty() || is_same(&own, &header.region),
            _ => true,
        };
        self.known.insert(received.path.clone(), (written, is));
        is
    }
}

fn is_same(a: &[[f64; 2]], b: &[[f64; 2]]) -> bool {
    let near = |(p, q): (&[f64; 2], &[f64; 2])| (p[0] - q[0]).abs() < SAME_M && (p[1] - q[1]).abs() < SAME_M;
    a.len() == b.len() && a.iter().zip(b).all(near)
}

/// Brings the models of an earlier session, whose files lie in `earlier`, into `out`, where `mission` deals anew what that one flew: those
/// who do not fly any more bring nothing again. What is in `out` already stays. Returns whose models were brought.
///
/// # Errors
/// The disk.
pub fn carry(mission: &Mission, earlier: &Path, out: &Path) -> Result<Vec<String>, FormatError> {
    if mission.lost().is_empty() || !Mission::read(&earlier.join(super::MISSION)).is_ok_and(|m| deals(mission, &m)) {
        return Ok(Vec::new());
    }
    let (disk, mut carried) = (Disk::default(), Vec::new());
    for aircraft in &mission.aircraft {
        let [from, to] = [earlier, out].map(|folder| folder.join(RECEIVED).join(&aircraft.id));
        let lacks = |folder: &Path| OF_AN_AIRCRAFT.iter().any(|name| !folder.join(name).is_file());
        if lacks(&from) || !lacks(&to) {
            continue;
        }
        disk.make_folders(&to).map_err(|e| FormatError::io(&to, "making the folder", e))?;
        for name in OF_AN_AIRCRAFT {
            let (from, to) = (from.join(name), to.join(name));
            let mut file = disk::regular::open_not_linked(&from).map_err(|e| FormatError::io(&from, "opening", e))?;
            let copied = disk.replace(&to, |into| std::io::copy(&mut file, into).map(drop));
            copied.map_err(|e| FormatError::disk(&to, e))?;
        }
        carried.push(aircraft.id.clone());
    }
    Ok(carried)
}

/// Whether `now` deals anew what `flown` dealt: one mission of one day in one frame, with other regions.
fn deals(now: &Mission, flown: &Mission) -> bool {
    let place = |m: &Mission| [m.origin.lat_deg, m.origin.lon_deg, m.origin.alt_m];
    let regions = |m: &Mission| m.aircraft.iter().map(|a| (a.id.clone(), m.region(a))).collect::<Vec<_>>();
    let is_one = flown.name == now.name && flown.upload.session == now.upload.session && place(flown) == place(now);
    is_one && regions(flown) != regions(now)
}

#[cfg(test)]
mod tests {
    use super::super::tests::{MISSION_TEXT, mission};
    use super::*;
    use crate::testing::{carpet, model as made};

    /// West does not fly any more, and east has a larger region than before.
    fn dealt_anew(folder: &Path) -> Mission {
        let before = mission(folder);
        let mut now = before.clone();
        now.aircraft[0].region_enu = vec![[-40.0, -20.0], [-20.0, -20.0], [-20.0, 20.0], [-40.0, 20.0]];
        now.aircraft[1].region_enu = vec![[-20.0, -20.0], [40.0, -20.0], [40.0, 20.0], [-20.0, 20.0]];
        let survey = config::survey::SurveySettings {
            endurance_min: vec![25.0; 2],
            take_off: vec![[28.0, -82.0]; 2],
            lost: vec!["west".into()],
            ..config::survey::SurveySettings::usual(2.0)
        };
        Mission { survey: Some(survey), ..now }
    }

    fn received(folder: &Path, mission: &Mission, id: &str, finished: bool) -> Received {
        let local = made(id, &[], carpet([-40.0, -20.0], [40.0, 20.0], 2.0));
        let region = mission.region(mission.aircraft(Some(id)).expect("an aircraft"));
        let header = models::formats::model::ModelHeader { region, finished, ..local.header };
        let path = folder.join(format!("{id}.dgtr"));
        model::write(&path, &header, &local.cloud).expect("written");
        let size = std::fs::metadata(&path).expect("metadata").len();
        Received { aircraft: id.into(), path, finished, size, bound: true }
    }

    #[test]
    fn a_checkpoint_of_who_does_not_fly_is_its_last_and_a_final_model_of_the_flight_before_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let (before, now) = (mission(folder.path()), dealt_anew(folder.path()));
        let finished = |mission: &Mission, of: &Mission| {
            let models = vec![received(folder.path(), of, "west", false), received(folder.path(), of, "east", true)];
            Redealt::new(mission).judged(models).iter().map(|r| r.finished).collect::<Vec<_>>()
        };
        assert_eq!(finished(&before, &before), [false, true], "dealt once");
        assert_eq!(finished(&now, &before), [true, false]);
        assert_eq!(finished(&now, &now), [true, true]);
        // Of whom nothing is here, one is told once.
        let mut redealt = Redealt::new(&now);
        assert!(redealt.awaited(&[]).iter().all(|line| line.starts_with("west does not fly any more")));
        assert!(redealt.awaited(&[]).is_empty());
        assert_eq!(Redealt::new(&now).awaited(&[]).len(), 1);
        let of_west = [received(folder.path(), &before, "west", false)];
        assert!(Redealt::new(&now).awaited(&of_west).is_empty());
        // It is written anew while we look.
        let mut redealt = Redealt::new(&now);
        let mut last = |of: &Mission| redealt.judged(vec![received(folder.path(), of, "east", true)])[0].finished;
        assert!(!last(&before));
        std::thread::sleep(std::time::Duration::from_millis(20));
        assert!(last(&now));
    }

    #[test]
    fn models_of_the_session_before_are_brought_where_its_ground_is_dealt_anew_and_never_into_another_days_or_frames() {
        let folder = tempfile::tempdir().expect("a folder");
        let (earlier, now) = (folder.path().join("earlier-1"), dealt_anew(folder.path()));
        let was_flown = |text: &str| std::fs::write(earlier.join(super::super::MISSION), text).expect("written");
        for id in ["west", "east"] {
            let own = earlier.join(RECEIVED).join(id);
            std::fs::create_dir_all(&own).expect("made");
            OF_AN_AIRCRAFT.iter().for_each(|name| std::fs::write(own.join(name), id).expect("written"));
        }
        let carried =
            |mission: &Mission, out: &str| carry(mission, &earlier, &folder.path().join(out)).expect("carried");
        let nobody = Vec::<String>::new();
        assert_eq!(carried(&now, "a"), nobody, "nobody knows what was flown");
        was_flown(MISSION_TEXT);
        assert_eq!(carried(&now, "a"), ["west", "east"]);
        assert_eq!(std::fs::read(folder.path().join("a/received/west/model.dgtr")).expect("there"), b"west");
        // Nothing that is here is written over, and what a kill left half is made whole.
        std::fs::write(folder.path().join("a/received/east/model.dgtr"), b"newer").expect("written");
        std::fs::remove_file(folder.path().join("a/received/west/offer")).expect("removed");
        assert_eq!(carried(&now, "a"), ["west"]);
        assert_eq!(std::fs::read(folder.path().join("a/received/east/model.dgtr")).expect("there"), b"newer");
        let once = mission(folder.path());
        assert_eq!(carried(&once, "b"), nobody, "dealt once");
        let regions = once.aircraft.clone();
        assert_eq!(carried(&Mission { aircraft: regions, ..now.clone() }, "b"), nobody, "flown already");
        for (from, to) in [
            ("name = \"park\"", "name = \"lake\""),
            ("folder = \"stick\"", "folder = \"stick\", session = \"monday\""),
            ("alt_m = 0.0", "alt_m = 1.0"),
        ] {
            was_flown(&MISSION_TEXT.replacen(from, to, 1));
            assert_eq!(carried(&now, "b"), nobody, "{to}");
        }
        was_flown(MISSION_TEXT);
        let file = earlier.join("received/west/model.dgtr");
        std::fs::remove_file(&file).expect("removed");
        std::os::unix::fs::symlink("/etc/hostname", &file).expect("linked");
        let refused = carry(&now, &earlier, &folder.path().join("b")).expect_err("a link").to_string();
        assert!(refused.contains("received/west/model.dgtr"), "{refused}");
    }
}

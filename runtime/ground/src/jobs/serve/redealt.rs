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
}

impl<'a> Redealt<'a> {
    /// Of `mission`; one that was dealt once leaves everything as its aircraft say.
    pub(super) fn new(mission: &'a Mission) -> Self {
        Self { mission, lost: mission.lost(), known: HashMap::new() }
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

/// Brings the models of the session that was put aside in `earlier` back into `out`, where `mission` deals anew what that one flew:
/// those who do not fly any more bring nothing again. Returns whose they are.
///
/// # Errors
/// The disk.
pub fn carry(mission: &Mission, earlier: &Path, out: &Path) -> Result<Vec<String>, FormatError> {
    let flown = Mission::read(&earlier.join(super::MISSION)).ok();
    let goes_on = |flown: Mission| {
        let regions = |m: &Mission| m.aircraft.iter().map(|a| (a.id.clone(), m.region(a))).collect::<Vec<_>>();
        flown.name == mission.name && regions(&flown) != regions(mission)
    };
    if mission.lost().is_empty() || !flown.is_some_and(goes_on) {
        return Ok(Vec::new());
    }
    let (disk, mut carried) = (Disk::default(), Vec::new());
    for aircraft in &mission.aircraft {
        let [from, to] = [earlier, out].map(|folder| folder.join(RECEIVED).join(&aircraft.id));
        if OF_AN_AIRCRAFT.iter().any(|name| !from.join(name).is_file()) {
            continue;
        }
        disk.make_folders(&to).map_err(|e| FormatError::io(&to, "making the folder", e))?;
        for name in OF_AN_AIRCRAFT {
            let (from, to) = (from.join(name), to.join(name));
            let mut file = disk::regular::open(&from).map_err(|e| FormatError::io(&from, "opening", e))?;
            let copied = disk.replace(&to, |into| std::io::copy(&mut file, into).map(drop));
            copied.map_err(|e| FormatError::disk(&to, e))?;
        }
        carried.push(aircraft.id.clone());
    }
    Ok(carried)
}

#[cfg(test)]
mod tests {
    use super::super::tests::mission;
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
        // It is written anew while we look.
        let mut redealt = Redealt::new(&now);
        let mut last = |of: &Mission| redealt.judged(vec![received(folder.path(), of, "east", true)])[0].finished;
        assert!(!last(&before));
        std::thread::sleep(std::time::Duration::from_millis(20));
        assert!(last(&now));
    }
}

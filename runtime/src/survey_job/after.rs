//! What is left when an aircraft fails: the ground that nobody covered, dealt to the others.

use std::path::Path;

use config::mission::Mission;
use config::survey::SurveySettings;
use fleet::deal::Share;
use fleet::ground::{Ground, Ring};
use geometry::geodesy::{EnuFrame, Geodetic};
use geometry::polygon;
use glam::DVec2;
use ground::jobs::serve::{self, RECEIVED};
use models::camera::View;
use models::formats::{FormatError, model};
use survey::coverage::gaps::{self, Gap};
use survey::coverage::{CoverageMap, CoverageRegion};

use super::regions::{with_regions, with_survey};
use super::{Camera, SurveyError, region};

/// Less ground than this is no region, square metres.
const LEAST_M2: f64 = 100.0;
/// Origins nearer to each other are one, metres.
const SAME_M: f64 = 0.1;
/// Gaps of one region that are dealt each by itself, the largest; around all smaller ones is flown together.
const MOST_GAPS: usize = 256;

/// A mission, what is left of it, and who flies that.
#[derive(Clone, Debug)]
pub struct Rest {
    text: String,
    mission: Mission,
    /// Ground that is not covered, in metres around the mission's origin.
    pub left: Ground,
    /// What no aircraft's region holds, between the regions.
    pub(super) holes: Vec<Ring>,
    /// Around the area, or all regions, and whether that is a fence that nobody leaves.
    pub(super) outside: Ring,
    pub(super) fence: bool,
    /// Aircraft that do not fly it.
    pub lost: Vec<String>,
}

impl Rest {
    /// What is left of the mission in `file` by the models in the folder of its ground station. `lost` do not fly any more; where
    /// none is named, those whose final model did not arrive.
    ///
    /// # Errors
    /// Files that cannot be read, nobody left to fly, or nothing left to be flown.
    pub fn of(file: &Path, ground: &Path, lost: &[String]) -> Result<Self, SurveyError> {
        let (mission, text) = Mission::read_with_text(file)?;
        for id in lost {
            mission.aircraft(Some(id))?;
        }
        let received = ground.join(RECEIVED);
        if !received.is_dir() {
            let why = "holds no models of a mission; give the folder that was --out of dgtr serve";
            return Err(FormatError::invalid(ground, why).into());
        }
        is_of(&mission, ground)?;
        let (mut views, mut open): (Vec<View>, Vec<String>) = (Vec::new(), Vec::new());
        for aircraft in &mission.aircraft {
            let path = received.join(&aircraft.id).join("model.dgtr");
            if !path.is_file() {
                if !mission.lost().contains(&aircraft.id) {
                    open.push(aircraft.id.clone());
                }
                continue;
            }
            let (header, _) = model::read_header(&path)?;
            if header.mission != mission.name || header.aircraft != aircraft.id {
                let why = format!("is of aircraft {:?} of mission {:?}", header.aircraft, header.mission);
                return Err(FormatError::invalid(&path, why).into());
            }
            // Views of another frame would cover other ground.
            let apart = header.origin.map_or(0.0, |own| EnuFrame::new(mission.origin).to_enu(own).length());
            if apart > SAME_M {
                let why = format!("has its origin {apart:.1} m from the mission's; give the mission that was flown");
                return Err(FormatError::invalid(&path, why).into());
            }
            if !header.finished && !mission.lost().contains(&aircraft.id) {
                open.push(aircraft.id.clone());
            }
            views.extend(header.views.iter().map(|(_, view)| *view));
        }
        let mut lost = if lost.is_empty() { open } else { lost.to_vec() };
        let is_news = !lost.is_empty();
        // Who was lost before does not fly either.
        lost.extend(mission.lost().iter().filter(|id| mission.aircraft(Some(id)).is_ok()).cloned());
        lost.sort();
        lost.dedup();
        let asked = |what: &str| Err(SurveyError::Request(format!("{}: {what}", ground.display())));
        if !is_news {
            return asked(
                "the final models of all aircraft are here; name those that do not fly any more with --without",
            );
        }
        if lost.len() == mission.aircraft.len() {
            return asked("no aircraft is left to fly; name those that do not with --without");
        }
        let left = lost.iter().try_fold(Ground::default(), |all, id| -> Result<Ground, SurveyError> {
            Ok(all.with(&uncovered(&mission, id, &views)?))
        })?;
        if left.area_m2() < LEAST_M2 {
            return asked(&format!("nothing is left to be flown of {}", lost.join(", ")));
        }
        let all = mission.aircraft.iter().try_fold(Ground::default(), |all, a| -> Result<Ground, SurveyError> {
            Ok(all.with(&self::ground(&mission, &a.id)?))
        })?;
        let outer = || all.parts.iter().filter_map(|part| part.first());
        let drawn = mission.survey.as_ref().map(|survey| &survey.outside_enu).filter(|ring| !ring.is_empty());
        let outside = match (drawn, outer().count()) {
            (Some(ring), _) => ring.iter().copied().map(DVec2::from).collect(),
            (None, 1) => outer().flatten().copied().collect(),
            (None, _) => polygon::hull(outer().flatten().copied().collect()),
        };
        let fence = mission.survey.as_ref().is_some_and(|survey| survey.fence);
        let holes = match &mission.survey {
            Some(survey) => {
                survey.holes_enu.iter().map(|ring| ring.iter().copied().map(DVec2::from).collect()).collect()
            }
            None => {
                let inner = all.parts.into_iter().flat_map(|part| part.into_iter().skip(1));
                inner.filter(|ring| polygon::signed_area(ring).abs() >= LEAST_M2).collect()
            }
        };
        if let Some(survey) = mission.survey.as_ref().filter(|s| s.take_off.len() != mission.aircraft.len()) {
            let (count, wanted) = (survey.take_off.len(), mission.aircraft.len());
            let why = format!("its [survey] is of {count} aircraft and [[aircraft]] of {wanted}; make them agree");
            return Err(FormatError::invalid(file, why).into());
        }
        Ok(Self { text, mission, left, holes, outside, fence, lost })
    }

    /// Ids and links of those that fly it.
    pub fn aircraft(&self) -> Vec<(String, String)> {
        let others = self.mission.aircraft.iter().filter(|a| !self.lost.contains(&a.id));
        others.map(|a| (a.id.clone(), a.link.clone())).collect()
    }

    /// The mission's name.
    pub fn name(&self) -> &str {
        &self.mission.name
    }

    /// The mission's origin.
    pub fn origin(&self) -> Geodetic {
        self.mission.origin
    }

    /// What the mission's flights were planned by, endurance and take-off places of those that fly what is left.
    pub fn settings(&self) -> Option<SurveySettings> {
        let survey = self.mission.survey.as_ref()?;
        let flies = |k: &usize| !self.lost.contains(&self.mission.aircraft[*k].id);
        let flying: Vec<usize> = (0..self.mission.aircraft.len()).filter(flies).collect();
        Some(SurveySettings {
            endurance_min: flying.iter().map(|k| survey.endurance_min[*k]).collect(),
            take_off: flying.iter().map(|k| survey.take_off[*k]).collect(),
            ..survey.clone()
        })
    }

    /// `settings` of those that fly, with those of whoever stays in the mission and does not.
    fn of_all(&self, settings: SurveySettings, stays: &[bool]) -> SurveySettings {
        let before = self.mission.survey.as_ref();
        let mut flying = settings.endurance_min.iter().zip(&settings.take_off);
        let (mut endurance_min, mut take_off) = (Vec::new(), Vec::new());
        for (k, aircraft) in self.mission.aircraft.iter().enumerate() {
            let lost = self.lost.contains(&aircraft.id);
            let of = match (lost, before) {
                (false, _) => flying.next().map(|(minutes, place)| (*minutes, *place)),
                (true, Some(before)) => Some((before.endurance_min[k], before.take_off[k])),
                // Nobody said it: it does not fly.
                (true, None) => settings.endurance_min.first().copied().zip(settings.take_off.first().copied()),
            };
            if let Some((minutes, place)) = of.filter(|_| stays[k]) {
                endurance_min.push(minutes);
                take_off.push(place);
            }
        }
        let stays = |id: &String| self.mission.aircraft.iter().zip(stays).any(|(a, stays)| *stays && a.id == *id);
        let lost = self.lost.iter().filter(|id| stays(id)).cloned().collect();
        SurveySettings { endurance_min, take_off, lost, ..settings }
    }

    /// The mission's camera.
    pub fn camera(&self) -> Camera {
        let c = &self.mission.camera;
        let fov_deg = 2.0 * (f64::from(c.width) / (2.0 * f64::from(c.fx))).atan().to_degrees();
        Camera { picture: [c.width, c.height], fov_deg }
    }

    /// The mission with the regions as they are now: who fails keeps what is covered, and the others get their shares.
    ///
    /// # Errors
    /// A region with too many corners.
    pub(super) fn mission(&self, shares: &[Share], settings: SurveySettings) -> Result<String, SurveyError> {
        let mut changes = Vec::new();
        let mut dealt = shares.iter();
        for aircraft in &self.mission.aircraft {
            let before = ground(&self.mission, &aircraft.id)?;
            let now = match (self.lost.contains(&aircraft.id), dealt.as_slice().first()) {
                (false, Some(share)) => {
                    dealt.next();
                    before.with(&share.ground)
                }
                _ => before.without(&self.left),
            };
            let corners = (now.area_m2() >= LEAST_M2).then(|| region(&now, &aircraft.id)).transpose()?;
            changes.push((aircraft.id.clone(), corners));
        }
        let stays: Vec<bool> = changes.iter().map(|(_, corners)| corners.is_some()).collect();
        let settings = self.of_all(settings, &stays);
        let text = with_survey(&with_regions(&self.text, &changes)?, &settings);
        // Text is changed where its author wrote it: what is read of it decides.
        let now = Mission::parse(&text, Path::new("."))?;
        let wanted = changes.iter().filter_map(|(id, corners)| Some((id, corners.as_ref()?)));
        let read = now.aircraft.iter().map(|a| (&a.id, now.region(a)));
        match wanted.map(|(id, corners)| (id, corners.clone())).eq(read) && now.survey.as_ref() == Some(&settings) {
            true => Ok(text),
            false => Err(SurveyError::Request(
                "the regions of the mission file cannot be exchanged; write each aircraft below a line [[aircraft]] of its own, and \
                 [survey] as a table"
                    .into(),
            )),
        }
    }
}

/// Refuses a folder in which the ground received another mission.
fn is_of(mission: &Mission, ground: &Path) -> Result<(), SurveyError> {
    let kept = ground.join(serve::MISSION);
    if !kept.is_file() {
        return Ok(());
    }
    let (own, _) = Mission::read_with_text(&kept)?;
    let apart = EnuFrame::new(mission.origin).to_enu(own.origin).length();
    if own.name == mission.name && apart <= SAME_M {
        return Ok(());
    }
    let why = format!(
        "is of mission {:?}, {apart:.1} m from {:?}; give the folder and the mission of one flight",
        own.name, mission.name
    );
    Err(FormatError::invalid(&kept, why).into())
}

fn ground(mission: &Mission, id: &str) -> Result<Ground, SurveyError> {
    let corners: Ring = mission.region(mission.aircraft(Some(id))?).into_iter().map(DVec2::from).collect();
    Ok(Ground::of(vec![corners]))
}

/// What of an aircraft's region the views do not cover: around each gap its convex hull, as squares would leave hundreds of corners.
fn uncovered(mission: &Mission, id: &str, views: &[View]) -> Result<Ground, SurveyError> {
    let ground = ground(mission, id)?;
    let corners = mission.region(mission.aircraft(Some(id))?).into_iter().map(DVec2::from).collect();
    let rules = mission.coverage;
    let region = CoverageRegion::new(corners);
    // Where the aircraft took off lies the origin, unless the mission says how high the ground is.
    let map = region.and_then(|region| CoverageMap::new(&region, rules.ground_m.map_or(0.0, f64::from), rules));
    let mut map = map.map_err(|e| SurveyError::Request(format!("region of {id}: {e}")))?;
    views.iter().for_each(|view| map.add(view));
    let mut found = gaps::find(&map);
    if found.len() > MOST_GAPS {
        // The largest come first.
        let small = found.split_off(MOST_GAPS - 1);
        let squares = small.iter().flat_map(|gap| gap.squares.iter().copied()).collect();
        found.extend(small.into_iter().next().map(|gap| Gap { squares, ..gap }));
    }
    Ok(found.iter().fold(Ground::default(), |all, gap| all.with(&around(&map, gap))).common(&ground))
}

fn around(map: &CoverageMap, gap: &Gap) -> Ground {
    let grid = map.grid();
    let corners = gap.squares.iter().flat_map(|square| {
        let (column, row) = (*square as usize % grid.columns, *square as usize / grid.columns);
        let (middle, half) = (grid.middle(column, row), 0.5 * grid.side_m);
        [[-half, -half], [half, -half], [half, half], [-half, half]].map(|c| middle + DVec2::from(c))
    });
    Ground::of(vec![polygon::hull(corners.collect())])
}

//! A mission file to start from: what must be given is given, what is often changed stands there as a comment with its
//! default, everything else is in the reference.

use super::Mission;
use super::reference::{comment, explain};
use crate::plan::WORKING_SIDE;
use crate::preset::Preset;
use crate::settings::{Setting, Value};
use crate::survey::SurveySettings;
use geometry::geodesy::Geodetic;

/// What a mission needs to know from its author.
#[derive(Clone, Debug)]
pub struct Draft {
    /// Short name.
    pub name: String,
    /// Origin of the local frame, the middle of the area.
    pub origin: Geodetic,
    /// Width and height of a picture, pixels.
    pub picture: [u32; 2],
    /// Angle between the left and the right edge of a picture, degrees.
    pub fov_deg: f64,
    /// What is flown.
    pub area: DraftArea,
    /// Id and link of every aircraft.
    pub aircraft: Vec<(String, String)>,
    /// Budgets, unless the defaults of `[memory]` do.
    pub preset: Option<Preset>,
    /// What its flights were planned by.
    pub survey: Option<SurveySettings>,
}

/// What the aircraft of a draft fly.
#[derive(Clone, Debug)]
pub enum DraftArea {
    /// Extent east-west and north-south, metres; split among the aircraft from west to east.
    Box([f64; 2]),
    /// Corners of the region of each aircraft, metres east and north of the origin.
    Regions(Vec<Vec<[f64; 2]>>),
}

impl DraftArea {
    /// Corners of the region of one of `count` aircraft.
    fn region(&self, aircraft: usize, count: usize) -> Vec<[f64; 2]> {
        match self {
            Self::Box([east, north]) => {
                let stripe = east / count.max(1) as f64;
                let (west, south) = (aircraft as f64 * stripe - east / 2.0, -north / 2.0);
                vec![[west, south], [west + stripe, south], [west + stripe, -south], [west, -south]]
            }
            Self::Regions(regions) => regions.get(aircraft).cloned().unwrap_or_default(),
        }
    }
}

/// Pictures that the presets were measured with.
const MEASURED_VIEWS: u32 = 48;
/// Tables that are written with all their settings; those that are not have theirs in the reference.
const SHOWN: [&str; 5] = ["mount", "link", "keyframes", "memory", "upload"];

impl Draft {
    /// The file's text. Whether it can be flown is for [`Mission::parse`] to say.
    pub fn text(&self) -> String {
        let all = Mission::settings();
        let mut out = String::new();
        comment(
            &mut out,
            "A mission: one file for all aircraft and the ground. Lines that begin with # and a name are defaults.",
        );
        comment(&mut out, "`dgtr init --reference` prints every setting; `dgtr plan` what a memory budget holds.");
        let quoted = |text: &str| toml::Value::from(text).to_string();
        let Geodetic { lat_deg, lon_deg, alt_m } = self.origin;
        let origin = format!("{{ lat_deg = {lat_deg:?}, lon_deg = {lon_deg:?}, alt_m = {alt_m:?} }}");
        let of_the_file = [("name", quoted(&self.name)), ("origin", origin)];
        let plain = all.iter().filter(|s| s.settings.is_empty() || s.name == "origin");
        write(&mut out, plain, &of_the_file, true);
        let [width, height] = self.picture.map(f64::from);
        // A pinhole of square pixels that looks along its middle, until a calibration says otherwise.
        let focal = format!("{:?}", (width / 2.0 / (self.fov_deg / 2.0).to_radians().tan()) as f32);
        let [cx, cy] = [width, height].map(|side| format!("{:?}", side / 2.0));
        let [width, height] = self.picture.map(|side| side.to_string());
        let camera =
            [("width", width), ("height", height), ("fx", focal.clone()), ("fy", focal), ("cx", cx), ("cy", cy)];
        section(&mut out, &all, "camera", &camera, true);
        let preset = self.preset.and_then(|p| Preset::ALL.iter().find(|a| a.1 == p));
        // The presets and the defaults of [memory] were chosen with pictures of this side, and the presets with 48 of them.
        let side = f64::from(WORKING_SIDE) / f64::from(self.picture[0].max(self.picture[1]));
        let values = preset.and_then(|p| p.1.values());
        let mut memory: Vec<_> = preset.iter().map(|p| ("preset", quoted(p.0))).collect();
        // Without a preset pictures are trained at that side whether it is written or not, and what is written is not `auto`'s to choose.
        if let Some(scale) = values.map(|v| side.min(1.0) * f64::from(v.image_scale)).filter(|s| *s < 1.0) {
            memory.push(("image_scale", format!("{:?}", (scale * 1e4).round() / 1e4)));
        }
        let keyframes: Vec<_> = values.iter().map(|_| ("max", MEASURED_VIEWS.to_string())).collect();
        for table in SHOWN {
            match table {
                "memory" => section(&mut out, &all, table, &memory, true),
                "keyframes" => section(&mut out, &all, table, &keyframes, true),
                "upload" => section(&mut out, &all, table, &[("folder", quoted("upload"))], true),
                _ => section(&mut out, &all, table, &[], true),
            }
        }
        if let Some(survey) = &self.survey {
            section(&mut out, &all, "survey", &survey.given(), true);
        }
        for (i, (id, link)) in self.aircraft.iter().enumerate() {
            let region = self.area.region(i, self.aircraft.len());
            let given = [
                ("id", quoted(id)),
                ("system_id", (i + 1).to_string()),
                ("link", quoted(link)),
                ("camera", format!("{{ folder = {} }}", quoted(&format!("{id}/camera")))),
                ("region_enu", format!("{region:?}")),
            ];
            section(&mut out, &all, "aircraft", &given, i == 0);
        }
        out
    }
}

/// A table with its header.
fn section(out: &mut String, all: &[Setting], table: &str, given: &[(&str, String)], explained: bool) {
    let Some(table) = all.iter().find(|s| s.name == table) else { return };
    *out += "\n";
    if explained {
        comment(out, table.about);
    }
    *out += &if table.repeated { format!("[[{}]]\n", table.name) } else { format!("[{}]\n", table.name) };
    write(out, table.settings.iter().filter(|s| s.settings.is_empty()), given, explained);
}

/// Settings with what is given for them; the others, with their defaults, as comments.
fn write<'a>(out: &mut String, settings: impl Iterator<Item = &'a Setting>, given: &[(&str, String)], explained: bool) {
    for s in settings {
        let value = given.iter().find(|g| g.0 == s.name).map(|g| &g.1);
        if explained {
            comment(out, &explain(s));
        }
        match (value, &s.default) {
            (Some(value), _) => *out += &format!("{} = {value}\n", s.name),
            (None, Some(default)) if explained => *out += &format!("#{} = {default}\n", s.name),
            (None, None) if explained => *out += &format!("#{} =\n", s.name),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::plan::{Lanes, Plan, PlanRequest};

    fn draft() -> Draft {
        Draft {
            name: "park".into(),
            origin: Geodetic { lat_deg: 47.0, lon_deg: 8.5, alt_m: 400.0 },
            picture: [4056, 3040],
            fov_deg: 60.0,
            area: DraftArea::Box([200.0, 100.0]),
            aircraft: vec![("west".into(), "udpin:0.0.0.0:14550".into()), ("east".into(), "tcpin:0.0.0.0:1".into())],
            preset: Some(Preset::Tiny),
            survey: None,
        }
    }

    #[test]
    fn a_draft_is_a_mission_with_every_aircraft_in_its_part_of_the_area() {
        let m = Mission::parse(&draft().text(), Path::new("/m")).unwrap_or_else(|e| panic!("{e}\n{}", draft().text()));
        assert_eq!((m.name.as_str(), m.origin.lat_deg, m.camera.width), ("park", 47.0, 4056));
        assert!((m.camera.fx - 3512.6).abs() < 0.1, "{}", m.camera.fx);
        let regions = m.aircraft.iter().map(|a| m.region(a)).collect::<Vec<_>>();
        assert_eq!(regions[0], [[-100.0, -50.0], [0.0, -50.0], [0.0, 50.0], [-100.0, 50.0]]);
        assert_eq!(regions[1][0], [0.0, -50.0]);
        let drawn = vec![vec![[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]], vec![[9.0, 0.0], [20.0, 0.0], [9.0, 9.0]]];
        let text = Draft { area: DraftArea::Regions(drawn.clone()), ..draft() }.text();
        let m = Mission::parse(&text, Path::new("/m")).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(m.aircraft.iter().map(|a| m.region(a)).collect::<Vec<_>>(), drawn);
        assert_eq!((m.memory.device_mib(), m.training.seconds), (96, Some(10.0)));
        assert_eq!((m.memory.image_scale, m.keyframes.max), (Some(0.0789), 48));
    }

    #[test]
    fn a_draft_fits_into_its_own_budget_whatever_the_camera_and_the_preset() {
        let presets = Preset::ALL.iter().map(|p| Some(p.1)).chain([None]);
        for (preset, picture) in
            presets.flat_map(|p| [[4056, 3040], [640, 480], [3040, 4056], [320, 240]].map(|s| (p, s)))
        {
            let text = Draft { preset, picture, ..draft() }.text();
            let mission =
                Mission::parse(&text, Path::new("/m")).unwrap_or_else(|e| panic!("{preset:?} {picture:?}: {e}"));
            let (width, height) = mission.memory.training_size((picture[0], picture[1]));
            let request = PlanRequest {
                device_mib: mission.memory.device_mib(),
                width,
                height,
                views: mission.keyframes.max,
                max_gaussians: mission.memory.max_gaussians.map(|n| n as usize),
                scene_gaussians: mission.memory.scene_gaussians.map(|n| n as usize),
                lanes: Lanes::BOARD,
                ..PlanRequest::default()
            };
            Plan::new(&request).unwrap_or_else(|e| panic!("{preset:?} {picture:?}: {e}"));
        }
    }

    #[test]
    fn a_draft_leaves_to_the_device_what_nobody_said() {
        for preset in [Some(Preset::Auto), None] {
            let mission = Mission::parse(&Draft { preset, ..draft() }.text(), Path::new("/m")).expect("a mission");
            assert_eq!((mission.memory.preset, mission.memory.image_scale), (preset, None));
            assert!(mission.memory.is_auto());
        }
    }

    #[test]
    fn every_commented_default_of_a_draft_can_be_uncommented() {
        let text = Draft { preset: None, ..draft() }.text();
        let setting = |line: &str| {
            let (name, value) = line.strip_prefix('#')?.split_once(" = ")?;
            name.bytes()
                .all(|b| b.is_ascii_lowercase() || b == b'_' || b.is_ascii_digit())
                .then(|| format!("{name} = {value}"))
        };
        let lines: Vec<String> = text.lines().map(|l| setting(l).unwrap_or(l.to_owned())).collect();
        let uncommented = lines.iter().zip(text.lines()).filter(|(a, b)| a != b).count();
        assert!(uncommented > 25, "{uncommented}");
        let (a, b) = (Mission::parse(&text, Path::new("/m")), Mission::parse(&lines.join("\n"), Path::new("/m")));
        assert_eq!(a.expect("as written"), b.expect("uncommented"));
    }
}

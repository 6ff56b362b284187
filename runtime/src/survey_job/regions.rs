//! New regions, and what they were planned by, in the text of a mission file; everything else, comments included, stays as its author
//! wrote it.

use std::ops::Range;

use config::mission::MissionError;
use config::settings::{SettingError, parse};
use config::survey::SurveySettings;
use serde::Deserialize;
use toml::{Spanned, Value};

/// Where the aircraft of a file and their regions stand.
#[derive(Deserialize)]
struct File {
    aircraft: Vec<Entry>,
}

#[derive(Deserialize)]
struct Entry {
    id: Spanned<String>,
    #[serde(default)]
    region_enu: Option<Spanned<Value>>,
    #[serde(default)]
    region_wgs84: Option<Spanned<Value>>,
}

/// What an aircraft's table begins with.
const TABLE: &str = "[[aircraft]]";

/// `text` with other regions, metres east and north of the origin, for the aircraft that `regions` names; `None` takes an aircraft out.
///
/// # Errors
/// The text is no mission, names no such aircraft, or does not have it as a table of its own.
pub fn with_regions(text: &str, regions: &[(String, Option<Vec<[f64; 2]>>)]) -> Result<String, MissionError> {
    let file: File = parse(text)?;
    let known = || file.aircraft.iter().map(|a| a.id.as_ref().as_str()).collect::<Vec<_>>().join(", ");
    let mut edits: Vec<(Range<usize>, String)> = Vec::new();
    for (id, region) in regions {
        let entry = file.aircraft.iter().find(|a| a.id.as_ref() == id);
        let entry = entry.ok_or_else(|| MissionError::NoSuchAircraft { id: id.clone(), known: known() })?;
        let not_a_table = || SettingError::new("aircraft", id, "a table of its own, under a line [[aircraft]]");
        match region {
            Some(corners) => {
                let (key, value) = match (&entry.region_enu, &entry.region_wgs84) {
                    (Some(value), _) => ("region_enu", value),
                    (None, Some(value)) => ("region_wgs84", value),
                    (None, None) => return Err(not_a_table().into()),
                };
                let start = text[..value.span().start].rfind(key).ok_or_else(not_a_table)?;
                edits.push((start..value.span().end, format!("region_enu = {corners:?}")));
            }
            None => {
                let start = text[..entry.id.span().start].rfind(TABLE).ok_or_else(not_a_table)?;
                let body = &text[start + TABLE.len()..];
                let next = |line: &str| table(line).is_some_and(|name| !name.starts_with("aircraft."));
                let end = body.match_indices('\n').map(|(at, _)| at + 1).find(|at| next(&body[*at..]));
                edits.push((start..end.map_or(text.len(), |end| start + TABLE.len() + end), String::new()));
            }
        }
    }
    edits.sort_by_key(|edit| edit.0.start);
    let mut changed = text.to_owned();
    for (range, new) in edits.into_iter().rev() {
        changed.replace_range(range, &new);
    }
    Ok(changed)
}

/// `text` with another table `[survey]`, which comes last.
pub fn with_survey(text: &str, settings: &SurveySettings) -> String {
    let mut kept = String::with_capacity(text.len());
    let mut within = false;
    for line in text.split_inclusive('\n') {
        if let Some(name) = table(line) {
            within = name == "survey";
        }
        if !within {
            kept += line;
        }
    }
    format!("{}\n\n{}", kept.trim_end(), settings.text())
}

/// What a line calls the table that it begins; corners of a region that stand alone on a line are no name.
fn table(line: &str) -> Option<&str> {
    let name = line.trim_start().strip_prefix('[')?.trim_start_matches('[').trim_start();
    let name = name.split(']').next().unwrap_or_default().trim_end();
    name.starts_with(|c: char| c.is_alphabetic() || c == '_').then_some(name)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use config::mission::Mission;

    use super::*;

    const TEXT: &str = r#"
origin = { lat_deg = 47.0, lon_deg = 8.0, alt_m = 430.0 }
name = "park" # ours
camera = { width = 4000, height = 3000, fx = 3464.0, fy = 3464.0, cx = 2000.0, cy = 1500.0 }
[[aircraft]]
link = "udpin:127.0.0.1:14550"
id = "a1"
region_enu = [[0.0, 0.0],
  [10.0, 0.0], [10.0, 10.0]] # the field
camera = { folder = "a1" }
[[aircraft]]
id = "a2"
region_wgs84 = [[47.0, 8.0], [47.001, 8.0], [47.001, 8.001]]
link = "udpin:127.0.0.1:14551"
camera = { folder = "a2" }
[[aircraft]]
id = "a3"
link = "udpin:127.0.0.1:14552"
camera = { folder = "a3" }
region_enu = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]
[upload]
folder = "upload"
"#;

    #[test]
    fn regions_change_and_everything_else_stays() {
        let region = vec![[1.0, 2.0], [30.5, 2.0], [1.0, 40.0]];
        let changes = [("a1".into(), Some(region.clone())), ("a2".into(), Some(region.clone())), ("a3".into(), None)];
        let text = with_regions(TEXT, &changes).expect("changed");
        let mission = Mission::parse(&text, Path::new("/m")).unwrap_or_else(|e| panic!("{e}\n{text}"));
        assert_eq!(mission.aircraft.iter().map(|a| a.id.as_str()).collect::<Vec<_>>(), ["a1", "a2"]);
        assert!(mission.aircraft.iter().all(|a| mission.region(a) == region));
        assert!(
            text.contains("# ours") && text.contains("# the field") && text.contains("folder = \"upload\""),
            "{text}"
        );
        let unknown = with_regions(TEXT, &[("b".into(), None)]).expect_err("unknown").to_string();
        assert!(unknown.contains("no aircraft 'b' in the mission; it has a1, a2, a3"), "{unknown}");
        assert!(with_regions("name = 3", &[]).is_err());
        // Indented tables, and corners that begin a line.
        let other: String = TEXT.lines().map(|line| format!("  {}\n", line.trim_start())).collect();
        for text in [other.as_str(), &TEXT.replace("  [10.0", "[10.0")] {
            let text =
                with_regions(text, &[("a1".into(), None), ("a2".into(), Some(region.clone()))]).expect("changed");
            let mission = Mission::parse(&text, Path::new("/m")).unwrap_or_else(|e| panic!("{e}\n{text}"));
            assert_eq!(mission.aircraft.iter().map(|a| a.id.as_str()).collect::<Vec<_>>(), ["a2", "a3"]);
            assert!(mission.region(&mission.aircraft[0]) == region && text.contains("folder = \"upload\""), "{text}");
        }
    }

    #[test]
    fn a_mission_holds_what_it_was_planned_by_once_however_often_it_is_planned() {
        let settings = SurveySettings {
            endurance_min: vec![25.0; 3],
            take_off: vec![[47.0, 8.0]; 3],
            holes_enu: vec![vec![[1.0, 1.0], [2.0, 1.0], [1.0, 2.0]]],
            ..SurveySettings::usual(2.0)
        };
        let other = SurveySettings { wind_m_s: 9.0, ..settings.clone() };
        let first = with_survey(TEXT, &settings);
        // In the middle, indented, with a comment.
        let middle = TEXT
            .replace("[upload]", &format!("  {}\n[upload]", settings.text().replace("[survey]", "[survey] # ours")));
        for text in [with_survey(&first, &other), with_survey(&middle, &other)] {
            let mission = Mission::parse(&text, Path::new("/m")).unwrap_or_else(|e| panic!("{e}\n{text}"));
            assert_eq!(mission.survey.as_ref(), Some(&other));
            assert!(
                mission.aircraft.len() == 3 && mission.upload.folder.is_some() && text.contains("# the field"),
                "{text}"
            );
        }
    }
}

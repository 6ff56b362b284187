//! `[survey]` of the mission file: what `dgtr survey` planned the flights by, so that `dgtr survey --after` plans what is left alike.

use std::path::PathBuf;

use crate::settings::{Limits, SettingError, Value, as_toml, record};

record! {
    /// What `dgtr survey` planned the flights by; `dgtr survey --after` plans what is left of them alike.
    pub struct SurveySettings {
        /// Ground sampling distance, centimetres to a pixel.
        pub gsd_cm: f64, in Limits::within(0.1, 1000.0), unit "cm";
        /// Share of a picture seen again by the next one on the line.
        pub forward_overlap: f64, in Limits::within(0.0, 0.95);
        /// Share of a picture seen again from the next line.
        pub side_overlap: f64, in Limits::within(0.0, 0.95);
        /// What the camera needs from picture to picture.
        pub interval_s: f64, in Limits::within(0.0, 60.0);
        /// Speed over ground.
        pub speed_m_s: f64, in Limits::within(0.5, 50.0), unit "m/s";
        /// The fastest through the air.
        pub fastest_m_s: f64, in Limits::within(0.5, 100.0), unit "m/s";
        /// Wind from any side.
        pub wind_m_s: f64, in Limits::within(0.0, 99.0), unit "m/s";
        /// How long a battery lasts, of each aircraft in their order.
        pub endurance_min: Vec<f64>, in Limits::within(1.0, 1440.0), unit "minutes";
        /// Share of the battery that is left at the landing.
        pub reserve: f64, in Limits::within(0.0, 0.9);
        /// Where each aircraft takes off and lands: latitude and longitude.
        pub take_off: Vec<[f64; 2]>, in Limits::within(-180.0, 180.0), unit "degrees";
        /// Height above ground that nobody exceeds.
        pub highest_m: f64, in Limits::within(5.0, 10_000.0);
        /// Room that is kept around holes.
        pub clearance_m: f64, in Limits::within(1.0, 500.0);
        /// Heights of the ground, a GeoTIFF.
        #[serde(default)]
        pub terrain: Option<PathBuf> = None;
        /// Holes that are flown round: corners east and north of the origin.
        pub holes_enu: Vec<Vec<[f64; 2]>>, unit "metres";
        /// Outside of the area: corners east and north of the origin. Absent = around all regions.
        #[serde(default)]
        pub outside_enu: Vec<[f64; 2]> = Vec::new(), unit "metres";
        /// The area is an inclusion fence: no way leads out of it.
        #[serde(default)]
        pub fence: bool = false;
        /// Aircraft that do not fly any more: what the ground has of them is their last.
        #[serde(default)]
        pub lost: Vec<String> = Vec::new();
    } where Self::of_one_fleet
}

impl SurveySettings {
    /// What one aircraft flies by when nobody said otherwise. Where it takes off has no such value.
    pub fn usual(gsd_cm: f64) -> Self {
        Self {
            gsd_cm,
            forward_overlap: 0.75,
            side_overlap: 0.65,
            interval_s: 1.0,
            speed_m_s: 8.0,
            fastest_m_s: 15.0,
            wind_m_s: 5.0,
            endurance_min: vec![25.0],
            reserve: 0.25,
            take_off: Vec::new(),
            highest_m: 120.0,
            clearance_m: 10.0,
            terrain: None,
            holes_enu: Vec::new(),
            outside_enu: Vec::new(),
            fence: false,
            lost: Vec::new(),
        }
    }

    fn of_one_fleet(&self) -> Result<(), SettingError> {
        match self.endurance_min.len() == self.take_off.len() {
            true => Ok(()),
            false => {
                Err(SettingError::new("take_off", &self.take_off, "as many as endurance_min, one for each aircraft"))
            }
        }
    }

    /// Every setting that is given, by name, as TOML.
    pub(crate) fn given(&self) -> Vec<(&'static str, String)> {
        let table = toml::Table::try_from(self).unwrap_or_default();
        let value = |name: &'static str| Some((name, as_toml(table.get(name)?)?));
        Self::settings().iter().filter_map(|setting| value(setting.name)).collect()
    }

    /// The table as a mission file holds it.
    pub fn text(&self) -> String {
        let lines = self.given().into_iter().map(|(name, value)| format!("{name} = {value}\n"));
        std::iter::once("[survey]\n".to_owned()).chain(lines).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings() -> SurveySettings {
        SurveySettings {
            endurance_min: vec![25.0, 20.0],
            take_off: vec![[47.4, 8.5]; 2],
            holes_enu: vec![vec![[0.0, 0.0], [9.5, 0.0], [0.0, 9.0]]],
            outside_enu: vec![[-9.0, -9.0], [99.0, -9.0], [0.0, 99.5]],
            fence: true,
            lost: vec!["a1".into()],
            ..SurveySettings::usual(2.0)
        }
    }

    #[test]
    fn what_is_written_is_read_back_and_lists_of_two_fleets_are_refused() {
        #[derive(serde::Deserialize)]
        struct File {
            survey: SurveySettings,
        }
        for survey in [settings(), SurveySettings { terrain: Some("/maps/hill.tif".into()), ..settings() }] {
            let read: File = toml::from_str(&survey.text()).unwrap_or_else(|e| panic!("{e}\n{}", survey.text()));
            assert_eq!(read.survey, survey);
            assert_eq!(survey.check(), Ok(()));
        }
        let other = SurveySettings { take_off: vec![[47.4, 8.5]], ..settings() };
        assert!(other.check().is_err_and(|e| e.to_string().contains("as many as endurance_min")));
        let wrong = SurveySettings { endurance_min: vec![25.0, 0.0], ..settings() };
        assert!(wrong.check().is_err_and(|e| e.field == "endurance_min[1]"), "{:?}", wrong.check());
    }
}

//! What one setting of a mission cannot say about itself: names, and the regions of the aircraft. Refused here, before
//! anything starts.

use super::{Aircraft, Mission};
use crate::settings::SettingError;

/// Longest id or name, so that keys on the wire stay short and bounded.
const MAX_NAME: usize = 32;
/// Most aircraft of one mission.
pub const MAX_AIRCRAFT: usize = 1024;
/// Most corners of a region.
pub const MAX_CORNERS: usize = 256;

fn check_name(field: &str, name: &str) -> Result<(), SettingError> {
    let fits = !name.is_empty()
        && name.len() <= MAX_NAME
        && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
    match fits {
        true => Ok(()),
        false => Err(SettingError::new(field, name, format!("1 to {MAX_NAME} letters, digits, '-' or '_'"))),
    }
}

impl Aircraft {
    pub(super) fn named_and_placed(&self) -> Result<(), SettingError> {
        check_name("id", &self.id)?;
        match self.region_enu.is_empty() == self.region_wgs84.is_empty() {
            true => Err(SettingError::new("region_enu", &self.region_enu, "given, or region_wgs84, and not both")),
            false => Ok(()),
        }
    }
}

impl Mission {
    pub(super) fn fits_together(&self) -> Result<(), SettingError> {
        check_name("name", &self.name)?;
        let count = self.aircraft.len();
        if !(1..=MAX_AIRCRAFT).contains(&count) {
            return Err(SettingError::new("aircraft", &count, format!("1 to {MAX_AIRCRAFT} [[aircraft]] tables")));
        }
        for (i, a) in self.aircraft.iter().enumerate() {
            let at = |e: SettingError| e.at(&format!("aircraft[{i}]"));
            // A stick with FAT has one folder for both.
            if self.aircraft[..i].iter().any(|b| b.id.eq_ignore_ascii_case(&a.id)) {
                return Err(at(SettingError::new("id", &a.id, "the only one of its name, in capitals or not")));
            }
            let mut others = self.aircraft[..i].iter().map(|b| b.public_key).chain([self.ground.public_key]);
            if a.public_key.is_some() && others.any(|key| key == a.public_key) {
                return Err(at(SettingError::new("public_key", &a.public_key, "nobody else's")));
            }
            if a.public_key.is_some() && a.id.eq_ignore_ascii_case("ground") {
                return Err(at(SettingError::new(
                    "id",
                    &a.id,
                    "another one: its key would lie in the ground's, ground.key",
                )));
            }
            self.check_region(a).map_err(at)?;
        }
        match self.lost().iter().find(|id| self.aircraft.iter().all(|a| a.id != **id)) {
            Some(id) => Err(SettingError::new("survey.lost", id, "the id of an aircraft")),
            None => Ok(()),
        }
    }

    fn check_region(&self, aircraft: &Aircraft) -> Result<(), SettingError> {
        let (field, given) = match aircraft.region_enu.is_empty() {
            true => ("region_wgs84", &aircraft.region_wgs84),
            false => ("region_enu", &aircraft.region_enu),
        };
        let corners = self.region(aircraft);
        if !(3..=MAX_CORNERS).contains(&corners.len()) || !corners.iter().flatten().all(|v| v.is_finite()) {
            return Err(SettingError::new(field, given, format!("3 to {MAX_CORNERS} finite corners")));
        }
        // Shoelace: a region without area owns nothing.
        let next = corners.iter().cycle().skip(1);
        let twice_area: f64 = corners.iter().zip(next).map(|(p, q)| p[0] * q[1] - q[0] * p[1]).sum();
        match twice_area.abs() < 2.0 {
            true => Err(SettingError::new(field, given, "corners in order around an area of 1 m² or more")),
            false => Ok(()),
        }
    }
}

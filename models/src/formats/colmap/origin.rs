//! Where on the earth the world frame of a model lies, in a small file beside it: COLMAP's own files cannot say it.

use std::path::Path;

use geometry::geodesy::Geodetic;
use serde::{Deserialize, Serialize};

use crate::formats::reconstruction::origin;
use crate::formats::{FormatError, read_bounded, write_atomic};

const FILE: &str = "enu_origin_wgs84.json";

#[derive(Serialize, Deserialize)]
struct Origin {
    lat: f64,
    lon: f64,
    alt: f64,
}

pub(super) fn read(folder: &Path) -> Result<Option<Geodetic>, FormatError> {
    let path = folder.join(FILE);
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = read_bounded(&path, 1 << 16)?;
    let o: Origin = serde_json::from_slice(&bytes).map_err(|e| FormatError::invalid(&path, e.to_string()))?;
    origin(&path, "its position", o.lat, o.lon, o.alt).map(Some)
}

pub(super) fn write(folder: &Path, origin: Geodetic) -> Result<(), FormatError> {
    let file = Origin { lat: origin.lat_deg, lon: origin.lon_deg, alt: origin.alt_m };
    write_atomic(&folder.join(FILE), |w| serde_json::to_writer(w, &file).map_err(std::io::Error::other))
}

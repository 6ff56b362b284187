//! What a flight or a folder has covered and what it has not: said in a line, written as files, noted in `run.json`.

use std::path::{Path, PathBuf};

use disk::Disk;
use geometry::geodesy::{EnuFrame, Geodetic};
use models::camera::View;
use models::formats::FormatError;
use models::formats::flight_plan::{FlightPlan, Waypoint};
use survey::coverage::gaps::{self, Gap, GapKind};
use survey::coverage::reflight::{self, Reflight};
use survey::coverage::{CoverageMap, geojson, raster};

use job::run_json::RunReport;
use pages::watch::GAPS;

#[cfg(feature = "lab")]
mod route;
#[cfg(test)]
#[cfg(feature = "lab")]
mod tests;

#[cfg(feature = "lab")]
pub use route::route;

/// Every square with its figures, for a GIS.
pub const RASTER: &str = "coverage.tif";
/// The flight that closes them.
pub const REFLIGHT: &str = "reflight.plan";
/// Speed between two pictures of it, m/s: each is taken standing.
const SPEED_M_S: f64 = 5.0;
/// Characters of one STATUSTEXT.
const LINE: usize = 50;

/// What was found.
#[derive(Clone, Debug)]
pub struct Coverage {
    /// The ground.
    pub map: CoverageMap,
    /// What is missing, the largest first.
    pub gaps: Vec<Gap>,
    /// How to get it; `None` when nothing is missing, or nobody asked.
    pub reflight: Option<Reflight>,
    origin: Option<Geodetic>,
    home_m: f64,
}

impl Coverage {
    /// What `map` lacks. `origin`: of its frame, where it is known.
    pub fn of(map: CoverageMap, origin: Option<Geodetic>) -> Self {
        let (gaps, home_m) = (gaps::find(&map), map.base_m());
        Self { map, gaps, reflight: None, origin, home_m }
    }

    /// Plans the flight that closes the gaps as `flown` was flown, its pictures no closer than `least_m`, its heights above home
    /// at `home_m` (metres above the origin).
    #[must_use]
    pub fn with_reflight(mut self, flown: &[View], least_m: f64, home_m: f64) -> Self {
        self.reflight = reflight::plan(&self.map, &self.gaps, flown, least_m);
        self.home_m = home_m;
        self
    }

    /// Covered share in whole percent; 100 only when there is no gap.
    pub fn percent(&self) -> u32 {
        let percent = (100.0 * self.map.covered_share()).floor() as u32;
        if self.gaps.is_empty() { 100 } else { percent.min(99) }
    }

    /// Pictures of the re-flight.
    pub fn more_pictures(&self) -> usize {
        self.reflight.as_ref().map_or(0, |r| r.stations.len())
    }

    /// For the ground control station, in one STATUSTEXT.
    pub fn line(&self) -> String {
        let count = |n: usize, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
        let holes = count(self.gaps.len(), "hole");
        let line = match self.more_pictures() {
            0 => format!("dgtr: covered {} %, {holes}", self.percent()),
            n => format!("dgtr: covered {} %, {holes}, {}", self.percent(), count(n, "more picture")),
        };
        line.chars().take(LINE).collect()
    }

    /// Writes [`GAPS`] and, when there is something to fly and its place on earth is known, [`REFLIGHT`] into `out`; a re-flight
    /// of an earlier run that nobody needs any more is removed.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn write(&self, disk: &Disk, out: &Path) -> Result<Vec<PathBuf>, FormatError> {
        let (missing, again) = (out.join(GAPS), out.join(REFLIGHT));
        disk.replace(&missing, |to| geojson::write(to, &self.map, &self.gaps, self.origin))
            .map_err(|e| FormatError::disk(&missing, e))?;
        let squares = out.join(RASTER);
        match raster::encode(&self.map, self.origin) {
            Ok(bytes) => {
                disk.replace(&squares, |to| to.write_all(&bytes)).map_err(|e| FormatError::disk(&squares, e))?
            }
            Err(e) => tracing::warn!("{}: not written: {e}", squares.display()),
        }
        match self.flight_plan() {
            Some(plan) => {
                disk.replace(&again, |to| plan.write(to)).map_err(|e| FormatError::disk(&again, e))?;
                Ok(vec![missing, squares, again])
            }
            None => {
                let failed = |source| FormatError::Io { path: again.clone(), action: "removing", source };
                disk.remove(&again).map_err(failed)?;
                Ok(vec![missing, squares])
            }
        }
    }

    fn flight_plan(&self) -> Option<FlightPlan> {
        let (reflight, frame) = (self.reflight.as_ref()?, EnuFrame::new(self.origin?));
        let first = reflight.stations.first()?.center;
        let waypoint = |s: &reflight::Station| Waypoint {
            position: frame.to_geodetic(s.center),
            yaw_deg: s.yaw_deg,
            picture: true,
            every_m: None,
        };
        Some(FlightPlan {
            home: frame.to_geodetic(first.truncate().extend(self.home_m)),
            speed_m_s: SPEED_M_S,
            pitch_deg: Some(reflight.pitch_deg),
            waypoints: reflight.stations.iter().map(waypoint).collect(),
            landing: None,
        })
    }

    /// Notes the figures in a report.
    pub fn note(&self, report: &mut RunReport) {
        let of = |kind: GapKind| self.gaps.iter().filter(|g| g.kind == kind).count();
        let figures = serde_json::json!({
            "percent": self.percent(),
            "holes": of(GapKind::Hole),
            "thin": of(GapKind::Thin),
            "gaps_m2": self.gaps.iter().map(|g| g.area_m2).sum::<f64>(),
            "region_m2": self.map.area_m2(),
            "more_pictures": self.more_pictures(),
            "gaps_left": self.reflight.as_ref().map_or(0, |r| r.gaps_left),
        });
        report.more.insert("coverage".into(), figures);
    }
}

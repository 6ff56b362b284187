//! The page: what a job does, or what a mission, a demo or a benchmark came to. Map, aircraft, figures, pictures, times, what was
//! skipped, what went wrong. Live, a browser fetches it from the job (`watch`) and hears of changes; as `report.html` the same page
//! holds the same state inside, needs no network and opens from a USB stick.

use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use image::RgbImage;
use models::formats::{FormatError, write_atomic};

pub mod chart;
pub mod craft;
mod curve;
pub mod ground;
mod page;
pub mod picture;
mod text;

pub use craft::{Craft, Plot, Schedule, Thumbnail};
use ground::Ground;
pub use page::{SCRIPT, STYLE, live as live_page};
pub use text::{bytes, count, seconds};

/// The page's file in an output folder.
pub const REPORT: &str = "report.html";

/// Everything a report can show; empty parts leave no trace on the page.
#[derive(Clone, Debug, Default)]
pub struct ReportData {
    /// Heading.
    pub title: String,
    /// One line below it: mission, date, device.
    pub subtitle: String,
    /// The few figures that matter most, each as label and value.
    pub headline: Vec<(String, String)>,
    /// Regions and camera positions.
    pub map: Vec<MapRegion>,
    /// The aircraft as they are now, or were at the end.
    pub aircraft: Vec<Craft>,
    /// What else the map shows. Aircraft are counted as in `aircraft`, or in `map` where there are none.
    pub ground: Ground,
    /// One row per local model, then the global one.
    pub models: Vec<ModelRow>,
    /// Pictures side by side.
    pub comparisons: Vec<Comparison>,
    /// Where the time went.
    pub timings: Vec<Timing>,
    /// Work that was not needed, or input that could not be used: what, how often.
    pub skipped: Vec<(String, u64)>,
    /// What the reader should know before trusting the figures.
    pub warnings: Vec<String>,
    /// Curves.
    pub charts: Vec<chart::Chart>,
    /// Anything else in rows and columns.
    pub tables: Vec<Table>,
    /// Files that belong to the report: what, where.
    pub files: Vec<(String, PathBuf)>,
}

/// One aircraft's area on the map.
#[derive(Clone, Debug, Default)]
pub struct MapRegion {
    /// Name of the aircraft.
    pub name: String,
    /// Corners, metres east and north; may be empty.
    pub corners: Vec<[f64; 2]>,
    /// Camera positions, metres east and north.
    pub cameras: Vec<[f64; 2]>,
}

/// Figures of one model. None = not known, shown as a dash.
#[derive(Clone, Debug, Default)]
pub struct ModelRow {
    /// Aircraft, or `global`.
    pub name: String,
    /// Training views.
    pub views: Option<u64>,
    /// Gaussians.
    pub gaussians: Option<u64>,
    /// Optimiser steps.
    pub steps: Option<u64>,
    /// Seconds of work.
    pub seconds: Option<f64>,
    /// Held-out PSNR, dB.
    pub psnr: Option<f64>,
    /// Held-out SSIM.
    pub ssim: Option<f64>,
    /// Bytes that travelled to the ground.
    pub uploaded: Option<u64>,
    /// Bytes of the pictures that did not have to.
    pub pictures: Option<u64>,
}

/// Pictures of one view, side by side.
#[derive(Clone, Debug, Default)]
pub struct Comparison {
    /// Name of the view.
    pub title: String,
    /// What there is to see, or a figure; may be empty.
    pub note: String,
    /// Label and picture, left to right.
    pub panels: Vec<(String, RgbImage)>,
}

/// One bar of the time chart.
#[derive(Clone, Debug, Default)]
pub struct Timing {
    /// What took the time.
    pub name: String,
    /// Whose it is (a model's name), for the colour; empty = nobody's in particular.
    pub of: String,
    /// How long.
    pub seconds: f64,
}

/// A plain table. The first column is text, the others are aligned as figures.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// Heading.
    pub title: String,
    /// A sentence below the heading; may be empty.
    pub note: String,
    /// Column heads.
    pub head: Vec<String>,
    /// Cells.
    pub rows: Vec<Vec<String>>,
}

/// Why no report was written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A picture could not be encoded.
    #[error("report: picture {name:?} cannot be encoded: {source}")]
    Picture {
        /// Its title.
        name: String,
        /// The encoder's reason.
        source: image::ImageError,
    },
    /// The file could not be written.
    #[error(transparent)]
    Write(#[from] FormatError),
}

impl Error for ReportError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Picture { .. } => ErrorKind::Failed,
            Self::Write(e) => e.kind(),
        }
    }
}

impl ReportError {
    /// For `map_err` on encoders.
    fn picture(name: &str) -> impl FnOnce(image::ImageError) -> Self + '_ {
        move |source| Self::Picture { name: name.to_owned(), source }
    }
}

impl ReportData {
    /// The page as text, with everything inside.
    ///
    /// # Errors
    /// A picture that cannot be encoded (no pixels).
    pub fn to_html(&self) -> Result<String, ReportError> {
        page::frozen(self)
    }

    /// What the live page is told, without the ground and without pictures side by side.
    ///
    /// # Errors
    /// None at present: a live state holds no picture.
    pub fn live_json(&self) -> Result<serde_json::Value, ReportError> {
        page::state(self, false)
    }

    /// Writes the page, atomically.
    ///
    /// # Errors
    /// As [`ReportData::to_html`], or the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), ReportError> {
        let page = self.to_html()?;
        write_atomic(path, |out| out.write_all(page.as_bytes()))?;
        Ok(())
    }
}

#[cfg(test)]
mod tests;

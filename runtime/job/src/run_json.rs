//! `run.json`: what a job did and what it took, for scripts and for comparing runs. The schema is in `models/FORMATS.md`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use models::formats::{FormatError, read_bounded, write_atomic};
use serde::{Deserialize, Serialize};

/// Version of the schema; grows when a field changes its meaning.
const SCHEMA: u32 = 1;
/// A report has a few KiB.
const LIMIT: u64 = 16 << 20;

/// Memory that a job took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MemoryUse {
    /// Bytes of the memory plan.
    pub device_bytes_planned: u64,
    /// Bytes really allocated on the device at most.
    pub device_bytes_peak: u64,
    /// Largest resident set of the process, bytes.
    pub host_rss_peak: u64,
}

/// One job's figures.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunReport {
    /// Version of this schema.
    pub schema: u32,
    /// `train`, `fly`, `aggregate`, …
    pub command: String,
    /// `done`, `interrupted` or `failed`.
    pub outcome: String,
    /// Optimiser steps of this run.
    pub steps: u64,
    /// Wall clock of this run, seconds.
    pub wall_s: f64,
    /// Milliseconds by stage.
    pub stage_ms: BTreeMap<String, f64>,
    /// Gaussians in the written model.
    pub gaussians: u64,
    /// Training views.
    pub views: u64,
    /// Mean PSNR over the evaluated views, dB; null when none was evaluated.
    pub psnr: Option<f64>,
    /// Mean SSIM over the evaluated views; null when none was evaluated.
    pub ssim: Option<f64>,
    /// What was taken of device and host.
    #[serde(flatten)]
    pub memory: MemoryUse,
    /// How often each kind of work was skipped, or each kind of input left out.
    pub skipped: BTreeMap<String, u64>,
    /// Name of the Vulkan device; empty when none was used.
    pub device: String,
    /// Seed of the random choices.
    pub seed: u64,
    /// What only some commands have.
    #[serde(flatten)]
    pub more: BTreeMap<String, serde_json::Value>,
}

impl RunReport {
    /// An empty report of `command`.
    pub fn new(command: &str) -> Self {
        Self { schema: SCHEMA, command: command.to_owned(), outcome: "failed".to_owned(), ..Default::default() }
    }

    /// Adds what a stage took since `from`.
    pub fn stage(&mut self, name: &str, from: Instant) {
        *self.stage_ms.entry(name.to_owned()).or_default() += from.elapsed().as_secs_f64() * 1e3;
    }

    /// Adds to a counter of `skipped`.
    pub fn skip(&mut self, name: &str, count: u64) {
        *self.skipped.entry(name.to_owned()).or_default() += count;
    }

    /// Writes `dir/run.json`, atomically, with the memory the process has used so far.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn write(&mut self, dir: &Path) -> Result<PathBuf, FormatError> {
        self.memory.host_rss_peak = crate::resources::peak_rss_bytes().unwrap_or(0);
        let path = dir.join("run.json");
        write_atomic(&path, |out| {
            serde_json::to_writer_pretty(&mut *out, self)?;
            out.write_all(b"\n")
        })?;
        Ok(path)
    }

    /// Reads `dir/run.json`.
    ///
    /// # Errors
    /// It is missing, too large or not a report.
    pub fn read(dir: &Path) -> Result<Self, FormatError> {
        let path = dir.join("run.json");
        let bytes = read_bounded(&path, LIMIT)?;
        serde_json::from_slice(&bytes)
            .map_err(|e| FormatError::Invalid { path, what: format!("not a report of dgtr: {e}") })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_on_formats_states_this_version() {
        let row = format!("| `run.json` | schema {SCHEMA} |");
        assert!(include_str!("../../../models/FORMATS.md").contains(&row), "{row}");
    }

    #[test]
    fn a_report_has_the_promised_fields_and_comes_back() {
        let dir = tempfile::tempdir().unwrap();
        let mut report = RunReport::new("train");
        report.skip("frustum", 2);
        report.skip("frustum", 3);
        report.more.insert("loss".into(), 0.5.into());
        report.write(dir.path()).unwrap();
        let text = std::fs::read_to_string(dir.path().join("run.json")).unwrap();
        for field in [
            "steps",
            "wall_s",
            "stage_ms",
            "gaussians",
            "views",
            "psnr",
            "ssim",
            "device_bytes_planned",
            "device_bytes_peak",
            "host_rss_peak",
        ] {
            assert!(text.contains(&format!("\"{field}\"")), "{field}");
        }
        let back = RunReport::read(dir.path()).unwrap();
        assert_eq!(back, report);
        assert_eq!(back.skipped["frustum"], 5);
        assert!(back.memory.host_rss_peak > 0);
    }
}

//! The map of what is trained, drawn while the job goes on.

use std::path::Path;
use std::time::Instant;

use config::map::MapSettings;
use disk::Disk;
use job::run_json::RunReport;
use models::formats::model::ModelHeader;

use super::training::Training;
use crate::ortho::{Map, MapRequest};

/// Draws what is trained from above. Its absence costs no flight: what is in the way is a warning.
pub(super) fn draw(
    training: &mut Training,
    header: &ModelHeader,
    settings: MapSettings,
    (disk, folder): (&Disk, &Path),
    report: &mut RunReport,
) {
    let from = Instant::now();
    let request = MapRequest { most_pixels: Some(settings.pixels), ..MapRequest::default() };
    let drawn = Map::of(header, &training.cloud, &request)
        .and_then(|map| map.write(&mut training.trainer, header, (disk, folder), |_, _| true));
    if let Err(e) = drawn {
        tracing::warn!("no new map: {e}");
        report.skip("maps", 1);
    }
    report.stage("map", from);
}

//! The map of what is trained, drawn while the job goes on.

use std::path::Path;
use std::time::Instant;

use config::map::MapSettings;

use super::Reconstruction;
use crate::ortho::{Map, MapRequest};

impl Reconstruction {
    /// Draws what is trained from above. Its absence costs no flight: what is in the way is a warning.
    pub(super) fn draw_map(&mut self, settings: MapSettings, folder: &Path) {
        let from = Instant::now();
        self.mapped = self.builds;
        let request = MapRequest { most_pixels: Some(settings.pixels), ..MapRequest::default() };
        let drawn = Map::of(&self.header, &self.cloud, &request)
            .and_then(|map| map.write(&mut self.trainer, &self.header, (&self.settings.disk, folder), |_, _| true));
        if let Err(e) = drawn {
            tracing::warn!("no new map: {e}");
            self.report.skip("maps", 1);
        }
        self.report.stage("map", from);
    }
}

//! `[map]` of the mission file: when orthophoto and heights are drawn.

use crate::settings::{Limits, table};

table! {
    /// When orthophoto and heights are drawn.
    #[derive(Copy)]
    pub struct MapSettings {
        /// Most pixels of the map that an aircraft draws after each build; 0 = it draws none.
        pub pixels: u32 = 1_000_000, in Limits::within(0.0, 67_108_864.0),
            from "sheffield_cross: 0.24 m a pixel, 2.4 s for dgtr ortho with reading the model";
        /// The ground draws the merged scene, at the pixel size of the training pictures.
        pub ground: bool = true;
    }
}

impl MapSettings {
    /// Bytes of memory that drawing the aircraft's map takes (measured: `models/tests/map_memory.rs`).
    pub fn host_bytes(&self) -> u64 {
        if self.pixels == 0 { 0 } else { MEMORY_BYTES }
    }

    /// Bytes that it takes of the disk: the map before, the next one's blocks as they are drawn, and the next one.
    pub fn disk_bytes(&self) -> u64 {
        // Red, green, blue, alpha and a float; a third more for the overviews.
        let pixel = 8 * u64::from(self.pixels);
        2 * (pixel + pixel / 3) + pixel
    }
}

/// Blocks at hand, the small pictures, the writer's buffers.
const MEMORY_BYTES: u64 = 23 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_map_takes_nothing() {
        let none = MapSettings { pixels: 0, ..MapSettings::default() };
        assert_eq!((none.host_bytes(), none.disk_bytes()), (0, 0));
        assert!(MapSettings::default().host_bytes() > 0 && MapSettings::default().disk_bytes() > 8_000_000);
    }
}

//! A scene of more Gaussians than the device holds is trained in windows of cells.

use crate::settings::{Limits, table};

table! {
    /// Cells of ground, of which the device holds a window at a time with the views that see it.
    #[derive(Copy)]
    pub struct CellSettings {
        /// Updates for which the same cells stay on the device: one on as large a part of a picture as finds room, and then on other
        /// parts of pictures that show the same ground. The more, the less is read and written.
        pub updates: u32 = 1, in Limits::within(1.0, 65_536.0), unit "updates",
            from "sheffield_cross at a quarter after 300 updates: 24.0 dB with 1, 22.5 with 4, in 24 and 13 s";
        /// Cells that are made of what the device holds: more of them fit the views better, fewer cost less to keep.
        pub per_window: u32 = 1024, in Limits::within(4.0, 4096.0),
            from "sheffield_cross at a quarter after 600 updates: 24.6 dB with 916 cells, 25.0 with 1,712, 25.2 with 3,088";
    }
}

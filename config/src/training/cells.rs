//! A scene of more Gaussians than the device holds is trained in windows of cells.

use crate::settings::{Limits, table};

table! {
    /// Cells of ground, of which the device holds a window at a time with the views that see it.
    #[derive(Copy)]
    pub struct CellSettings {
        /// Steps for which the same cells stay on the device.
        pub steps: u32 = 4, in Limits::within(1.0, 65_536.0), unit "steps",
            from "sheffield_cross at a quarter: 16 steps fit a few pictures and forget the others, 0.8 dB less";
        /// Cells that are made of what the device holds: more of them fit the views better, fewer cost less to keep.
        pub per_window: u32 = 64, in Limits::within(4.0, 4096.0);
    }
}

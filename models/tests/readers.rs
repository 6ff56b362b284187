//! Every reader of `models` against broken files.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "readers/clouds.rs"]
mod clouds;
#[path = "readers/colmap.rs"]
mod colmap;
#[path = "readers/datasets.rs"]
mod datasets;
#[path = "../../tests/readers/driver.rs"]
mod driver;
#[path = "readers/pictures.rs"]
mod pictures;

//! Every reader of `survey` against broken files.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "readers/cards.rs"]
mod cards;
#[path = "../../../tests/readers/driver.rs"]
mod driver;
#[path = "readers/maps.rs"]
mod maps;
#[path = "readers/projects.rs"]
mod projects;

//! A scene of places so far apart that no picture shows two of them.
#![allow(dead_code, reason = "each test binary uses its own part")]

use glam::DVec3;
use models::camera::View;
use models::cloud::GaussianCloud;

use super::{cloud, view};

/// Metres between two of them.
pub const APART: f32 = 1000.0;

/// The 300 Gaussians of a place.
pub fn at(place: usize) -> GaussianCloud {
    let mut scene = cloud(8 + place as u64, 300, 3);
    scene.means.iter_mut().for_each(|m| m[0] += place as f32 * APART);
    scene
}

/// Three of them.
pub fn three_places() -> GaussianCloud {
    let mut all = at(0);
    (1..3).for_each(|place| all.extend(&at(place)));
    all
}

/// A camera at a place.
pub fn look(place: usize) -> View {
    let mut v = view(64, 48);
    v.pose.center += DVec3::X * f64::from(place as f32 * APART);
    v
}

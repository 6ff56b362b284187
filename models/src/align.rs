//! Bringing pointmaps into the aircraft's frame: the paper's global alignment (per-picture pointmaps χ and per-edge
//! scales σ), ICP for the global scale of the covariances, and nearest neighbours for the local one.

pub mod graph;
pub mod icp;
pub mod nearest;
pub mod sightings;
pub mod similarity;
pub mod solve;

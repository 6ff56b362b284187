//! From an area to the flights of a fleet.
//!
//! [`ground`] is an area in metres, [`rows`] its strips, [`lines`] the survey lines over them, [`obstacles`] what is flown round, [`pace`]
//! what flying takes, [`deal`] the regions that take equally long, [`sortie`] what one battery flies, [`flights`] its plan, [`figure`] a
//! picture of all, [`ring`] a region as one polygon.

pub mod deal;
mod error;
pub mod figure;
pub mod flights;
pub mod ground;
pub mod lines;
pub mod obstacles;
pub mod pace;
pub mod ring;
pub mod rows;
pub mod sortie;

pub use error::FleetError;

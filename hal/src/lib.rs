//! What stands between the runtime and the aircraft: pose, trigger, camera, clock and link, whatever autopilot,
//! camera or simulator is behind them, with honest times and uncertainties.
//!
//! The core (traits, MAVLink framing and decoding, rings, time filters, matcher, camera component, failsafe ladder)
//! is `no_std` without `alloc`: every capacity is in a type, nothing is allocated per message. Links and cameras
//! need the `std` feature; [`vehicle::Vehicle`] drives them all. Simulators, replay and fault injection are the crate
//! `sim`, which an aircraft flies without.
//!
//! MAVLink's NED/FRD never leaves this crate: poses are East-North-Up metres, body axes forward-left-up, camera
//! axes OpenCV (x right, y down, z forward). See [`frames`].
#![cfg_attr(not(feature = "std"), no_std)]

#[cfg(all(test, not(feature = "std")))]
extern crate std;

pub mod autopilot;
pub mod counters;
pub mod error;
pub mod failsafe;
pub mod frames;
pub mod matcher;
pub mod mavlink;
pub mod mavlink_camera;
pub mod peer;
pub mod pose;
pub mod time;
pub mod traits;
pub mod trigger;

#[cfg(feature = "std")]
pub mod blank;
#[cfg(feature = "std")]
pub mod camera;
#[cfg(feature = "std")]
pub mod link;
#[cfg(feature = "std")]
pub mod vehicle;

//! What every part of `dgtr` must agree on before the first frame: the mission file, presets and the fixed memory plan.
//!
//! Without the `std` feature only [`error`] remains; the `no_std` core of `hal` uses it.
#![cfg_attr(not(feature = "std"), no_std)]

#[cfg(feature = "std")]
pub mod budget;
#[cfg(feature = "std")]
pub mod coverage;
pub mod error;
#[cfg(feature = "std")]
pub mod failsafe;
#[cfg(feature = "std")]
pub mod faults;
#[cfg(feature = "std")]
pub mod ground;
#[cfg(feature = "std")]
pub mod http;
#[cfg(feature = "std")]
pub mod init;
#[cfg(feature = "std")]
pub mod kernels;
#[cfg(feature = "std")]
pub mod keys;
#[cfg(feature = "std")]
pub mod link;
#[cfg(feature = "std")]
pub mod map;
#[cfg(feature = "std")]
pub mod mission;
#[cfg(feature = "std")]
pub mod plan;
#[cfg(feature = "std")]
pub mod preset;
#[cfg(feature = "std")]
pub mod refine;
#[cfg(feature = "std")]
pub mod settings;
#[cfg(feature = "std")]
pub mod state;
#[cfg(feature = "std")]
pub mod survey;
#[cfg(feature = "std")]
pub mod training;
#[cfg(feature = "std")]
pub mod upload;

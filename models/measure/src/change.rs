//! What changed between two maps of one place.
//!
//! 1. [`register`]: the older map is moved onto the newer one over ground that did not change.
//! 2. [`compare`]: heights are compared, each difference with its standard deviation; a height that the other map has within a pixel or
//!    two is no difference, because edges never lie in the same pixel twice.
//! 3. [`spots`]: what differs together is one spot, with its area and its volume; spots that noise alone may make are dropped.

pub mod compare;
pub mod register;
pub mod spots;
pub mod write;

use crate::MeasureError;
use crate::heights::Heights;
use compare::Difference;
use register::Registration;
use spots::Spot;

/// Pixels compared at most: a dozen numbers are held of each.
pub const MOST_COMPARED: u64 = 1 << 26;

/// What changed.
pub struct Change {
    /// How the older map was moved.
    pub registration: Registration,
    /// Heights of the newer map less those of the older one.
    pub difference: Difference,
    /// What changed, largest volume first.
    pub spots: Vec<Spot>,
}

/// Compares two maps, on the pixels of the newer one.
///
/// # Errors
/// They have too little ground in common, or most of what they have in common changed.
pub fn find(old: &Heights, new: &Heights) -> Result<Change, MeasureError> {
    let registration = register::register(old, new)?;
    let difference = compare::compare(old, new, &registration);
    let spots = spots::find(&difference);
    Ok(Change { registration, difference, spots })
}

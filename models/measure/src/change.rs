//! What changed between two maps of one place.
//!
//! 1. [`register`]: the older map is moved onto the newer one over ground that did not change.
//! 2. [`compare`]: heights are compared, each difference with its standard deviation, by what both maps say of theirs; a height that the other map has within a pixel or
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

/// The map of one date.
pub struct Dated {
    /// Its heights.
    pub heights: Heights,
    /// Their standard deviations, on the same pixels; where there is none nothing vouches for a height, and it is not compared.
    pub sigmas: Option<Heights>,
}

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
/// They have too little ground in common, nothing vouches for it, or most of it changed.
pub fn find(old: &Dated, new: &Dated) -> Result<Change, MeasureError> {
    let registration = register::register(&old.heights, &new.heights)?;
    let difference = compare::compare(old, new, &registration);
    if difference.metres.iter().all(|m| m.is_nan()) {
        return Err(MeasureError::Request(
            "nothing vouches for the heights of any ground that both maps hold: their standard deviations have no value there".into(),
        ));
    }
    let spots = spots::find(&difference);
    Ok(Change { registration, difference, spots })
}

//! One cell's work: a pure job from what the plan says of it to what lies under the hash of that.

use super::cell::{self, Head, Report};
use crate::AggregateError;
use crate::block::Block;
use crate::distil::{Effort, distil};
use crate::merge::merge;
use crate::plan::Inputs;
use crate::store::Store;

/// A cell that was made now.
#[derive(Debug)]
pub struct Made {
    /// What it came to.
    pub head: Head,
    /// What it took.
    pub effort: Effort,
}

/// Merges a square of ground, distils its seams and puts it into `store`; None: asked to stop before it was done. Whoever makes the same
/// cell on the same kind of device writes the same bytes.
///
/// # Errors
/// The store's, or a device's: none, or one that cannot hold the plan.
pub fn make(
    inputs: &Inputs,
    store: &Store,
    device: Option<&str>,
    cancelled: &dyn Fn() -> bool,
) -> Result<Option<Made>, AggregateError> {
    let block = Block::new(inputs, store);
    let mut merged = merge(&block)?;
    let kept = std::mem::take(&mut merged.kept);
    let Some((learnt, effort)) = distil(&block, &mut merged, device, cancelled)? else { return Ok(None) };
    let inside = std::mem::take(&mut merged.inside);
    // What was trained may have moved over the border: where it was when it was merged counts.
    merged.cloud.retain(|i| inside[i]);
    let head = cell::write(store, &inputs.hash()?, Report { kept, learnt }, &merged.cloud)?;
    Ok(Some(Made { head, effort }))
}

//! What eight bits show of pictures that have sixteen, alike for all pictures of a set.

use std::path::Path;

use rayon::prelude::*;

use super::Dataset;
use models::picture::values::{Kind, ValueRange};

/// Finds the range of the values of 16-bit pictures, one for bands and one for colours, and says what is transparent.
pub(super) fn find(set: &mut Dataset) {
    let may_be_deep = |path: &Path| {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        ["png", "tif", "tiff", "webp"].contains(&extension.as_str())
    };
    // A picture that cannot be read is said where it is needed.
    let kind = |path: &Path| if may_be_deep(path) { Kind::of(path).unwrap_or_default() } else { Kind::default() };
    let kinds: Vec<Kind> = set.frames.par_iter().map(|frame| kind(&frame.path)).collect();
    for is_grey in [true, false] {
        let alike = |kind: &Kind| kind.is_deep && kind.is_grey == is_grey;
        let deep = set.frames.iter().zip(&kinds).filter(|(_, kind)| alike(kind));
        let paths: Vec<&Path> = deep.map(|(frame, _)| frame.path.as_path()).collect();
        let Some(range) = ValueRange::of(&paths) else { continue };
        tracing::info!(
            "{}: {} pictures of 16 bits, whose values from {} to {} are shown in 8",
            set.root.display(),
            paths.len(),
            range.low,
            range.high
        );
        for (frame, _) in set.frames.iter_mut().zip(&kinds).filter(|(_, kind)| alike(kind)) {
            frame.values = Some(range);
        }
    }
    let alpha = set.frames.iter().zip(&kinds).filter(|(f, kind)| kind.has_alpha && f.mask.is_none()).count();
    if alpha > 0 {
        tracing::info!(
            "{}: {alpha} of {} pictures have an alpha channel; what is transparent in it is masked",
            set.root.display(),
            set.frames.len()
        );
    }
}

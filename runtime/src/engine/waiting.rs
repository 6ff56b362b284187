//! What waits of pictures for the initialiser and for matching: in memory while that is little, else in a file of its own.

use std::fs::File;
use std::path::Path;

use config::init::InitSettings;
use config::mission::NetworkSettings;
use config::plan::PlanRequest;
use config::refine::RefineSettings;
use models::init::most_frame_bytes;

use super::device::scratch_file;
use crate::error::JobError;

/// Pictures and depths that wait for the initialiser in memory, bytes, and as many of what matching keeps of them; more of either wait
/// in a file.
const FRAMES_IN_MEMORY: u64 = 256 << 20;

/// Bytes of the file of what waits of so many pictures: none while it fits into memory.
pub(super) fn file_bytes(pictures: u64, each: u64) -> u64 {
    Some(pictures * each).filter(|waiting| *waiting > FRAMES_IN_MEMORY).unwrap_or(0)
}

/// The same of the file for what matching keeps.
pub fn matching_file_bytes(pictures: u64, refine: &RefineSettings) -> u64 {
    file_bytes(pictures, refine.kept_bytes())
}

/// A file in `folder` for so many bytes; none where nothing waits in one.
///
/// # Errors
/// The folder cannot be written to or has no room.
pub fn waiting_file(folder: &Path, bytes: u64) -> Result<Option<File>, JobError> {
    match bytes {
        0 => Ok(None),
        bytes => Ok(Some(scratch_file(folder, bytes)?)),
    }
}

/// Bytes of the scratch files of a job: views and cells that find no room on the device, what waits for the initialiser, and what
/// matching keeps.
pub fn scratch_bytes(
    request: &PlanRequest,
    init: &InitSettings,
    network: &NetworkSettings,
    refine: Option<&RefineSettings>,
) -> u64 {
    let each = most_frame_bytes(init, (request.width, request.height), network.pair.is_some());
    request.view_file_bytes()
        + request.scene_file_bytes()
        + file_bytes(request.views.into(), each)
        + refine.map_or(0, |refine| matching_file_bytes(request.views.into(), refine))
}

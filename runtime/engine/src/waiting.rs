//! What waits of pictures for the initialiser and for matching: in memory while that is little and the host has room for it, else in a
//! file of its own.

use std::fs::File;
use std::path::Path;

use config::init::InitSettings;
use config::mission::NetworkSettings;
use config::plan::{Plan, PlanRequest};
use config::refine::RefineSettings;
use models::init::{Initialiser, most_frame_bytes};
use models::refine::Refiner;

use super::EngineSettings;
use super::device::scratch_file;
use super::host::HostPlan;
use crate::error::EngineError;

/// Pictures and depths that wait for the initialiser in memory, bytes, and as many of what matching keeps of them; more of either wait
/// in a file.
const FRAMES_IN_MEMORY: u64 = 256 << 20;

/// Bytes of the file of what waits of so many pictures: none while it fits into memory.
pub(super) fn file_bytes(pictures: u64, each: u64) -> u64 {
    Some(pictures * each).filter(|waiting| *waiting > FRAMES_IN_MEMORY).unwrap_or(0)
}

/// Bytes of the file for what matching keeps of so many pictures.
pub fn matching_file_bytes(pictures: u64, refine: &RefineSettings) -> u64 {
    file_bytes(pictures, refine.kept_bytes())
}

/// A file in `folder` for so many bytes; none where nothing waits in one.
///
/// # Errors
/// The folder cannot be written to or has no room.
pub fn waiting_file(folder: &Path, bytes: u64) -> Result<Option<File>, EngineError> {
    match bytes {
        0 => Ok(None),
        bytes => Ok(Some(scratch_file(folder, bytes)?)),
    }
}

/// Decides where it waits, and gives what the host will hold: `plan` says that of the initialiser's bytes and of whether matching keeps its
/// pictures in a file.
///
/// # Errors
/// Even with files the host has too little memory; a file cannot be made or finds no room.
pub(super) fn place(
    settings: &EngineSettings,
    device: &Plan,
    mut initialiser: Option<&mut Initialiser>,
    mut refiner: Option<&mut Refiner>,
    plan: &dyn Fn(u64, bool) -> HostPlan,
) -> Result<HostPlan, EngineError> {
    let (size, pictures) = (settings.device.size, device.views as u64);
    let folder = settings.device.scratch_folder();
    let frames = initialiser.as_ref().map_or(0, |i| pictures * i.frame_bytes_at(size));
    let kept = refiner.as_ref().and(settings.refine.as_ref()).map_or(0, |refine| pictures * refine.kept_bytes());
    let much = |bytes: u64| bytes > FRAMES_IN_MEMORY;
    if let (Some(initialiser), true) = (&mut initialiser, much(frames)) {
        initialiser.keep_frames_in(scratch_file(&folder, frames)?);
    }
    if let (Some(refiner), true) = (&mut refiner, much(kept)) {
        refiner.keep_frames_in(scratch_file(&folder, kept)?);
    }
    let planned = |initialiser: &Option<&mut Initialiser>, in_file: bool| {
        plan(initialiser.as_ref().map_or(0, |i| i.planned_bytes_at(size, device.views, device.scene)), in_file)
    };
    // The disk's plan does not know of these.
    let file = |bytes: u64| {
        settings.disk.reserve(bytes).map_err(EngineError::io(&folder))?;
        tracing::info!("{} MiB of pictures wait in a file: the host's memory has no room for them", bytes >> 20);
        Ok::<_, EngineError>(scratch_file(&folder, bytes)?)
    };
    let mut host = planned(&initialiser, much(kept));
    if let (Some(own), true) = (&mut initialiser, host.fits(settings.device.memory.host_mib).is_err() && !much(frames))
    {
        own.keep_frames_in(file(frames)?);
        host = planned(&initialiser, much(kept));
    }
    if let (Some(refiner), true) = (&mut refiner, host.fits(settings.device.memory.host_mib).is_err() && !much(kept)) {
        refiner.keep_frames_in(file(kept)?);
        host = planned(&initialiser, true);
    }
    host.fits(settings.device.memory.host_mib)?;
    Ok(host)
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

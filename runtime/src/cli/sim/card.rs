//! A simulated card: the survey's pictures with the EXIF and XMP that a DJI aircraft writes, positions and angles as the
//! autopilot believed them. Every third picture has a
//! position only.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use geometry::geodesy::EnuFrame;
use glam::{DQuat, DVec3};
use models::formats::reconstruction::{LensDescription, Reconstruction, Shot};
use models::formats::transforms;
use sim::SimSettings;
use sim::photographer::{to_jpeg, write_whole};
use sim::reference::flown_views;
use sim::world::World;
use survey::card::write::Tags;

use crate::error::JobError;

/// Pictures per folder, as cameras do it.
const PER_FOLDER: usize = 999;
/// Every this many pictures one has no attitude.
const WITHOUT_ATTITUDE: usize = 3;
/// 2024-05-01 12:00:00, where the flight begins, seconds since 1970.
const START_S: u64 = 1_714_564_800;
/// Diagonal of a film picture, mm; EXIF rounds the equivalent focal length to whole millimetres.
const FILM_DIAGONAL_MM: f64 = 43.266_615;

/// Writes `DCIM/1xxMEDIA/DJI_nnnn.JPG` below `folder` and the truth beside them as `truth.json` (nerfstudio's transforms);
/// returns the number of pictures.
///
/// # Errors
/// Settings that allow no flight, or files that cannot be written.
pub fn write(settings: &SimSettings, folder: &Path, stop: &AtomicBool) -> Result<usize, JobError> {
    let flight = settings.flight().map_err(|e| JobError::Request(e.to_string()))?;
    let world = World::new(settings.world_seed, &settings.world);
    let frame = EnuFrame::new(flight.origin);
    let lens = &settings.lens;
    let diagonal = f64::from(lens.width).hypot(f64::from(lens.height));
    let mut shots = Vec::with_capacity(flight.exposures.len());
    for (i, (exposure, view)) in flight.exposures.iter().zip(flown_views(&flight, lens)).enumerate() {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        let believed = flight.reported.at(exposure.middle_s);
        let camera = sim::axes::camera_to_enu(believed.gimbal);
        let mut tags = Tags {
            camera: Some(("DJI".to_owned(), "dgtr sim".to_owned())),
            time_ns: Some(START_S * 1_000_000_000 + (exposure.middle_s * 1e9) as u64),
            position: Some(frame.to_geodetic(believed.position)),
            focal_35mm: Some((lens.fx / diagonal * FILM_DIAGONAL_MM).round() as u16),
            ..Tags::default()
        };
        if i % WITHOUT_ATTITUDE != WITHOUT_ATTITUDE - 1 {
            tags = tags.with_dji(yaw_pitch_roll(camera), believed.position.z);
        }
        let jpeg = to_jpeg(&world.render(&view).0).map_err(|e| JobError::System(e.to_string()))?;
        let jpeg = tags.into_jpeg(&jpeg).map_err(|e| JobError::System(e.to_string()))?;
        let media = format!("{}MEDIA", 100 + i / PER_FOLDER);
        let path = folder.join("DCIM").join(media).join(format!("DJI_{:04}.JPG", i % PER_FOLDER + 1));
        write_whole(&path, &jpeg).map_err(|e| JobError::System(e.to_string()))?;
        let intrinsics = models::camera::Intrinsics {
            width: lens.width,
            height: lens.height,
            fx: lens.fx as f32,
            fy: lens.fy as f32,
            cx: lens.cx as f32,
            cy: lens.cy as f32,
        };
        let lens = LensDescription::new(&intrinsics, geometry::lens::Distortion::default());
        let pose = models::camera::Pose { rotation: view.rotation, center: view.position };
        let path = path.strip_prefix(folder).unwrap_or(&path).to_string_lossy().into_owned();
        shots.push(Shot { path, lens, pose, mask: None });
    }
    let written = shots.len();
    transforms::write(&folder.join("truth.json"), &Reconstruction { shots, origin: Some(flight.origin) })?;
    Ok(written)
}

/// DJI's angles of a camera, degrees; one that looks straight down has no roll.
fn yaw_pitch_roll(camera: DQuat) -> [f64; 3] {
    let (forward, right) = (camera * DVec3::Z, camera * DVec3::X);
    [(-right.y).atan2(right.x), forward.z.clamp(-1.0, 1.0).asin(), (-right.z).clamp(-1.0, 1.0).asin()]
        .map(f64::to_degrees)
}

#[cfg(test)]
mod tests {
    use super::*;
    use models::formats::telemetry::dji_rotation;

    #[test]
    fn the_angles_written_are_those_that_are_read() {
        for (yaw, pitch) in [(0.0, -90.0), (130.0, -75.0), (-60.0, -30.0)] {
            let [y, p, r] = yaw_pitch_roll(dji_rotation(yaw, pitch, 0.0));
            assert!(dji_rotation(y, p, r).angle_between(dji_rotation(yaw, pitch, 0.0)) < 1e-6, "{y} {p} {r}");
        }
    }
}

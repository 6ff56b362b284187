//! The disk plan of an aircraft's output folder: what a whole flight may take, and the least with which one can begin.

use serde::Serialize;

/// Key frames without which nothing is built.
const MIN_KEY_FRAMES: u64 = 3;
/// Bytes of a key frame in the list: its pose twice, its deviations, its name.
const LIST_ENTRY: u64 = 2 << 10;
/// What a lossless picture takes beside its pixels when nothing can be compressed: a filter byte per row, headers, EXIF.
const PICTURE_OVERHEAD: u64 = 80 << 10;

/// The most that a picture of the camera may take, bytes: uncompressed.
pub fn picture_bytes(width: u32, height: u32) -> u64 {
    3 * u64::from(width) * u64::from(height) + PICTURE_OVERHEAD
}

/// A model's header per view (lens, pose, light, name), and its fixed part.
const MODEL_VIEW: u64 = 160;
const MODEL_FIXED: u64 = 4 << 10;
/// What is taken as a whole at the start.
const SCRATCH: &str = "scratch";
/// Written beside what the flight's own quota counts.
const REPORTS: &str = "reports";
const RECORDING: &str = "recording";
/// `run.json`, coverage as raster and GeoJSON of 65,536 squares, the page with its curves and the squares once more; per key frame its
/// line of the geotags and its outline on the page.
const REPORTS_FIXED: u64 = 8 << 20;
const REPORTS_VIEW: u64 = 512;
/// The small picture of a map, as it lies on the page: 8 MiB as text.
const REPORTS_MAP: u64 = 11 << 20;
/// Two generations, and the one being written.
const GENERATIONS: u64 = 3;

/// What will be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DiskRequest {
    /// Width of a picture as the camera writes it, pixels.
    pub width: u32,
    /// Height of one.
    pub height: u32,
    /// Most key frames.
    pub key_frames: u32,
    /// Bytes of scratch files: views that are not on the device, what waits of pictures for the initialiser.
    pub scratch: u64,
    /// Most Gaussians.
    pub gaussians: usize,
    /// Highest SH degree, 0…3.
    pub sh_degree: u8,
    /// Most bytes of a Gaussian as it is delivered; 0: the checkpoint itself is.
    pub delivered: usize,
    /// Bytes of the aircraft's map.
    pub map: u64,
    /// Most bytes of a recording of the flight in the same folder.
    pub recording: u64,
}

/// Bytes by what they are for; what a folder takes stays below.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct DiskPlan {
    /// Name and bytes.
    pub sections: Vec<(&'static str, u64)>,
    /// All of it.
    pub total_bytes: u64,
    /// The first key frames, and the first checkpoint while the second is written.
    pub min_bytes: u64,
}

/// Why a flight cannot begin.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "disk plan: {allowed_mib} MiB are too few for the first {MIN_KEY_FRAMES} key frames, two checkpoints and scratch files; at least \
     {needed_mib} MiB are needed (make room, raise memory.disk_mib, or lower keyframes.max, memory.image_scale or max_gaussians)"
)]
pub struct DiskPlanError {
    /// What there is.
    pub allowed_mib: u64,
    /// What the least takes.
    pub needed_mib: u64,
}

impl DiskPlan {
    /// The plan of a flight.
    pub fn new(r: &DiskRequest) -> Self {
        let frames = u64::from(r.key_frames);
        let picture = picture_bytes(r.width, r.height);
        let floats = 11 + 3 * (u64::from(r.sh_degree) + 1).pow(2);
        let model = |views: u64| 4 * floats * r.gaussians as u64 + MODEL_VIEW * views + MODEL_FIXED;
        let delivered = match r.delivered as u64 * r.gaussians as u64 {
            0 => 0,
            coded => coded + MODEL_VIEW * frames + MODEL_FIXED,
        };
        let sections = vec![
            ("key frames", frames * picture),
            ("their list", GENERATIONS * frames * LIST_ENTRY),
            (SCRATCH, r.scratch),
            ("checkpoints", GENERATIONS * model(frames)),
            // The one on offer, and the one being written.
            ("delivery", 2 * delivered),
            ("map", r.map),
            (REPORTS, REPORTS_FIXED + REPORTS_VIEW * frames + if r.map > 0 { REPORTS_MAP } else { 0 }),
            (RECORDING, r.recording),
        ];
        Self {
            total_bytes: sections.iter().map(|s| s.1).sum(),
            sections,
            // A recording that finds no room ends before the flight does.
            min_bytes: r.scratch
                + REPORTS_FIXED
                + MIN_KEY_FRAMES * (picture + GENERATIONS * LIST_ENTRY)
                + 2 * model(MIN_KEY_FRAMES),
        }
    }

    /// Bytes that are set aside at the start: of files without a name, and of those that are written when all else is.
    pub fn set_aside_bytes(&self) -> u64 {
        self.sections.iter().filter(|s| [SCRATCH, REPORTS, RECORDING].contains(&s.0)).map(|s| s.1).sum()
    }

    /// Whether a flight can begin with `bytes` to write to; false when it can, but not to its planned end.
    ///
    /// # Errors
    /// [`DiskPlanError`] when there is too little for a first model.
    pub fn fits(&self, bytes: u64) -> Result<bool, DiskPlanError> {
        if bytes < self.min_bytes {
            let (allowed_mib, needed_mib) = (bytes >> 20, self.min_bytes.div_ceil(1 << 20));
            return Err(DiskPlanError { allowed_mib, needed_mib });
        }
        Ok(bytes >= self.total_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flight_that_fits_begins_one_that_nearly_fits_is_told_and_one_without_room_is_refused() {
        let request = DiskRequest {
            width: 640,
            height: 480,
            key_frames: 128,
            scratch: 0,
            gaussians: 100_000,
            sh_degree: 3,
            delivered: 0,
            map: 0,
            recording: 0,
        };
        let plan = DiskPlan::new(&request);
        // 128 pictures of 921,600 bytes, three models of 23.6 MB, reports.
        assert!((196 << 20..206 << 20).contains(&plan.total_bytes), "{}", plan.total_bytes);
        assert_eq!(plan.fits(plan.total_bytes), Ok(true));
        assert_eq!(plan.fits(plan.total_bytes - 1), Ok(false));
        assert_eq!(plan.fits(plan.min_bytes), Ok(false));
        let said = plan.fits(plan.min_bytes - 1).map_err(|e| e.to_string()).unwrap_err();
        assert!(said.contains("memory.disk_mib") && said.lines().count() == 1, "{said}");
        let paged = DiskPlan::new(&DiskRequest { scratch: 1 << 28, ..request });
        assert_eq!(paged.set_aside_bytes() - plan.set_aside_bytes(), 1 << 28);
        assert_eq!(paged.min_bytes - plan.min_bytes, 1 << 28);
        assert_eq!(paged.total_bytes - plan.total_bytes, 1 << 28);
        let delivers = DiskPlan::new(&DiskRequest { delivered: 32, ..request });
        assert!(delivers.total_bytes >= plan.total_bytes + 2 * 32 * 100_000);
        let drawn = DiskPlan::new(&DiskRequest { map: 1 << 25, ..request });
        assert_eq!(drawn.total_bytes - plan.total_bytes, (1 << 25) + REPORTS_MAP);
        let recorded = DiskPlan::new(&DiskRequest { recording: 1 << 28, ..request });
        assert_eq!((recorded.total_bytes - plan.total_bytes, recorded.min_bytes), (1 << 28, plan.min_bytes));
        assert_eq!(recorded.set_aside_bytes() - plan.set_aside_bytes(), 1 << 28);
    }
}

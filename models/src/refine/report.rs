//! What the refiner did and what came of it, for logs and `run.json`.

use glam::DVec3;
use serde::Serialize;

use super::calibration::LENS;

/// One key frame's arrival.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct AddReport {
    /// Key points kept.
    pub features: usize,
    /// Pairs of key frames whose descriptors were compared.
    pub pairs_tried: usize,
    /// Pairs that agree with one relative pose.
    pub pairs_verified: usize,
    /// Verified pairs that a rotation alone explains.
    pub pairs_without_baseline: usize,
    /// Mutual nearest neighbours over all tried pairs.
    pub matches: usize,
    /// Matches that agree with their pair's relative pose.
    pub inliers: usize,
    /// Its telemetry rotation contradicts the pictures, or that of the frames before does.
    pub contradicted: bool,
    /// Matches dropped by the relative pose or because their surroundings differ.
    pub unsettled: usize,
    /// Inliers refused because a track would hold two places of one picture.
    pub conflicting: usize,
    /// Runs of the feature network (more than one when the picture had to be turned).
    pub extractions: usize,
    /// Wall time in the feature network.
    pub extract_seconds: f64,
    /// Wall time matching and verifying.
    pub match_seconds: f64,
}

/// What a look at the newest key frames did; nothing in it grows with the key frames before them.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct NearReport {
    /// Key frames that came, or were first linked, since the last solve.
    pub frames: usize,
    /// Key frames that moved in the adjustment, those among them.
    pub adjusted_frames: usize,
    /// Sightings in the adjustment.
    pub observations: usize,
    /// Levenberg–Marquardt steps.
    pub steps: u32,
    /// Frames placed from points because their telemetry position was far off.
    pub replaced_frames: usize,
    /// Names of the key frames whose poses may have changed.
    pub moved: Vec<String>,
    /// Wall time.
    pub solve_seconds: f64,
}

/// State after a solve; counts are totals since the refiner was opened.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RefineReport {
    /// Key frames held.
    pub frames: usize,
    /// Of these, frames with a verified pair.
    pub frames_linked: usize,
    /// Of these, frames with enough points to be held by pictures.
    pub frames_tied: usize,
    /// Key frames refused for an unusable pose, sigma or lens.
    pub frames_invalid: usize,
    /// Key frames refused because the cap was reached.
    pub frames_over_cap: usize,
    /// Frames placed from points because their telemetry position was far off.
    pub replaced_frames: usize,
    /// Frames whose telemetry rotation contradicts the majority.
    pub rotations_refused: usize,
    /// See [`AddReport`].
    pub pairs_tried: usize,
    /// See [`AddReport`].
    pub pairs_verified: usize,
    /// See [`AddReport`].
    pub pairs_without_baseline: usize,
    /// See [`AddReport`].
    pub matches: usize,
    /// See [`AddReport`].
    pub inliers: usize,
    /// Tracks without contradiction.
    pub tracks: usize,
    /// Matches refused because a track would hold two places of one picture.
    pub conflicting_matches: usize,
    /// Tracks in the bundle adjustment.
    pub adjusted_tracks: usize,
    /// Points in [`super::Refiner::sparse_points`].
    pub points: usize,
    /// Sightings of these points.
    pub observations: usize,
    /// Sightings left out because they do not fit.
    pub outlier_observations: usize,
    /// Sightings left out because of the cap.
    pub observations_over_cap: usize,
    /// Root mean square reprojection error of the kept sightings, pixels.
    pub reprojection_rms_px: f64,
    /// Median reprojection error of the kept sightings, pixels.
    pub reprojection_median_px: f64,
    /// Levenberg–Marquardt steps of this solve.
    pub steps: u32,
    /// The last stage came to rest before steps or time ran out.
    pub converged: bool,
    /// Height of the ground, world metres.
    pub ground_m: Option<f64>,
    /// How surveyed points and pictures agree.
    pub control: Vec<ControlResidual>,
    /// What all frames share.
    pub shared: SharedEstimate,
    /// Wall time in the feature network.
    pub extract_seconds: f64,
    /// Wall time matching and verifying.
    pub match_seconds: f64,
    /// Wall time of this solve.
    pub solve_seconds: f64,
}

impl RefineReport {
    pub(super) fn absorb(&mut self, add: &AddReport) {
        self.pairs_tried += add.pairs_tried;
        self.pairs_verified += add.pairs_verified;
        self.pairs_without_baseline += add.pairs_without_baseline;
        self.matches += add.matches;
        self.inliers += add.inliers;
        self.conflicting_matches += add.conflicting;
        self.extract_seconds += add.extract_seconds;
        self.match_seconds += add.match_seconds;
    }
}

/// Errors of telemetry that all frames share. A value that was not estimated is neutral.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SharedEstimate {
    /// Camera-mount misalignment about the camera's axes, degrees: true rotation = telemetry · mount.
    pub mount_deg: [f64; 3],
    /// Standard deviation the pictures would leave, degrees.
    pub mount_sigma_deg: [f64; 3],
    /// Which axes were estimated.
    pub mount_estimated: [bool; 3],
    /// True position = reported + delay · velocity, seconds (metres along track without times).
    pub delay_s: f64,
    /// Standard deviation the pictures would leave.
    pub delay_sigma_s: f64,
    /// Whether it was estimated.
    pub delay_estimated: bool,
    /// True over given focal length.
    pub focal_scale: f64,
    /// Standard deviation (relative) the pictures would leave.
    pub focal_sigma: f64,
    /// Whether it was estimated.
    pub focal_estimated: bool,
    /// True over given fy / fx.
    pub aspect: f64,
    /// Standard deviation (relative) the pictures would leave.
    pub aspect_sigma: f64,
    /// Whether it was estimated.
    pub aspect_estimated: bool,
    /// True less given principal point along x and y, in focal lengths.
    pub principal: [f64; 2],
    /// Standard deviation the pictures would leave.
    pub principal_sigma: [f64; 2],
    /// Which were estimated.
    pub principal_estimated: [bool; 2],
    /// First and second radial term that the given lens lacks (OpenCV's k1, k2).
    pub radial: [f64; 2],
    /// Standard deviation the pictures would leave.
    pub radial_sigma: [f64; 2],
    /// Which were estimated.
    pub radial_estimated: [bool; 2],
}

/// A triangulated point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RefinedPoint {
    /// ENU metres.
    pub position: [f64; 3],
    /// Mean colour of its sightings, 8-bit sRGB.
    pub color: [u8; 3],
    /// Key frames that see it.
    pub views: u32,
    /// Root mean square reprojection error, pixels.
    pub error_px: f32,
    /// Largest angle between two of its rays, degrees.
    pub angle_deg: f32,
}

/// How a surveyed point and the pictures agree after a solve.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ControlResidual {
    /// What the survey calls it.
    pub name: String,
    /// Pictures that agree on where it is; below two it has no part.
    pub views: usize,
    /// Where the pictures see it less where it was surveyed: east, north, up, metres; zero without two views.
    pub off_m: [f64; 3],
    /// Root mean square distance of its marks, pixels.
    pub error_px: f64,
}

/// How well a picture's pose is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PosePrecision {
    /// Standard deviations east, north and up, in the scene's units: within the scene where nothing says where that is.
    pub position: [f64; 3],
    /// The equations of the adjustment have been asked, not only its two halves: of too many pictures they are not, and `position` is
    /// then no more than what the halves differ by.
    pub by_equations: bool,
    /// Standard deviations about the camera's axes (right, down, forward), degrees; `None` where nothing says how the scene lies, or
    /// the equations have not been asked.
    pub rotation_deg: Option<[f64; 3]>,
}

impl PosePrecision {
    /// Standard deviation of the place, all axes together.
    pub fn distance(&self) -> f64 {
        DVec3::from_array(self.position).length()
    }
}

/// Parameters of a lens, in the order of [`LensPrecision`].
pub const LENS_PARAMETERS: [&str; LENS] = ["focal", "aspect", "principal_x", "principal_y", "k1", "k2"];

/// How well the lens that all pictures share is known: focal length and aspect relative, principal point in focal lengths, radial terms
/// as OpenCV's. What was given as exact has no standard deviation and no correlation.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LensPrecision {
    /// What each row stands for.
    pub parameters: [&'static str; LENS],
    /// Standard deviation of each.
    pub sigma: [f64; LENS],
    /// Correlations of all with all.
    pub correlation: [[f64; LENS]; LENS],
    /// Standard deviation of a key point along an axis, from what is left of the sightings, pixels.
    pub sighting_sigma_px: f64,
    /// By how much it is multiplied, for sightings of one picture that err alike.
    pub dependence: f64,
}

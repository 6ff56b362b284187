//! Host memory of a job, planned like the device's: what it will hold at most, by a formula, before the first picture.
//!
//! ```text
//! B + initialiser(V, N) + matching(V, features, observations) + 2·4·N·(11 + 3D) + 20·R (+ 8·R + cells) + A·3·(P [+ C]) + 2·3·C (+ device) (+ delivery·N)
//! ```
//!
//! V views, N Gaussians of the scene, R on the device (where N > R), D = (SH degree + 1)², P pixels of a training picture, C of the camera's, A pictures decoded ahead.

use config::plan::Plan;
use config::refine::RefineSettings;
use models::formats::delivery::ENCODING_BYTES;
use models::formats::model::piece_bytes;

use crate::error::EngineError;

/// Program, driver and Vulkan loader, resident (measured on x86-64 with lavapipe: 60 MiB, rounded up).
const PROGRAM_BYTES: u64 = 96 << 20;
/// The feature network, once upright and once on its side, on pictures of 640 pixels (measured: 26 MiB a session); maps of larger ones
/// take more in proportion.
const FEATURES_BYTES: u64 = 2 * (32 << 20);
/// The trainer's own lists per Gaussian: density control and SH degrees.
const LISTS_BYTES: u64 = 20;

/// What a job will hold.
#[derive(Clone, Copy, Debug)]
pub struct HostRequest<'a> {
    /// Plan of the device.
    pub plan: &'a Plan,
    /// Bytes of the host's memory that the device takes: all of its plan where it is a software renderer, a mirror of what the host
    /// works on where it is a card.
    pub on_host: u64,
    /// The initialiser's own plan, bytes.
    pub initialiser: u64,
    /// `[refine]`, when poses are refined.
    pub refine: Option<&'a RefineSettings>,
    /// What is large of matching's key frames waits in a file.
    pub refine_in_file: bool,
    /// Pixels of a picture as it leaves the camera.
    pub camera_pixels: u64,
    /// Pictures decoded ahead of the engine, at training size.
    pub ahead: u64,
    /// The camera's own pictures wait in memory beside them (those of a folder wait there).
    pub ahead_in_memory: bool,
    /// Models are quantised for delivery, beside all else.
    pub delivers: bool,
    /// The first Gaussians come out of a model's file and go into the next one piece by piece: two pieces take the place of the cloud and
    /// its checkpoint.
    pub from_file: bool,
    /// Bytes that drawing the map takes, when nothing is rounded.
    pub map: u64,
}

/// Bytes of matching so many key frames: per feature 100, 64 of them its descriptor's, per observation 250 ([`RefineSettings`]).
fn matching_bytes(s: &RefineSettings, keyframes: u64, in_file: bool) -> u64 {
    let kept = if in_file { 0 } else { s.kept_bytes() };
    let observations = (s.max_observations as u64).min(keyframes * s.max_features as u64);
    let side = u64::from(s.feature_side);
    (FEATURES_BYTES * side * side / (640 * 640)).max(FEATURES_BYTES)
        + keyframes * (s.max_features as u64 * 36 + kept)
        + observations * 250
}

/// Host memory of settling a card's poses, before a device is opened: `ahead` pictures of `pixels` are at hand at once.
pub fn settling_bytes(s: &RefineSettings, pictures: u64, in_file: bool, (ahead, pixels): (u64, u64)) -> u64 {
    PROGRAM_BYTES + matching_bytes(s, pictures, in_file) + ahead * 3 * pixels
}

/// Bytes by what holds them, in the order of the formula.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HostPlan {
    /// Name and bytes.
    pub sections: Vec<(&'static str, u64)>,
}

impl HostPlan {
    /// The formula above.
    pub fn new(r: &HostRequest<'_>) -> Self {
        let (n, v, p) = (r.plan.scene as u64, r.plan.views as u64, r.plan.pixels as u64);
        let coefficients = (u64::from(r.plan.sh_degree) + 1).pow(2);
        let matching = r.refine.map_or(0, |s| matching_bytes(s, v, r.refine_in_file));
        let sections = vec![
            ("program", PROGRAM_BYTES),
            ("initialisation", r.initialiser),
            ("matching", matching),
            (
                "cloud and checkpoint",
                2 * if r.from_file { piece_bytes(r.plan.sh_degree) } else { 4 * n * (11 + 3 * coefficients) },
            ),
            ("density control", LISTS_BYTES * r.plan.gaussians as u64),
            ("cells", r.plan.scene_lists_bytes()),
            ("pictures ahead", r.ahead * 3 * (p + if r.ahead_in_memory { r.camera_pixels } else { 0 })),
            ("picture at hand", 2 * 3 * r.camera_pixels),
            (
                "delivery, or map",
                r.map.max(match r.delivers {
                    true => n * (ENCODING_BYTES as u64 + 4 * (11 + 3 * coefficients)),
                    false => 0,
                }),
            ),
            ("device", r.on_host),
        ];
        Self { sections }
    }

    /// All of them.
    pub fn total_bytes(&self) -> u64 {
        self.sections.iter().map(|s| s.1).sum()
    }

    /// Whether it stays within `host_mib`, when there is a bound.
    ///
    /// # Errors
    /// [`EngineError::HostMemory`] with what would do and what takes most.
    pub fn fits(&self, host_mib: Option<u32>) -> Result<(), EngineError> {
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        let (needed_mib, largest) = (mib(self.total_bytes()), self.sections.iter().copied().max_by_key(|s| s.1));
        match (host_mib, largest) {
            (Some(host_mib), Some((section, bytes))) if needed_mib > host_mib.into() => {
                Err(EngineError::HostMemory { host_mib, needed_mib, section, section_mib: mib(bytes) })
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use config::plan::PlanRequest;

    use super::*;
    use crate::matching_file_bytes;

    fn total(plan: &Plan, of: impl Fn(&mut HostRequest<'_>)) -> u64 {
        let refine = RefineSettings::default();
        let mut request = HostRequest {
            plan,
            on_host: 0,
            initialiser: 100 << 20,
            refine: Some(&refine),
            refine_in_file: false,
            camera_pixels: 640 * 480,
            ahead: 4,
            ahead_in_memory: false,
            delivers: false,
            from_file: false,
            map: 0,
        };
        of(&mut request);
        HostPlan::new(&request).total_bytes()
    }

    fn refine_kept() -> u64 {
        RefineSettings::default().kept_bytes()
    }

    #[test]
    fn every_term_of_the_host_plan_counts_and_a_software_device_lies_on_the_host() {
        let plan = Plan::new(&PlanRequest::default()).unwrap();
        let before = total(&plan, |_| {});
        assert_eq!(total(&plan, |r| r.on_host = plan.total_bytes) - before, plan.total_bytes);
        assert_eq!(total(&plan, |r| r.ahead += 1) - before, 3 * plan.pixels as u64);
        assert_eq!(total(&plan, |r| r.ahead_in_memory = true) - before, 4 * 3 * 640 * 480);
        assert_eq!(total(&plan, |r| r.camera_pixels += 1000) - before, 6000);
        let delivery = plan.gaussians as u64 * (ENCODING_BYTES as u64 + 4 * (11 + 48));
        assert_eq!(total(&plan, |r| r.delivers = true) - before, delivery);
        assert_eq!(total(&plan, |r| r.map = 1 << 20) - before, 1 << 20);
        let paged = Plan::new(&PlanRequest { scene_gaussians: Some(5_000_000), ..PlanRequest::default() }).unwrap();
        let from_file = total(&paged, |r| (r.from_file, r.refine, r.initialiser) = (true, None, 0));
        assert!(from_file < 128 << 20, "{from_file} bytes of the host for five million Gaussians");
        assert_eq!(
            total(&paged, |_| {}) - total(&paged, |r| r.from_file = true),
            2 * 5_000_000 * 236 - 2 * piece_bytes(3)
        );
        let kept = plan.views as u64 * refine_kept();
        assert_eq!(before - total(&plan, |r| r.refine_in_file = true), kept);
        assert!(total(&plan, |r| r.refine = None) < before && total(&plan, |r| r.initialiser = 0) < before);
        let larger = Plan::new(&PlanRequest { device_mib: 1024, ..PlanRequest::default() }).unwrap();
        let more = (larger.gaussians - plan.gaussians) as u64;
        assert_eq!(total(&larger, |_| {}) - before, more * (2 * 4 * (11 + 48) + 20));
    }

    #[test]
    fn what_matching_keeps_of_a_card_s_pictures_waits_in_a_file_beyond_a_quarter_of_a_gibibyte() {
        let refine = RefineSettings { feature_side: 1280, max_features: 2000, ..RefineSettings::default() };
        let each = refine.kept_bytes();
        assert_eq!(matching_file_bytes(100, &refine), 0, "{} MiB stay in memory", (100 * each) >> 20);
        assert_eq!(matching_file_bytes(1000, &refine), 1000 * each);
        let settling = |pictures, in_file| settling_bytes(&refine, pictures, in_file, (3, 3_000_000));
        // In a file a picture more is its key points and nothing else.
        assert_eq!(settling(1000, true) - settling(900, true), 100 * 36 * 2000);
        assert_eq!(settling(1000, false) - settling(1000, true), 1000 * each);
    }

    #[test]
    fn the_defaults_of_a_mission_fit_into_its_default_host_memory() {
        let memory = config::mission::MemorySettings::default();
        let views = config::mission::KeyframeSettings::default().max;
        let request = PlanRequest { device_mib: memory.device_mib(), views, ..PlanRequest::default() };
        let plan = Plan::new(&request).unwrap();
        // On a software device, with a camera of 12 megapixels; the initialiser's plan as `dgtr fly` names it, and as many
        // pictures decoded ahead as it asks for, rounded up.
        let defaults = |r: &mut HostRequest<'_>| {
            (r.on_host, r.initialiser, r.camera_pixels, r.ahead) = (plan.total_bytes, 909 << 20, 4056 * 3040, 24);
            r.map = config::map::MapSettings::default().host_bytes();
        };
        let bytes = total(&plan, defaults);
        let allowed = u64::from(memory.host_mib) << 20;
        assert!(bytes <= allowed, "{} KiB too many", (bytes - allowed) >> 10);
    }

    #[test]
    fn a_plan_beyond_host_mib_is_refused_with_what_would_do() {
        let plan = HostPlan { sections: vec![("program", 96 << 20), ("initialisation", (300 << 20) + 1)] };
        assert!(plan.fits(None).is_ok() && plan.fits(Some(397)).is_ok());
        let refused = plan.fits(Some(396)).unwrap_err();
        assert_eq!(config::error::Error::kind(&refused), config::error::ErrorKind::Input);
        let line = refused.to_string();
        assert!(
            line.contains("host_mib = 396") && line.contains("397 MiB") && line.contains("initialisation"),
            "{line}"
        );
    }
}

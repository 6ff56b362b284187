//! What a ground station of many aircraft takes: simulated models of a field are handed to `dgtr serve` as aircraft hand theirs, the
//! first half, then, after a restart, the others. Every model lies where its own GPS would have put it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use config::error::{Error, ErrorKind};
use config::geodesy::Geodetic;
use config::mission::{MAX_AIRCRAFT, Mission};
use glam::{DQuat, DVec2, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use serde::Serialize;

use super::child;
use super::figures::write_text;
use crate::aggregate::frame::Motion;
use crate::error::JobError;
use crate::run_json::RunReport;
use crate::upload::{Offerer, Source};

/// Ground that an aircraft sees beyond its region, as a share of the region's side: neighbours share a fifth of it.
const BEYOND: f64 = 0.1;
/// What is wrong with an aircraft's GPS at most: metres along each axis, and radians of heading.
const ERROR_M: f64 = 2.0;
const ERROR_RAD: f64 = 0.017;
/// Height of flight as a share of the side of a region.
const HEIGHT: f64 = 0.4;
/// Views along a side of the ground that an aircraft sees.
const VIEWS: usize = 4;
/// Their size, pixels.
const SIZE: [u32; 2] = [320, 240];
/// Aircraft whose seconds are compared: the first and the last so many.
const COMPARED: usize = 50;
/// Longest time for one model to lie on the stick.
const OFFERED: Duration = Duration::from_secs(60);

/// The field.
#[derive(Clone, Debug)]
pub struct Field {
    /// Aircraft; as nearly a square of regions as there are.
    pub aircraft: usize,
    /// Side of the field, metres.
    pub side_m: f64,
    /// Gaussians of each model.
    pub gaussians: usize,
    /// Host memory of the ground station.
    pub limit_mib: u64,
    /// Seed of the ground's colours and of what is wrong with the GPS.
    pub seed: u64,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct GroundScores {
    /// Aircraft.
    pub aircraft: usize,
    /// Gaussians handed over, and in the global model.
    pub gaussians: [usize; 2],
    /// Pairs of models whose ground overlaps.
    pub pairs: u64,
    /// Fitted before the restart, and after it.
    pub fitted: [usize; 2],
    /// Seconds that a model took from its arrival until it was fitted: mean of the first and of the last aircraft.
    pub joined_s: [f64; 2],
    /// Fits of each of those, mean: the field fills, so that the last ones find more neighbours there.
    pub joined_fits: [f64; 2],
    /// Models of each of both.
    pub compared: usize,
    /// Seconds by stage of the second start.
    pub stage_s: Vec<(String, f64)>,
    /// Largest resident set of both starts, MiB.
    pub rss_mib: f64,
    /// Root mean square distance of neighbours' errors: as they came, and in the global model, metres.
    pub apart_m: [f64; 2],
    /// The least share of its Gaussians that a region has in the global model.
    pub least_region: f64,
}

impl Field {
    fn columns(&self) -> usize {
        (self.aircraft as f64).sqrt().ceil() as usize
    }

    /// Side of a region, metres.
    fn pitch(&self) -> f64 {
        self.side_m / self.columns() as f64
    }

    /// Gaussians along the side of a model: so many that all models lie on one grid.
    fn along(&self) -> usize {
        let of_region = (self.gaussians as f64).sqrt() / (1.0 + 2.0 * BEYOND);
        24 * (of_region / 20.0).floor().max(1.0) as usize
    }

    fn corner(&self, i: usize) -> DVec2 {
        DVec2::new((i % self.columns()) as f64, (i / self.columns()) as f64) * self.pitch()
    }

    /// Beside and above.
    fn neighbours(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let columns = self.columns();
        (0..self.aircraft).flat_map(move |i| {
            let beside = Some(i + 1).filter(|j| j % columns != 0);
            [beside, Some(i + columns)].into_iter().flatten().filter(|j| *j < self.aircraft).map(move |j| (i, j))
        })
    }

    /// A number of −1…1 that depends on the seed and on two others.
    fn noise(&self, a: i64, b: i64) -> f64 {
        let mut x =
            self.seed ^ (a as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (b as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// What is wrong with the place of an aircraft.
    fn error(&self, i: usize) -> Motion {
        let wrong = |k: i64| self.noise(-1 - i as i64, k);
        let middle = (self.corner(i) + 0.5 * self.pitch()).extend(0.0);
        let turn = DQuat::from_rotation_z(ERROR_RAD * wrong(3));
        let shift = ERROR_M * DVec3::new(wrong(0), wrong(1), wrong(2));
        Motion::rigid(turn, middle + shift - turn * middle)
    }

    /// The model of one aircraft, where its GPS puts it.
    fn model(&self, i: usize) -> (ModelHeader, GaussianCloud) {
        let (low, side) = (self.corner(i) - BEYOND * self.pitch(), (1.0 + 2.0 * BEYOND) * self.pitch());
        let along = self.along();
        let spacing = side / along as f64;
        // They cover each other's gaps, as trained ones do: through a gap nothing is lifted.
        let sigma = (0.6 * spacing as f32).ln();
        let mut cloud = GaussianCloud::with_capacity(1, along * along);
        for row in 0..along {
            for column in 0..along {
                let p = low + (DVec2::new(column as f64, row as f64) + 0.5) * spacing;
                // What is there is the same for all: the ground is patched, every patch two Gaussians wide.
                let patch = (p / (2.0 * spacing)).floor();
                let mut sh = [0.0f32; 12];
                for (k, v) in sh.iter_mut().enumerate() {
                    let of = 16 * patch.y as i64 + k as i64;
                    *v = (self.noise(patch.x as i64, of) * if k < 3 { 1.4 } else { 0.02 }) as f32;
                }
                let z = 1.5 * (0.07 * p.x).sin() * (0.05 * p.y).cos();
                let mean = p.extend(z).as_vec3().to_array();
                cloud.push(mean, [sigma, sigma, sigma - 2.0], [1.0, 0.0, 0.0, 0.0], 4.0, &sh);
            }
        }
        let views = (0..VIEWS * VIEWS).map(|v| {
            let at = DVec2::new((v % VIEWS) as f64, (v / VIEWS) as f64) + 0.5;
            (format!("{}-{v}.jpg", id(i)), nadir(low + at * (side / VIEWS as f64), HEIGHT * self.pitch()))
        });
        let mut header = ModelHeader {
            mission: MISSION.into(),
            aircraft: id(i),
            origin: Some(ORIGIN),
            views: views.collect(),
            steps: 1000,
            finished: true,
            ..Default::default()
        };
        let error = self.error(i);
        error.cloud(&mut cloud);
        error.header(&mut header);
        (header, cloud)
    }

    fn mission(&self) -> String {
        let [w, h] = SIZE;
        let mut text = format!(
            "name = {MISSION:?}\norigin = {{ lat_deg = {}, lon_deg = {}, alt_m = {} }}\n\
             camera = {{ width = {w}, height = {h}, fx = {FOCAL:.1}, fy = {FOCAL:.1}, cx = {}.0, cy = {}.0 }}\n\
             upload = {{ folder = \"stick\", poll_s = 0.2 }}\nground = {{ epochs = 0, seed = {} }}\nmap = {{ ground = false }}\n",
            ORIGIN.lat_deg,
            ORIGIN.lon_deg,
            ORIGIN.alt_m,
            w / 2,
            h / 2,
            self.seed
        );
        for i in 0..self.aircraft {
            let (c, p) = (self.corner(i), self.pitch());
            text += &format!(
                "[[aircraft]]\nid = {:?}\nlink = \"udpin:127.0.0.1:14550\"\ncamera = {{ folder = \"pictures\" }}\n\
                 region_enu = [[{x:?}, {y:?}], [{x1:?}, {y:?}], [{x1:?}, {y1:?}], [{x:?}, {y1:?}]]\n",
                id(i),
                x = c.x,
                y = c.y,
                x1 = c.x + p,
                y1 = c.y + p
            );
        }
        text
    }
}

const MISSION: &str = "field";
const ORIGIN: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 400.0 };
/// Pixels.
const FOCAL: f32 = 260.0;

fn id(i: usize) -> String {
    format!("a{i:04}")
}

fn nadir(at: DVec2, height: f64) -> View {
    let [width, height_px] = SIZE;
    let (cx, cy) = (0.5 * width as f32, 0.5 * height_px as f32);
    let intrinsics = Intrinsics { width, height: height_px, fx: FOCAL, fy: FOCAL, cx, cy };
    View { intrinsics, pose: Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: at.extend(height) } }
}

/// Hands the field's models to a ground station below `out` and measures it.
///
/// # Errors
/// More aircraft than a mission may have or fewer than four; the ground station fails; the folder cannot be written to.
pub fn measure(field: &Field, out: &Path) -> Result<GroundScores, JobError> {
    if !(4..=MAX_AIRCRAFT).contains(&field.aircraft) {
        return Err(JobError::Request(format!("--aircraft {}: must be 4 to {MAX_AIRCRAFT}", field.aircraft)));
    }
    let path = out.join("mission.toml");
    write_text(&path, &field.mission())?;
    let mission = Mission::read(&path).map_err(|e| JobError::Request(e.to_string()))?;
    let half = field.aircraft / 2;
    offer(field, &mission, 0..half, out)?;
    let wait_s = (10 + half / 4).to_string();
    let arguments: Vec<String> = ["serve", "--mission", &path.display().to_string()].map(str::to_owned).into();
    let first = serve(&[arguments.as_slice(), &["--timeout".into(), wait_s]].concat(), out, field.limit_mib)?;
    offer(field, &mission, half..field.aircraft, out)?;
    let second = serve(&arguments, out, field.limit_mib)?;
    scores(field, [&first, &second], out)
}

/// Lays the models of these aircraft on the stick, as their offerers do.
fn offer(field: &Field, mission: &Mission, which: std::ops::Range<usize>, out: &Path) -> Result<(), JobError> {
    let failed = |e: &dyn std::fmt::Display| JobError::Request(format!("offering a model: {e}"));
    for i in which {
        let (header, cloud) = field.model(i);
        let path = out.join("model.dgtr");
        model::write(&path, &header, &cloud)?;
        // Where an aircraft would remember its number of flights.
        let source = Source::of(mission, &id(i), &out.join("aircraft")).map_err(|e| failed(&e))?;
        let offerer = Offerer::start(&mission.upload, source).map_err(|e| failed(&e))?;
        offerer.offer_final(&path);
        if !offerer.wait_delivered(OFFERED, || true) {
            return Err(failed(&format!("{} does not come to lie in {}", id(i), out.display())));
        }
        offerer.shutdown();
    }
    Ok(())
}

/// One start of the ground station to its end, which comes early while aircraft are missing.
fn serve(arguments: &[String], out: &Path, limit_mib: u64) -> Result<RunReport, JobError> {
    let folder = out.join("ground");
    match child::run(arguments, &folder, Some(limit_mib)) {
        Ok(ended) => ended.report("serve"),
        Err(e) if e.kind() == ErrorKind::Interrupted => Ok(RunReport::read(&folder)?),
        Err(e) => Err(e),
    }
}

fn scores(field: &Field, [first, second]: [&RunReport; 2], out: &Path) -> Result<GroundScores, JobError> {
    let number = |run: &RunReport, name: &str| run.more.get("registered").and_then(|r| r[name].as_u64()).unwrap_or(0);
    let list = |run: &RunReport, name: &str| -> Vec<f64> {
        let all = run.more.get(name).and_then(|s| s.as_array()).cloned().unwrap_or_default();
        all.iter().filter_map(serde_json::Value::as_f64).collect()
    };
    let compared = COMPARED.min(list(first, "joined_s").len()).min(field.aircraft - field.aircraft / 2);
    let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len().max(1) as f64;
    let first_and_last = |name| {
        let (early, late) = (list(first, name), list(second, name));
        [mean(&early[..compared.min(early.len())]), mean(&late[late.len().saturating_sub(compared)..])]
    };
    let fitted = |run: &RunReport| list(run, "joined_fits").iter().sum::<f64>() as u64 + number(run, "fitted");
    let global: PathBuf = out.join("ground").join("global.dgtr");
    let (header, cloud) = model::read(&global)?;
    Ok(GroundScores {
        aircraft: field.aircraft,
        gaussians: [field.aircraft * field.along().pow(2), cloud.len()],
        pairs: number(second, "pairs"),
        fitted: [fitted(first), fitted(second)].map(|n| n as usize),
        joined_s: first_and_last("joined_s"),
        joined_fits: first_and_last("joined_fits"),
        compared,
        stage_s: second.stage_ms.iter().map(|(name, ms)| (name.clone(), ms / 1e3)).collect(),
        rss_mib: first.host_rss_peak.max(second.host_rss_peak) as f64 / (1 << 20) as f64,
        apart_m: [apart_before(field), apart_after(field, &header)],
        least_region: least_region(field, &cloud),
    })
}

/// Root mean square distance of neighbours' errors at the middle of what they share, metres.
fn rms_apart(field: &Field, error: impl Fn(usize, DVec3) -> DVec3) -> f64 {
    let middle = |i: usize| (field.corner(i) + 0.5 * field.pitch()).extend(0.0);
    let squares: Vec<f64> = field
        .neighbours()
        .map(|(i, j)| {
            let border = 0.5 * (middle(i) + middle(j));
            error(i, border).distance_squared(error(j, border))
        })
        .collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}

fn apart_before(field: &Field) -> f64 {
    rms_apart(field, |i, p| field.error(i).point(p) - p)
}

/// The same where the global model has the aircraft's cameras: their places and headings say where the aircraft went.
fn apart_after(field: &Field, header: &ModelHeader) -> f64 {
    let place = |i: usize| {
        let mut all = header.views.iter().filter(|(name, _)| name.starts_with(&id(i)));
        let (_, view) = all.next()?;
        let truth = field.model(i).0.views.first()?.1.pose;
        // From where its GPS put it to where it is now, after what was wrong with the GPS.
        let turn = view.pose.rotation * truth.rotation.conjugate();
        let moved = Motion::rigid(turn, view.pose.center - turn * truth.center);
        Some(field.error(i).then(&moved))
    };
    let places: Vec<Option<Motion>> = (0..field.aircraft).map(place).collect();
    rms_apart(field, |i, p| places[i].map_or(DVec3::INFINITY, |m| m.point(p)) - p)
}

fn least_region(field: &Field, cloud: &GaussianCloud) -> f64 {
    let mut counts = vec![0usize; field.aircraft];
    let (columns, pitch) = (field.columns(), field.pitch());
    for mean in &cloud.means {
        let at = DVec2::new(f64::from(mean[0]), f64::from(mean[1])) / pitch;
        let inside = at.cmpge(DVec2::ZERO).all() && at.x < columns as f64;
        let i = at.y as usize * columns + at.x as usize;
        if inside && i < field.aircraft {
            counts[i] += 1;
        }
    }
    let each = field.along().pow(2) as f64 / (1.0 + 2.0 * BEYOND).powi(2);
    counts.into_iter().map(|n| n as f64 / each).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::aggregate::LocalModel;
    use crate::aggregate::member::Member;
    use crate::aggregate::register::Fitter;
    use crate::aggregate::register::fit::RenderedFitter;

    const FIELD: Field = Field { aircraft: 4, side_m: 280.0, gaussians: 10_000, limit_mib: 512, seed: 1 };

    /// With real renderings and the real network (skipped, with a word, where there is no device or no ONNX Runtime).
    #[test]
    fn neighbours_of_the_field_are_brought_together_by_rendering_them() {
        let dir = tempfile::tempdir().expect("temp dir");
        let member = |i: usize| {
            let (header, cloud) = FIELD.model(i);
            let path = dir.path().join(id(i));
            model::write(&path, &header, &cloud).expect("written");
            Member::of(LocalModel::read(&path).expect("read"))
        };
        let mut fitter = RenderedFitter::new(None);
        for (a, b) in FIELD.neighbours() {
            let found = match fitter.fit(&member(a), &member(b)) {
                Ok(found) => found.expect("they share a fifth of their ground"),
                Err(e) => return eprintln!("skipped: {e}"),
            };
            let border = 0.5 * (FIELD.corner(a) + FIELD.corner(b) + FIELD.pitch()).extend(0.0);
            let (first, second) = (FIELD.error(a).point(border), FIELD.error(b).point(border));
            let left = found.motion().point(second).distance(first);
            assert!(left < 0.3, "{a}–{b}: {left} m left of {}; {found:?}", second.distance(first));
        }
    }

    #[test]
    fn a_field_has_its_edges_once_and_its_models_on_one_grid() {
        let field = Field { aircraft: 200, side_m: 2000.0, ..FIELD };
        // 14 whole rows of 14 or 15 columns and what is left.
        assert_eq!(field.columns(), 15);
        assert_eq!(field.neighbours().count(), 13 * 14 + 4 + 12 * 15 + 5);
        let mission = Mission::parse(&field.mission(), Path::new("")).expect("a mission");
        assert_eq!(mission.aircraft.len(), 200);
        assert!(field.along() * field.along() <= field.gaussians && field.along().is_multiple_of(24));
    }
}

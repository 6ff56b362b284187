//! What a ground station of many aircraft takes: simulated models of a field are handed to `dgtr serve` as aircraft hand theirs when they
//! land, one after another, the first half, then, after a restart, the others. Every model lies where its own GPS would have put it.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use config::error::{Error, ErrorKind};
use config::mission::{MAX_AIRCRAFT, Mission};
use glam::{DVec2, DVec3};
use ground::frame::Motion;
use job::run_json::RunReport;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use serde::Serialize;
use uplink::{Offerer, Source};

use super::child;
use field::{BEYOND, Field, id};
use runtime::error::JobError;
use runtime::figures::write_text;

pub mod field;

/// Aircraft whose seconds are compared: the first and the last so many.
const COMPARED: usize = 50;
/// From one landing to the next: longer than the ground needs to fit a model to its neighbours.
const LANDS_EVERY: Duration = Duration::from_secs(1);
/// Longest time for one model to lie on the stick.
const OFFERED: Duration = Duration::from_secs(60);

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
    let wait_s = (half as f64 * (LANDS_EVERY.as_secs_f64() + 0.25)) as usize + 10;
    let arguments: Vec<String> = ["serve", "--mission", &path.display().to_string()].map(str::to_owned).into();
    let until_half = [arguments.as_slice(), &["--timeout".into(), wait_s.to_string()]].concat();
    let first = serve_while_landing(field, &mission, (0..half, &until_half), out)?;
    let second = serve_while_landing(field, &mission, (half..field.aircraft, &arguments), out)?;
    scores(field, [&first, &second], out)
}

/// One start of the ground station, during which these aircraft land.
fn serve_while_landing(
    field: &Field,
    mission: &Mission,
    (which, arguments): (std::ops::Range<usize>, &[String]),
    out: &Path,
) -> Result<RunReport, JobError> {
    std::thread::scope(|scope| {
        let landing = scope.spawn(|| offer(field, mission, which, out));
        let served = serve(arguments, out, field.limit_mib);
        landing.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        served
    })
}

/// Lays the models of these aircraft on the stick, one after another, as their offerers do.
fn offer(field: &Field, mission: &Mission, which: std::ops::Range<usize>, out: &Path) -> Result<(), JobError> {
    let failed = |e: &dyn std::fmt::Display| JobError::Request(format!("offering a model: {e}"));
    let start = Instant::now();
    for (landed, i) in which.enumerate() {
        std::thread::sleep((LANDS_EVERY * landed as u32).saturating_sub(start.elapsed()));
        let (header, cloud) = field.model(i);
        let path = out.join("model.dgtr");
        model::write(&path, &header, &cloud)?;
        // Where an aircraft would remember its number of flights.
        let source = Source::of(mission, &id(i), &out.join("aircraft")).map_err(|e| failed(&e))?;
        let offerer = Offerer::start(&mission.upload, source).map_err(|e| failed(&e))?;
        offerer.offer_final(&path);
        if !offerer.wait_delivered(OFFERED, || false) {
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
        rss_mib: first.memory.host_rss_peak.max(second.memory.host_rss_peak) as f64 / (1 << 20) as f64,
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

/// How far apart they are where the global model has the aircraft's cameras: their places and headings say where the aircraft went.
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
        if let Some(i) = field.aircraft_at(at.x as usize, at.y as usize).filter(|_| inside) {
            counts[i] += 1;
        }
    }
    let each = field.along().pow(2) as f64 / (1.0 + 2.0 * BEYOND).powi(2);
    counts.into_iter().map(|n| n as f64 / each).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ground::LocalModel;
    use ground::member::Member;
    use ground::register::Fitter;
    use ground::register::fit::RenderedFitter;

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
                Err(e) => return needs::missing(needs::Need::Vulkan, e),
            };
            let border = 0.5 * (FIELD.corner(a) + FIELD.corner(b) + FIELD.pitch()).extend(0.0);
            let (first, second) = (FIELD.error(a).point(border), FIELD.error(b).point(border));
            let left = found.motion().point(second).distance(first);
            assert!(left < 0.3, "{a}–{b}: {left} m left of {}; {found:?}", second.distance(first));
        }
    }
}

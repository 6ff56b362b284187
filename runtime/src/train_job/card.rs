//! A card's pictures find their poses: all of them, held-out ones too, so that the model can be scored in its own frame. What
//! they settled on is kept as `transforms.json` beside the model, for the next start and for other programs.

use std::collections::HashMap;
use std::ops::ControlFlow;
use std::path::Path;

use config::refine::RefineSettings;
use engine::evaluate::surveyed;
use engine::host::settling_bytes;
use engine::{matching_file_bytes, waiting_file};
use geometry::geodesy::Geodetic;
use job::console::Progress;
use models::camera::View;
use models::formats::reconstruction::Shot;
use models::formats::transforms;
use models::refine::Refiner;
use survey::card::name_list;
use survey::dataset::{CardNotes, Dataset, DatasetFrame, PoseSource, Settled, picture_names};

use crate::error::JobError;

mod control;

/// Poses of a card, in the folder of the model.
pub(super) const FILE: &str = "transforms.json";
/// Rotations that the pictures contradict by more than this many standard deviations, and this many degrees, are named.
const CONTRADICTION: (f64, f64) = (5.0, 20.0);

/// Radial distortion (k1, k2) of a lens that nothing is known of: the survey cameras of the reference data have up to 0.015.
const UNKNOWN_RADIAL: f64 = 0.05;
/// Principal point of such a lens, in focal lengths.
const UNKNOWN_PRINCIPAL: f64 = 0.02;
/// How much a rolling shutter stretches pictures: 5 m/s for 30 ms are 0.15 m of some 60 m of ground, a quarter of a percent; twice that.
const ROLLING_SHUTTER: f64 = 0.005;
/// A card's pictures are matched at this many times the size, and with as many more key points, than in flight, where the
/// time is short: brighton_beach's card lies 0.80 m from its reference at 640 pixels and 0.07 m at 1,280.
const DETAIL: u32 = 2;
/// What `[refine]` allows of either.
const MOST_DETAIL: u32 = 8192;

/// Looks at pictures without positions after the first: each finds some from the places of the others (brighton_beach's 18
/// without GPS: 15, 17, 17 and 18 tied).
const FLOATING_LOOKS: usize = 3;

/// What settling a card is to be remembered for, in run.json.
pub(super) type Remarks = Vec<(&'static str, serde_json::Value)>;

/// Says what was taken from the card and what not.
fn announce(set: &Dataset, notes: &CardNotes) {
    let mut sizes: Vec<(u32, u32)> =
        set.frames.iter().map(|f| (f.view.intrinsics.width, f.view.intrinsics.height)).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let sizes: Vec<String> = sizes.iter().map(|(w, h)| format!("{w}x{h}")).collect();
    tracing::info!(
        "{}: {} pictures found, {} used ({})",
        set.root.display(),
        notes.found,
        set.frames.len(),
        sizes.join(", ")
    );
    notes.read.iter().for_each(|line| tracing::info!("{line}"));
    notes.lines.iter().for_each(|line| tracing::warn!("{line}"));
}

/// Replaces the card's priors by poses that its pictures agree on; `None` when asked to stop.
pub(super) fn settle(
    set: &mut Dataset,
    out: &Path,
    fresh: bool,
    refine: Option<&RefineSettings>,
    go_on: &dyn Fn() -> bool,
) -> Result<Option<Remarks>, JobError> {
    let mut remarks = Remarks::new();
    let Some(notes) = set.card.clone() else { return Ok(Some(remarks)) };
    announce(set, &notes);
    let file = out.join(FILE);
    if !fresh && let Some(settled) = known(set, &file)? {
        set.settle(&settled);
        return Ok(Some(remarks));
    }
    let settled = match refine {
        None if notes.floats => {
            let what = "no picture says where it was taken, which only the pictures themselves can tell; leave --no-refine out";
            return Err(JobError::Request(format!("{}: {what}", set.root.display())));
        }
        None => {
            let stated = |f: &DatasetFrame| Settled { view: f.view, distortion: f.distortion };
            set.frames.iter().map(|f| (f.name.clone(), stated(f))).collect()
        }
        Some(settings) => match refined(set, &notes, settings, out, go_on, &mut remarks)? {
            Some((settled, fixed)) => {
                set.origin = set.origin.or(fixed);
                settled
            }
            None => return Ok(None),
        },
    };
    set.settle(&settled);
    std::fs::create_dir_all(out).map_err(JobError::io(out))?;
    transforms::write(&file, &set.reconstruction())?;
    Ok(Some(remarks))
}

/// What an earlier start settled on, when it was about the same pictures.
fn known(set: &Dataset, file: &Path) -> Result<Option<HashMap<String, Settled>>, JobError> {
    if !file.is_file() {
        return Ok(None);
    }
    let earlier = transforms::read(file)?;
    let of_path: HashMap<_, _> = earlier.shots.iter().map(|s| (s.path.as_str(), s)).collect();
    let now = set.reconstruction();
    let mut settled = HashMap::with_capacity(set.frames.len());
    for (frame, shot) in set.frames.iter().zip(&now.shots) {
        // A picture that could not be decoded then is not asked again.
        let Some(before) = of_path.get(shot.path.as_str()) else { continue };
        settled.insert(frame.name.clone(), of_shot(frame, before));
    }
    // Pictures that came since want poses, too.
    Ok((settled.len() == earlier.shots.len()).then_some(settled))
}

/// Gives a card the poses that the training of `model` settled on, its held-out pictures' too; says so where there are none.
///
/// # Errors
/// The file beside the model is damaged.
pub fn take_settled(set: &mut Dataset, model: &Path) -> Result<(), JobError> {
    if set.card.is_none() {
        return Ok(());
    }
    let file = model.with_file_name(FILE);
    let earlier = if file.is_file() { transforms::read(&file)?.shots } else { Vec::new() };
    // The card may be mounted elsewhere now.
    let pairs = picture_names(set).pair(earlier.iter().map(|s| s.path.as_str()));
    let settled: HashMap<_, _> = pairs
        .into_iter()
        .zip(&earlier)
        .filter_map(|(i, shot)| Some((set.frames[i?].name.clone(), of_shot(&set.frames[i?], shot))))
        .collect();
    let (all, with) = (set.frames.len(), settled.len());
    match with {
        0 => tracing::warn!(
            "{}: no poses that a training settled on are beside the model ({}); its pictures are scored at the poses that they state",
            set.root.display(),
            file.display()
        ),
        _ if with < all => {
            tracing::warn!("{}: {} of {all} pictures have no settled pose; left out", set.root.display(), all - with)
        }
        _ => {}
    }
    if with > 0 {
        set.settle(&settled);
    }
    Ok(())
}

/// Lens and pose of a picture as it is loaded, of what is known of it as it is stored.
fn of_shot(frame: &DatasetFrame, shot: &Shot) -> Settled {
    let lens = frame.orientation.of_lens(&shot.lens);
    let size = lens.size.unwrap_or((frame.view.intrinsics.width, frame.view.intrinsics.height));
    let mut pose = shot.pose;
    pose.rotation = frame.orientation.of_rotation(pose.rotation);
    Settled { view: View { intrinsics: lens.intrinsics(size), pose }, distortion: lens.distortion }
}

/// What the pictures say, as far as the refiner knows now.
struct Found<'a> {
    settled: HashMap<String, Settled>,
    /// Those that are turned against what they say of themselves, and by how many degrees.
    contradicted: Vec<(&'a String, f64)>,
    /// Those that see too little of what others see.
    untied: Vec<&'a String>,
}

impl<'a> Found<'a> {
    fn in_pictures(set: &'a Dataset, refiner: &Refiner) -> Self {
        let floats = set.card.as_ref().is_some_and(|c| c.floats);
        let mut found =
            Self { settled: HashMap::with_capacity(set.frames.len()), contradicted: Vec::new(), untied: Vec::new() };
        for frame in &set.frames {
            let name = &frame.name;
            let (Some(pose), Some(intrinsics)) = (refiner.pose(name), refiner.intrinsics(name)) else { continue };
            if !refiner.is_tied(name) {
                found.untied.push(name);
                if floats {
                    continue;
                }
            } else if floats {
                // Its prior says nothing.
            } else if let Some(prior) = frame.prior {
                let away = prior.pose.rotation.angle_between(pose.rotation).to_degrees();
                let sigma = f64::from(prior.sigma.rotation_rad.iter().fold(0.0f32, |a, b| a.max(*b))).to_degrees();
                if away > CONTRADICTION.1.max(CONTRADICTION.0 * sigma) {
                    found.contradicted.push((name, away));
                }
            }
            // Only a picture without a distortion of its own may have been given one.
            let distortion = if frame.distortion.is_none() { refiner.distortion() } else { frame.distortion };
            found.settled.insert(name.clone(), Settled { view: View { intrinsics, pose }, distortion });
        }
        found
    }
}

/// A scene without a scale is given one: half of the pictures lie less than 1 from the one taken before.
fn scale_to_baselines(set: &Dataset, settled: &mut HashMap<String, Settled>) {
    let centers: Vec<_> = set.frames.iter().filter_map(|f| Some(settled.get(&f.name)?.view.pose.center)).collect();
    let mut baselines: Vec<f64> = centers.windows(2).map(|w| w[0].distance(w[1])).filter(|d| *d > 0.0).collect();
    baselines.sort_by(f64::total_cmp);
    if let Some(&usual) = baselines.get(baselines.len() / 2) {
        settled.values_mut().for_each(|s| s.view.pose.center /= usual);
    }
}

/// What the pictures settle on, and where on Earth surveyed points put a scene that did not know it.
type Agreed = (HashMap<String, Settled>, Option<Geodetic>);

/// `None` when asked to stop.
fn refined(
    set: &Dataset,
    notes: &CardNotes,
    settings: &RefineSettings,
    out: &Path,
    go_on: &dyn Fn() -> bool,
    remarks: &mut Remarks,
) -> Result<Option<Agreed>, JobError> {
    let all: Vec<usize> = (0..set.frames.len()).collect();
    let mut settings = settings.clone();
    settings.max_keyframes = settings.max_keyframes.max(all.len());
    settings.focal_sigma = settings.focal_sigma.max(notes.focal_sigma);
    if notes.distortion_unknown {
        settings.radial_sigma = settings.radial_sigma.max(UNKNOWN_RADIAL);
        settings.principal_sigma = settings.principal_sigma.max(UNKNOWN_PRINCIPAL);
    }
    settings.aspect_sigma = settings.aspect_sigma.max(ROLLING_SHUTTER);
    if notes.floats {
        // Without telemetry there is nothing that could be off for all alike.
        (settings.mount_sigma_deg, settings.delay_sigma_s) = (0.0, 0.0);
    }
    settings.feature_side = (settings.feature_side * DETAIL).min(MOST_DETAIL);
    settings.max_features = (settings.max_features * DETAIL as usize).min(MOST_DETAIL as usize);
    // The network sees no more of a picture than this; decoding more would be for nothing.
    let longer = |i: &usize| set.frames[*i].view.intrinsics.width.max(set.frames[*i].view.intrinsics.height);
    let largest = all.iter().map(longer).max().unwrap_or(1);
    let scale = (f64::from(settings.feature_side) / f64::from(largest)).min(1.0);
    let mut refiner = Refiner::open(&settings)?;
    let file = waiting_file(out, matching_file_bytes(all.len() as u64, &settings))?;
    let pixels = all.iter().map(|i| set.frames[*i].view.intrinsics.pixels() as u64).max().unwrap_or(0);
    let planned = settling_bytes(&settings, all.len() as u64, file.is_some(), (settings.threads as u64 + 1, pixels));
    remarks.push(("host_bytes_planned_poses", planned.into()));
    if let Some(file) = file {
        refiner.keep_frames_in(file);
    }
    let mut progress = Progress::new("poses", all.len() as u64);
    let (mut done, mut stopped) = (0, false);
    let mut skipped = Vec::new();
    set.load_ahead(&all, scale, PoseSource::Telemetry, settings.threads, |i, picture| {
        let name = &set.frames[i].name;
        let added = picture.map_err(|e| e.to_string()).and_then(|p| refiner.add(&p).map_err(|e| e.to_string()));
        if let Err(e) = added {
            tracing::warn!("{e}");
            skipped.push(name.clone());
        }
        done += 1;
        progress.set(done, || name.clone());
        stopped = !go_on();
        if stopped { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    if stopped {
        return Ok(None);
    }
    remarks.push(("pictures_not_decoded", serde_json::json!(skipped)));
    refiner.set_control(surveyed::marked(set, &notes.control, scale));
    if notes.floats {
        let placed = refiner.bootstrap()?;
        match placed.start {
            Some(pair) => {
                tracing::info!("{} of {} pictures placed, from {}", placed.placed, all.len(), pair.join(" and "));
            }
            None => {
                tracing::warn!("none of {} pictures placed: no two show enough of the same from two places", all.len())
            }
        }
    }
    let (mut solved, mut found) = (refiner.solve()?, Found::in_pictures(set, &refiner));
    for _ in 0..if notes.floats { FLOATING_LOOKS } else { 1 } {
        refiner.relink()?;
        let again = refiner.solve()?;
        // A later look knows more than those before; where it ties fewer pictures together all the same, they are believed.
        if again.frames_tied >= solved.frames_tied {
            (solved, found) = (again, Found::in_pictures(set, &refiner));
        }
    }
    progress.finish(&format!(
        "{} of {} pictures tied together, reprojection {:.2} px",
        solved.frames_tied,
        all.len(),
        solved.reprojection_rms_px.max(0.0)
    ));
    let Found { mut settled, contradicted, untied } = found;
    if !contradicted.is_empty() {
        let mut angles: Vec<f64> = contradicted.iter().map(|c| c.1).collect();
        angles.sort_by(f64::total_cmp);
        let names: Vec<&String> = contradicted.iter().map(|c| c.0).collect();
        tracing::warn!(
            "{}: turned by about {:.0} degrees against what they say of themselves (the pictures are believed)",
            name_list(&names),
            angles[angles.len() / 2]
        );
        remarks.push(("pictures_turned", serde_json::json!(names)));
    }
    if !untied.is_empty() {
        let what = if notes.floats { "cannot be placed; left out" } else { "their stated poses are kept" };
        tracing::warn!("{}: see too little of what others see; {what}", name_list(&untied));
    }
    control::announce(&solved.control, &notes.control);
    let fixed = refiner.is_fixed().then(|| notes.control[0].position);
    if notes.floats {
        remarks.push(("pictures_not_placed", serde_json::json!(untied)));
        if fixed.is_none() {
            scale_to_baselines(set, &mut settled);
        }
        if settled.len() < 2 {
            let what = "its pictures cannot be placed by what they show; take them with more overlap, or give --geotags or --log";
            return Err(JobError::Request(format!("{}: {what}", set.root.display())));
        }
    }
    remarks.push(("refine", serde_json::to_value(&solved)?));
    Ok(Some((settled, fixed)))
}

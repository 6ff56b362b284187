//! A card's pictures find their poses: all of them, held-out ones too, so that the model can be scored in its own frame. What
//! they settled on is kept as `transforms.json` beside the model, for the next start and for other programs.

use std::collections::HashMap;
use std::path::Path;

use config::refine::RefineSettings;
use engine::evaluate::surveyed;
use engine::host::settling_bytes;
use engine::{matching_file_bytes, waiting_file};
use geometry::geodesy::Geodetic;
use job::console::Progress;
use job::resources::writable_bytes;
use models::camera::View;
use models::formats::reconstruction::Shot;
use models::formats::transforms;
use models::refine::{Refiner, Untied};
use survey::card::name_list;
use survey::dataset::{CardNotes, Dataset, DatasetFrame, Settled, picture_names};
use survey::settling::{self, Needs, Settlement};

use crate::error::JobError;

mod control;
mod precision;

/// Poses of a card, in the folder of the model.
pub(super) const FILE: &str = "transforms.json";
/// Heights that differ from those stated by more than so many standard deviations are named.
const HEIGHT_OFF: f64 = 3.0;

/// What settling a card is to be remembered for, in run.json.
type Remarks = Vec<(&'static str, serde_json::Value)>;

/// A settled card.
#[derive(Default)]
pub(super) struct Card {
    /// For run.json.
    pub remarks: Remarks,
    /// Pictures that are trained on, and those that the card holds, where their poses were settled.
    pub used: Option<(usize, usize)>,
}

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

/// Replaces the card's priors by poses that its pictures agree on, and leaves those out that do not; `None` when asked to stop.
pub(super) fn settle(
    set: &mut Dataset,
    out: &Path,
    fresh: bool,
    refine: Option<&RefineSettings>,
    cancelled: &dyn Fn() -> bool,
) -> Result<Option<Card>, JobError> {
    let mut card = Card::default();
    let Some(notes) = set.card.clone() else { return Ok(Some(card)) };
    announce(set, &notes);
    let (file, of) = (out.join(FILE), set.frames.len());
    if !fresh && let Some((settled, origin)) = known(set, &file)? {
        card.used = Some((settled.len(), of));
        set.origin = origin;
        set.settle(&settled);
        return Ok(Some(card));
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
        Some(settings) => match refined(set, &notes, settings, out, cancelled, &mut card.remarks)? {
            Some((settled, place, known)) => {
                std::fs::create_dir_all(out).map_err(JobError::io(out))?;
                known.write(set, &settled, out)?;
                set.origin = match place {
                    Place::Stated => set.origin,
                    Place::Surveyed(origin) => set.origin.or(Some(origin)),
                    Place::None => None,
                };
                card.used = Some((settled.len(), of));
                settled
            }
            None => return Ok(None),
        },
    };
    set.settle(&settled);
    std::fs::create_dir_all(out).map_err(JobError::io(out))?;
    transforms::write(&file, &set.reconstruction())?;
    Ok(Some(card))
}

/// Poses by picture, and where on Earth their frame is.
type Earlier = (HashMap<String, Settled>, Option<Geodetic>);

/// What an earlier start settled on, when it was about the same pictures.
fn known(set: &Dataset, file: &Path) -> Result<Option<Earlier>, JobError> {
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
    Ok((settled.len() == earlier.shots.len()).then_some((settled, earlier.origin)))
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

/// One line per reason for which pictures are left out, and what contradicts the others.
fn announce_settled(found: &Settlement) {
    for why in Untied::ALL {
        let names: Vec<&String> = found.untied.iter().filter(|u| u.1 == why).map(|u| &u.0).collect();
        if !names.is_empty() {
            tracing::warn!("{}: {why}; left out", name_list(&names));
        }
    }
    if !found.contradicted.is_empty() {
        let mut angles: Vec<f64> = found.contradicted.iter().map(|c| c.1).collect();
        angles.sort_by(f64::total_cmp);
        let names: Vec<&String> = found.contradicted.iter().map(|c| &c.0).collect();
        tracing::warn!(
            "{}: turned by about {:.0} degrees against what they say of themselves (the pictures are believed)",
            name_list(&names),
            angles[angles.len() / 2]
        );
    }
    if found.positions_refused {
        tracing::warn!(
            "most stated positions contradict what the pictures show, so none is used: the scene has no place, north or scale"
        );
    }
    if let Some(positions) = &found.positions {
        let refused: Vec<&String> = positions.refused.iter().map(|r| &r.0).collect();
        if let Some(worst) = positions.refused.iter().map(|r| r.1).max_by(f64::total_cmp) {
            tracing::warn!(
                "{}: stated positions contradict what {} pictures show, by up to {worst:.0} m; not used",
                name_list(&refused),
                positions.compared
            );
        }
    }
    if !found.places_off.is_empty() {
        let names: Vec<&String> = found.places_off.iter().map(|p| &p.0).collect();
        let most = found.places_off.iter().map(|p| p.1).fold(0.0, f64::max);
        tracing::warn!(
            "{}: solved places differ from stated positions by up to {most:.0} m: these are wrong, or the scene is bent",
            name_list(&names)
        );
    }
    if let Some((off, sigma)) = found.height_off_m.filter(|(off, sigma)| *off > HEIGHT_OFF * sigma) {
        tracing::warn!("solved heights differ from those stated by {off:.0} m in the median (stated to {sigma:.0} m)");
    }
}

/// A scene without a scale is given one: half of the pictures lie less than 1 from the one taken before.
fn scale_to_baselines(set: &Dataset, found: &mut Settlement) {
    let settled = &mut found.settled;
    let centers: Vec<_> = set.frames.iter().filter_map(|f| Some(settled.get(&f.name)?.view.pose.center)).collect();
    let mut baselines: Vec<f64> = centers.windows(2).map(|w| w[0].distance(w[1])).filter(|d| *d > 0.0).collect();
    baselines.sort_by(f64::total_cmp);
    if let Some(&usual) = baselines.get(baselines.len() / 2) {
        settled.values_mut().for_each(|s| s.view.pose.center /= usual);
        found.precision.values_mut().for_each(|p| p.position = p.position.map(|s| s / usual));
    }
}

/// What says where on Earth the scene is.
enum Place {
    /// The pictures' positions.
    Stated,
    /// Surveyed points, of which this is one.
    Surveyed(Geodetic),
    /// Nothing.
    None,
}

/// What the pictures settle on.
type Agreed = (HashMap<String, Settled>, Place, precision::Known);

/// The poses that the pictures agree on. `None` when asked to stop.
fn refined(
    set: &Dataset,
    notes: &CardNotes,
    settings: &RefineSettings,
    out: &Path,
    cancelled: &dyn Fn() -> bool,
    remarks: &mut Remarks,
) -> Result<Option<Agreed>, JobError> {
    let all = set.frames.len();
    let pixels = set.frames.iter().map(|f| f.view.intrinsics.pixels() as u64).max().unwrap_or(0);
    let mut planned = 0;
    let mut open = |settings: &RefineSettings| -> Result<Refiner, JobError> {
        let mut refiner = Refiner::open(settings)?;
        let file = waiting_file(out, matching_file_bytes(all as u64, settings))?;
        let ahead = (settings.threads as u64 + 1, pixels);
        planned = planned.max(settling_bytes(settings, all as u64, file.is_some(), ahead));
        if let Some(file) = file {
            refiner.keep_frames_in(file);
        }
        Ok(refiner)
    };
    let mut progress = Progress::new("poses", all as u64);
    let found = settling::settle(
        set,
        notes,
        settings,
        &mut Needs {
            open: &mut open,
            control: &|scale| {
                // Where nothing else says where the scene is, the first of them is its origin.
                let origin = set.origin.or(notes.control.first().map(|p| p.position));
                origin.map_or_else(Vec::new, |origin| surveyed::marked(set, &notes.control, origin, scale))
            },
            taken: &mut |done, name| progress.set(done as u64, || name.to_owned()),
            cancelled,
            fits: &|settings| {
                let bytes = settling_bytes(settings, all as u64, false, (settings.threads as u64 + 1, pixels));
                writable_bytes().is_some_and(|left| bytes <= left / 2)
            },
        },
    )?;
    let Some(mut found) = found else { return Ok(None) };
    remarks.push(("host_bytes_planned_poses", planned.into()));
    progress.finish(&format!(
        "{} of {all} pictures tied together, reprojection {:.2} px",
        found.settled.len(),
        found.solved.reprojection_rms_px.max(0.0)
    ));
    announce_settled(&found);
    remarks.push(("pictures_not_decoded", serde_json::json!(found.skipped)));
    let names: Vec<&String> = found.contradicted.iter().map(|c| &c.0).collect();
    if !names.is_empty() {
        remarks.push(("pictures_turned", serde_json::json!(names)));
    }
    let names: Vec<&String> = found.untied.iter().map(|u| &u.0).collect();
    remarks.push(("pictures_not_placed", serde_json::json!(names)));
    control::announce(&found.solved.control, &notes.control);
    let place = match (found.floats, found.is_fixed) {
        (_, true) => Place::Surveyed(notes.control[0].position),
        (true, false) => Place::None,
        (false, false) => Place::Stated,
    };
    if matches!(place, Place::None) {
        scale_to_baselines(set, &mut found);
    }
    if found.settled.len() < 2 {
        let what = match notes.floats {
            true => {
                "its pictures cannot be placed by what they show; take them with more overlap, or give --geotags or --log"
            }
            false => {
                "its pictures show too little of the same to be tied together; take them with more overlap, or train from what they state with --no-refine"
            }
        };
        return Err(JobError::Request(format!("{}: {what}", set.root.display())));
    }
    remarks.push(("refine", serde_json::to_value(&found.solved)?));
    let in_metres = !matches!(place, Place::None);
    let believed = in_metres && !found.positions_refused && !notes.floats;
    let known = precision::Known::of(&found, in_metres, believed);
    remarks.push(("pose_sigma", known.usual()));
    Ok(Some((found.settled, place, known)))
}

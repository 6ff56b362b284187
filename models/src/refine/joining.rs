//! Groups of pictures that the order of capture leaves apart (the next line, a second flight) are found to belong together by what
//! they look like.

use glam::DQuat;

use super::{AddReport, RefineError, Refiner};

/// Pictures of other groups that each picture is compared with, most alike first.
const ALIKE: usize = 3;
/// Pictures of a group that say how it is turned against the others.
const REPRESENTATIVES: usize = 4;

/// How a picture has to be turned to match another.
pub(super) struct Turn {
    /// Matches that agree.
    pub inliers: usize,
    /// Quarter turns more than it was turned by.
    pub quarters: u8,
    /// Its rotation then, camera axes → world.
    pub rotation: DQuat,
}

/// The largest group that pairs join, and the others.
fn parted(refiner: &Refiner) -> (Vec<usize>, Vec<Vec<usize>>) {
    let mut groups = refiner.groups();
    let largest = (0..groups.len()).max_by_key(|g| (groups[*g].len(), std::cmp::Reverse(*g))).unwrap_or(0);
    let most = if groups.is_empty() { Vec::new() } else { groups.remove(largest) };
    (most, groups)
}

/// Frames of `among` that look most like frame `i`.
fn most_alike(refiner: &Refiner, i: usize, among: &[usize]) -> Vec<usize> {
    let own = refiner.frames[i].look();
    let alike = |j: &usize| -> f32 { refiner.frames[*j].look().iter().zip(&own).map(|(a, b)| a * b).sum() };
    let mut rated: Vec<(f32, usize)> = among.iter().map(|j| (alike(j), *j)).collect();
    rated.sort_by(|a, b| b.0.total_cmp(&a.0));
    rated.into_iter().take(ALIKE).map(|(_, j)| j).collect()
}

/// Descriptors know no other heading than their own: a line that was flown the other way links to nothing. Each group is turned
/// as some of its pictures have to be to match the largest one, and all are linked anew.
pub(super) fn turn_groups(refiner: &mut Refiner) -> Result<(), RefineError> {
    let (most, groups) = parted(refiner);
    if groups.is_empty() || refiner.networks.is_none() {
        return Ok(());
    }
    let (mut report, mut turned) = (AddReport::default(), false);
    for group in groups {
        let mut best = (0, 0);
        for &i in group.iter().step_by(group.len().div_ceil(REPRESENTATIVES)) {
            let like = |this: &Refiner| most_alike(this, i, &most);
            if let Some(turn) = best_turn(refiner, i, &like, &mut report)? {
                best = best.max((turn.inliers, turn.quarters));
            }
        }
        if best.0 > 0 && best.1 > 0 {
            turned = true;
            for &i in &group {
                refiner.extract_turned(i, (refiner.frames[i].turns + best.1) % 4, &mut report)?;
            }
        }
    }
    refiner.totals.absorb(&report);
    if turned {
        refiner.link_anew(&mut AddReport::default());
    }
    Ok(())
}

/// How picture `i` has to be turned to match one of `others` (of its features as they are then) best; nothing where it matches none
/// of them, whichever way it is turned.
pub(super) fn best_turn(
    refiner: &mut Refiner,
    i: usize,
    others: &dyn Fn(&Refiner) -> Vec<usize>,
    report: &mut AddReport,
) -> Result<Option<Turn>, RefineError> {
    let as_it_was = refiner.frames[i].turns;
    let mut best: Option<Turn> = None;
    for quarters in 0..4 {
        refiner.extract_turned(i, (as_it_was + quarters) % 4, report)?;
        for j in others(refiner) {
            let Some(found) = refiner.coarse(j, i, false, true).1 else { continue };
            let inliers = found.inliers.len();
            if best.as_ref().is_none_or(|b| inliers > b.inliers) {
                let rotation = (refiner.frames[j].pose.rotation * found.pose.rotation.conjugate()).normalize();
                best = Some(Turn { inliers, quarters, rotation });
            }
        }
    }
    refiner.extract_turned(i, as_it_was, report)?;
    Ok(best)
}

/// Links groups of pictures that the order of capture leaves apart (another line, a second flight) by those that look most
/// alike; how many pairs that made.
pub(super) fn join_by_appearance(refiner: &mut Refiner) -> usize {
    let (most, groups) = parted(refiner);
    let mut report = AddReport::default();
    for group in &groups {
        for &i in group {
            for j in most_alike(refiner, i, &most) {
                refiner.try_pairs(&[(i.min(j), false)], i.max(j), true, &mut report);
            }
        }
    }
    refiner.totals.absorb(&report);
    report.pairs_verified
}

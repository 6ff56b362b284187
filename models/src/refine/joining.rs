//! Groups of pictures that the order of capture leaves apart (the next line, a second flight) are found to belong together by what
//! they look like.

use super::{AddReport, RefineError, Refiner};

/// Pictures of other groups that each picture is compared with, most alike first.
const ALIKE: usize = 3;
/// Pictures of a group that say how it is turned against the others.
const REPRESENTATIVES: usize = 4;

impl Refiner {
    /// The largest group that pairs join, and the others.
    fn parted(&self) -> (Vec<usize>, Vec<Vec<usize>>) {
        let mut groups = self.groups();
        let largest = (0..groups.len()).max_by_key(|g| (groups[*g].len(), std::cmp::Reverse(*g))).unwrap_or(0);
        let most = if groups.is_empty() { Vec::new() } else { groups.remove(largest) };
        (most, groups)
    }

    /// Frames of `among` that look most like frame `i`.
    fn most_alike(&self, i: usize, among: &[usize]) -> Vec<usize> {
        let own = self.frames[i].look();
        let alike = |j: &usize| -> f32 { self.frames[*j].look().iter().zip(&own).map(|(a, b)| a * b).sum() };
        let mut rated: Vec<(f32, usize)> = among.iter().map(|j| (alike(j), *j)).collect();
        rated.sort_by(|a, b| b.0.total_cmp(&a.0));
        rated.into_iter().take(ALIKE).map(|(_, j)| j).collect()
    }

    /// Descriptors know no other heading than their own: a line that was flown the other way links to nothing. Each group is turned
    /// as some of its pictures have to be to match the largest one, and all are linked anew.
    pub(super) fn turn_groups(&mut self) -> Result<(), RefineError> {
        let (most, groups) = self.parted();
        if groups.is_empty() || self.networks.is_none() {
            return Ok(());
        }
        let (mut report, mut turned) = (AddReport::default(), false);
        for group in groups {
            let mut best = (0, 0);
            for &i in group.iter().step_by(group.len().div_ceil(REPRESENTATIVES)) {
                let as_it_was = self.frames[i].turns;
                for more in 0..4 {
                    self.extract_turned(i, (as_it_was + more) % 4, &mut report)?;
                    for j in self.most_alike(i, &most) {
                        let agree = self.coarse(j, i, false, true).1.map_or(0, |found| found.inliers.len());
                        best = best.max((agree, more));
                    }
                }
                self.extract_turned(i, as_it_was, &mut report)?;
            }
            if best.0 > 0 && best.1 > 0 {
                turned = true;
                for &i in &group {
                    self.extract_turned(i, (self.frames[i].turns + best.1) % 4, &mut report)?;
                }
            }
        }
        self.totals.absorb(&report);
        if turned {
            self.link_anew(&mut AddReport::default());
        }
        Ok(())
    }

    /// Links groups of pictures that the order of capture leaves apart (another line, a second flight) by those that look most
    /// alike; how many pairs that made.
    pub(super) fn join_by_appearance(&mut self) -> usize {
        let (most, groups) = self.parted();
        let mut report = AddReport::default();
        for group in &groups {
            for &i in group {
                for j in self.most_alike(i, &most) {
                    self.try_pairs(&[(i.min(j), false)], i.max(j), true, &mut report);
                }
            }
        }
        self.totals.absorb(&report);
        report.pairs_verified
    }
}

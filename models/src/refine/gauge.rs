//! Which telemetry rotations to believe. Pairs fix the rotations of a group of linked frames against each other;
//! the group as a whole is then turned to where most of its members' telemetry agrees, so that neither a first
//! frame with a wrong heading nor a minority of them can turn the map.

use super::Refiner;
use super::so3;
use glam::DQuat;

/// Telemetry that differs from the majority by more than this is refused, radians (20°), or by five sigma.
const REFUSE: f64 = 0.35;
/// Candidate turns tried per group; more members than that add nothing.
const MAX_VOTES: usize = 64;

impl Refiner {
    /// Turns every group to its majority and marks frames whose telemetry rotation cannot be right. Groups that
    /// already agree with their majority stay as they are (a warm start is kept).
    pub(super) fn vote(&mut self) {
        let groups = self.groups();
        for group in groups.iter().filter(|g| g.len() > 1) {
            let errors: Vec<DQuat> = group.iter().map(|i| self.world_error(*i)).collect();
            let mut best = (self.votes(group, DQuat::IDENTITY), DQuat::IDENTITY);
            for turn in errors.iter().step_by(group.len().div_ceil(MAX_VOTES)) {
                let votes = self.votes(group, *turn);
                if votes > best.0 {
                    best = (votes, *turn);
                }
            }
            if best.1 != DQuat::IDENTITY {
                for i in group {
                    let pose = &mut self.frames[*i].pose;
                    pose.rotation = (best.1 * pose.rotation).normalize();
                }
            }
        }
        (0..self.frames.len()).for_each(|i| self.doubt_rotation(i));
    }

    /// Notes whether the telemetry rotation of frame `i` can be right.
    pub(super) fn doubt_rotation(&mut self, i: usize) {
        let error = so3::log(self.world_error(i)).length();
        let frame = &mut self.frames[i];
        let sigma = frame.sigma.rotation_rad.iter().fold(0.0f32, |a, b| a.max(*b));
        frame.rotation_refused = frame.pairs > 0 && error > REFUSE.max(5.0 * f64::from(sigma));
    }

    /// World rotation that would bring frame `i` to its telemetry.
    fn world_error(&self, i: usize) -> DQuat {
        let telemetry = self.frames[i].prior.rotation * self.shared.mount;
        (telemetry * self.frames[i].pose.rotation.conjugate()).normalize()
    }

    /// How many rotations and baselines of the group agree with telemetry once it is turned by `turn`.
    fn votes(&self, group: &[usize], turn: DQuat) -> usize {
        let rotations =
            group.iter().filter(|i| so3::log(self.world_error(**i) * turn.conjugate()).length() < REFUSE / 2.0).count();
        // Directions between GPS positions decide where rotations are in a draw (one of two frames is wrong).
        let directions = self
            .pairs
            .iter()
            .filter(|p| !p.rotation_only && group.binary_search(&(p.a as usize)).is_ok())
            .filter(|p| {
                let (a, b) = (&self.frames[p.a as usize], &self.frames[p.b as usize]);
                let gps = a.prior.center - b.prior.center;
                let seen = turn * b.pose.rotation * p.pose.translation;
                gps.length() > 3.0 * f64::from(a.sigma.position_m[0]) && gps.normalize().dot(seen) > 0.9
            })
            .count();
        2 * rotations + directions
    }

    /// Frames that verified pairs join, each group sorted.
    pub(super) fn groups(&self) -> Vec<Vec<usize>> {
        let mut root: Vec<usize> = (0..self.frames.len()).collect();
        let find = |root: &Vec<usize>, mut i: usize| {
            while root[i] != i {
                i = root[i];
            }
            i
        };
        for p in &self.pairs {
            let (a, b) = (find(&root, p.a as usize), find(&root, p.b as usize));
            root[a.max(b)] = a.min(b);
        }
        let mut groups = vec![Vec::new(); self.frames.len()];
        for i in 0..self.frames.len() {
            groups[find(&root, i)].push(i);
        }
        groups.retain(|g| !g.is_empty());
        groups
    }
}

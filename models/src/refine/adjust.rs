//! Levenberg–Marquardt on the reduced equations, and the question which shared parameters the pictures can tell.

use super::problem::{Loss, Problem, RADIAL, SHARED};
use super::reduced::Step;
use super::schur::{FrameVec, Reduced, SharedVec, point_steps};
use super::so3;
use glam::DVec3;
use std::time::Instant;

/// When to stop.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    pub loss: Loss,
    pub max_steps: u32,
    pub deadline: Instant,
}

/// How an adjustment went.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Outcome {
    pub steps: u32,
    /// The cost stopped falling (rather than time or steps running out).
    pub converged: bool,
}

/// Relative fall of the cost below which it counts as still.
const STILL: f64 = 1e-4;

/// Moves poses, points and free shared parameters downhill; never leaves them worse than they were.
pub(crate) fn adjust(problem: &mut Problem, limits: Limits) -> Outcome {
    let mut equations = Reduced::new(problem);
    let mut cost = problem.cost(limits.loss);
    let mut lambda = 1e-4;
    let mut outcome = Outcome::default();
    while outcome.steps < limits.max_steps && Instant::now() < limits.deadline {
        outcome.steps += 1;
        equations.fill(problem, limits.loss, lambda);
        let before = (problem.poses.clone(), problem.points.clone(), problem.shared);
        let improved = equations.solve(&equations.downhill()).is_some_and(|step| {
            let points = point_steps(problem, limits.loss, lambda, &step.frames, &step.shared);
            apply(problem, &step, &points);
            let after = problem.cost(limits.loss);
            let fell = after.is_finite() && after < cost;
            if fell {
                outcome.converged = cost - after < STILL * cost;
                cost = after;
            }
            fell
        });
        if improved {
            lambda = (lambda * 0.2).max(1e-9);
        } else {
            (problem.poses, problem.points, problem.shared) = before;
            lambda *= 10.0;
            outcome.converged = lambda > 1e4;
        }
        if outcome.converged {
            break;
        }
    }
    outcome
}

fn apply(problem: &mut Problem, step: &Step, points: &[DVec3]) {
    for (pose, d) in problem.poses.iter_mut().zip(&step.frames) {
        pose.rotation = (pose.rotation * so3::exp(DVec3::new(d[0], d[1], d[2]))).normalize();
        pose.center += DVec3::new(d[3], d[4], d[5]);
    }
    for (point, d) in problem.points.iter_mut().zip(points) {
        *point += *d;
    }
    let s = &step.shared;
    problem.shared.mount = (problem.shared.mount * so3::exp(DVec3::new(s[0], s[1], s[2]))).normalize();
    problem.shared.delay += s[3];
    problem.shared.log_focal += s[4];
    problem.shared.radial.k1 += s[5];
    problem.shared.radial.k2 += s[6];
}

/// Standard deviation of every shared parameter if it were free, given all the rest unknown too; infinite where
/// the equations cannot be solved.
pub(crate) fn shared_sigma(problem: &mut Problem, loss: Loss) -> [f64; SHARED] {
    let free = problem.free;
    problem.free = std::array::from_fn(|k| problem.shared_weight[k].is_finite() && (k < RADIAL || problem.shared_weight[k] > 0.0));
    let mut equations = Reduced::new(problem);
    equations.fill(problem, loss, 0.0);
    problem.free = free;
    std::array::from_fn(|k| {
        let mut unit = Step { frames: vec![FrameVec::zeros(); problem.poses.len()], shared: SharedVec::zeros() };
        unit.shared[k] = 1.0;
        equations.solve(&unit).map_or(f64::INFINITY, |x| x.shared[k].max(0.0).sqrt())
    })
}

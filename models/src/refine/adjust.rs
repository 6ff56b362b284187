//! Levenberg–Marquardt on the reduced equations, and the question which shared parameters the pictures can tell.

use super::problem::{ASPECT, FOCAL, INDEPENDENT, Loss, PRINCIPAL, Problem, RADIAL, SHARED};
use super::reduced::Step;
use super::schur::{FrameVec, Reduced, SharedVec, point_steps};
use super::so3;
use glam::{DVec2, DVec3};
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
    let as_given = problem.shared_weight;
    // Sightings of one picture err alike: as many as are independent are held against the prior of the lens, which is weighted up by
    // what the others would add.
    let per_frame = problem.observations.len() as f64 / problem.poses.len().max(1) as f64;
    let by = (per_frame / INDEPENDENT).sqrt().max(1.0);
    problem.shared_weight[FOCAL..].iter_mut().for_each(|w| *w *= by);
    let outcome = descend(problem, limits);
    problem.shared_weight = as_given;
    outcome
}

/// Steps downhill with the weights as they are.
fn descend(problem: &mut Problem, limits: Limits) -> Outcome {
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
    let lens = &mut problem.shared.lens;
    lens.log_focal += s[FOCAL];
    lens.log_aspect += s[ASPECT];
    lens.shift += DVec2::new(s[PRINCIPAL], s[PRINCIPAL + 1]);
    lens.radial.k1 += s[RADIAL];
    lens.radial.k2 += s[RADIAL + 1];
}

/// Standard deviation of every shared parameter if it were free, given all the rest unknown too; infinite where
/// the equations cannot be solved.
pub(crate) fn shared_sigma(problem: &mut Problem, loss: Loss) -> [f64; SHARED] {
    let free = problem.free;
    // What is known exactly is no unknown: nothing might tell it, and the equations could not be solved.
    problem.free = problem.shared_weight.map(|w| w.is_finite() && w > 0.0);
    let mut equations = Reduced::new(problem);
    equations.fill(problem, loss, 0.0);
    problem.free = free;
    std::array::from_fn(|k| {
        let mut unit = Step { frames: vec![FrameVec::zeros(); problem.moving], shared: SharedVec::zeros() };
        unit.shared[k] = 1.0;
        equations.solve(&unit).map_or(f64::INFINITY, |x| x.shared[k].max(0.0).sqrt())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use crate::refine::calibration::Calibration;
    use crate::refine::problem::{Observation, PosePrior, Shared};
    use crate::refine::radial::Radial;
    use glam::DQuat;

    const LENS: Intrinsics = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 395.0, cx: 318.0, cy: 243.0 };
    const LOSS: Loss = Loss::Cauchy(2.0);

    /// Three cameras that look down on twelve points, everything a little off and nothing at its optimum.
    fn scene() -> Problem {
        let wobble = |i: usize, k: usize| ((i * 7 + k * 3) % 11) as f64 / 11.0 - 0.5;
        let three = |i: usize, scale: f64| DVec3::new(wobble(i, 0), wobble(i, 1), wobble(i, 2)) * scale;
        let pose = |i: usize| Pose {
            rotation: DQuat::from_rotation_x(std::f64::consts::PI) * so3::exp(three(i, 0.2)),
            center: DVec3::new(10.0 * i as f64, 0.0, 40.0) + three(i + 3, 1.0),
        };
        let priors = (0..3).map(|i| PosePrior {
            pose: Pose {
                rotation: pose(i).rotation * so3::exp(three(i + 5, 0.05)),
                center: pose(i).center + three(i + 1, 1.0),
            },
            velocity: DVec3::new(5.0, 0.5, 0.0),
            position_weight: DVec3::new(1.0, 1.0, 2.0),
            rotation_weight: DVec3::splat(12.0),
        });
        let mut problem = Problem {
            moving: 3,
            intrinsics: vec![LENS; 3],
            poses: (0..3).map(pose).collect(),
            priors: priors.collect(),
            points: (0..12)
                .map(|i| DVec3::new((i % 4) as f64 * 8.0 - 3.0, (i / 4) as f64 * 8.0 - 8.0, wobble(i, 4)))
                .collect(),
            starts: (0..=12).map(|i| 3 * i).collect(),
            observations: Vec::new(),
            anchors: Vec::new(),
            shared: Shared {
                mount: so3::exp(DVec3::new(0.01, -0.02, 0.015)),
                delay: 0.1,
                lens: Calibration {
                    log_focal: 0.03,
                    log_aspect: -0.01,
                    shift: DVec2::new(0.01, 0.02),
                    radial: Radial { k1: -0.04, k2: 0.02 },
                },
            },
            shared_weight: [20.0, 20.0, 20.0, 1.0, 10.0, 200.0, 50.0, 50.0, 20.0, 20.0],
            free: [true; SHARED],
            pixel_sigma: 0.4,
        };
        for point in 0..12 {
            for camera in 0..3 {
                let at = problem.camera(camera);
                let seen = problem.shared.lens.radial.pixel(&at, at.local(problem.points[point]));
                let seen = seen + DVec2::new(wobble(point, camera), wobble(camera, point)) * 2.0;
                problem.observations.push(Observation { camera: camera as u32, pixel: seen.as_vec2().to_array() });
            }
        }
        problem
    }

    #[test]
    fn the_gradient_by_every_pose_and_shared_parameter_is_that_of_finite_differences() {
        let mut problem = scene();
        let mut equations = Reduced::new(&problem);
        // Damped so heavily points stand still, and the reduced gradient is the plain one.
        equations.fill(&problem, LOSS, 1e18);
        let still = [DVec3::ZERO; 12];
        let none = Step { frames: vec![FrameVec::zeros(); 3], shared: SharedVec::zeros() };
        let mut slope = |step: &dyn Fn(&mut Step, f64)| {
            let h = 1e-6;
            let before = (problem.poses.clone(), problem.shared);
            let [fore, back] = [h, -h].map(|h| {
                let mut moved = none.clone();
                step(&mut moved, h);
                apply(&mut problem, &moved, &still);
                let cost = problem.cost(LOSS);
                (problem.poses, problem.shared) = before.clone();
                cost
            });
            // The normal equations hold half of the cost's gradient.
            (fore - back) / (4.0 * h)
        };
        let close = |found: f64, wanted: f64, what: String| {
            assert!((found - wanted).abs() < 2e-4 * (1.0 + wanted.abs()), "{what}: {found} {wanted}");
        };
        for i in 0..3 {
            for k in 0..6 {
                let wanted = slope(&|s, h| s.frames[i][k] = h);
                close(equations.gradient[i][k], wanted, format!("frame {i}, {k}"));
            }
        }
        for k in 0..SHARED {
            let wanted = slope(&|s, h| s.shared[k] = h);
            close(equations.shared_gradient[k], wanted, format!("shared {k}"));
        }
    }

    #[test]
    fn the_lens_is_told_where_nothing_could_tell_what_is_known_exactly() {
        let mut problem = scene();
        problem.priors.iter_mut().for_each(|p| p.velocity = DVec3::ZERO);
        problem.shared_weight[..FOCAL].fill(0.0);
        let sigma = shared_sigma(&mut problem, LOSS);
        assert!(sigma[FOCAL..].iter().all(|s| s.is_finite() && *s > 0.0), "{sigma:?}");
    }

    #[test]
    fn sightings_that_repeat_each_other_do_not_outweigh_what_is_known_of_the_lens() {
        let focal = |times: usize| {
            let mut problem = scene();
            // Nothing but the focal length and the points moves.
            problem.priors.iter_mut().zip(&problem.poses).for_each(|(prior, pose)| {
                (prior.pose, prior.velocity) = (*pose, DVec3::ZERO);
                (prior.position_weight, prior.rotation_weight) = (DVec3::splat(1e7), DVec3::splat(1e7));
            });
            problem.shared.mount = glam::DQuat::IDENTITY;
            problem.free = std::array::from_fn(|k| k == FOCAL);
            problem.shared_weight[FOCAL] = 1000.0;
            let seen = problem.observations.clone();
            problem.observations = seen.chunks(3).flat_map(|of| of.repeat(times)).collect();
            problem.starts = (0..=12).map(|i| 3 * (i * times) as u32).collect();
            let deadline = Instant::now() + std::time::Duration::from_secs(60);
            adjust(&mut problem, Limits { loss: Loss::Cauchy(1e6), max_steps: 60, deadline });
            problem.shared.lens.log_focal
        };
        let (once, often) = (focal(1), focal(40));
        assert!(once.abs() > 1e-4 && (once - often).abs() < 0.02 * once.abs(), "{once} {often}");
    }
}

//! A multirotor flying a survey, computed before take-off: what really happened (truth) and what its sensors make
//! of it (reported). Wind, gimbal, GPS and shutter are wrong in the ways real ones are; all of it follows from the seed.

use geometry::geodesy::Geodetic;
use glam::{DQuat, DVec2, DVec3};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::survey::{Line, Route};
use super::track::{Sample, Track};
use hal::frames::{euler_to_ned, ned_to_enu};

/// Time step of the simulation, seconds.
const STEP: f64 = 0.02;
/// Standing still at both ends of the flight, seconds.
const HOVER: f64 = 3.0;
/// Acceleration along the path, m/s² (ArduCopter's WPNAV_ACCEL is 2.5).
const ACCELERATION: f64 = 2.5;
/// Longest flight simulated, seconds.
const LONGEST: f64 = 3600.0;
/// A waypoint is reached this near to it, metres; ArduCopter slows down within its WPNAV_RADIUS of 2 m.
const NEAR: f64 = 0.3;
/// Most pictures along one leg: nobody's memory holds more.
const MOST_SHOTS: usize = 10_000;
/// A route begins this far before its first waypoint, metres, so that a picture may be taken there.
const RUN_UP: f64 = 5.0;
/// A heading is taken when it is off by no more than this, radians.
const TURNED: f64 = 0.03;
/// Acceleration by gravity, m/s².
const GRAVITY: f64 = 9.81;

/// One standard deviation of everything that is not as it should be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Imperfections {
    /// Mean wind towards east and north, m/s.
    pub wind_ms: [f64; 2],
    /// Gusts, m/s.
    pub gust_ms: f64,
    /// Slowly wandering GPS error, horizontal, metres (vertical is 1.5 times as much).
    pub gps_bias_m: f64,
    /// Fast position noise after the autopilot's filter, metres.
    pub gps_noise_m: f64,
    /// Attitude estimate, roll and pitch, degrees.
    pub attitude_noise_deg: f64,
    /// Constant error of the compass heading, degrees.
    pub yaw_bias_deg: f64,
    /// How far the gimbal strays from its set angle (reported truly), degrees.
    pub gimbal_stray_deg: f64,
    /// Autopilot's clock against the companion's, parts per million.
    pub clock_drift_ppm: f64,
    /// From the trigger to the middle of the exposure, milliseconds.
    pub shutter_delay_ms: f64,
    /// Its scatter, milliseconds.
    pub shutter_jitter_ms: f64,
    /// From the exposure to the finished file, milliseconds.
    pub transfer_ms: f64,
}

impl Default for Imperfections {
    fn default() -> Self {
        Self {
            wind_ms: [2.0, 1.0],
            gust_ms: 1.0,
            gps_bias_m: 0.5,
            gps_noise_m: 0.05,
            attitude_noise_deg: 0.4,
            yaw_bias_deg: 1.0,
            gimbal_stray_deg: 0.3,
            clock_drift_ppm: 20.0,
            shutter_delay_ms: 60.0,
            shutter_jitter_ms: 3.0,
            transfer_ms: 250.0,
        }
    }
}

impl Imperfections {
    /// An aircraft that measures everything exactly.
    pub fn none() -> Self {
        Self {
            wind_ms: [0.0; 2],
            gust_ms: 0.0,
            gps_bias_m: 0.0,
            gps_noise_m: 0.0,
            attitude_noise_deg: 0.0,
            yaw_bias_deg: 0.0,
            gimbal_stray_deg: 0.0,
            clock_drift_ppm: 0.0,
            shutter_delay_ms: 0.0,
            shutter_jitter_ms: 0.0,
            transfer_ms: 50.0,
        }
    }
}

/// One picture to be taken.
#[derive(Clone, Debug, PartialEq)]
pub struct Exposure {
    /// When the autopilot triggers, seconds of flight.
    pub trigger_s: f64,
    /// Middle of the exposure, seconds of flight.
    pub middle_s: f64,
    /// When the file is complete, seconds of flight.
    pub ready_s: f64,
    /// File name.
    pub name: String,
}

/// A whole flight.
#[derive(Clone, Debug)]
pub struct Flight {
    /// Origin of the ENU frame of both tracks; the aircraft's home.
    pub origin: Geodetic,
    /// What happened.
    pub truth: Track,
    /// What the autopilot believes.
    pub reported: Track,
    /// Pictures in order.
    pub exposures: Vec<Exposure>,
}

/// Noise that forgets with a time constant (Ornstein–Uhlenbeck), on three axes.
struct Wander {
    value: DVec3,
    sigma: f64,
    keep: f64,
}

impl Wander {
    fn new(sigma: f64, time_constant_s: f64, random: &mut Pcg64Mcg) -> Self {
        Self { value: normal3(random) * sigma, sigma, keep: (-STEP / time_constant_s).exp() }
    }

    fn step(&mut self, random: &mut Pcg64Mcg) -> DVec3 {
        self.value = self.value * self.keep + normal3(random) * (self.sigma * (1.0 - self.keep * self.keep).sqrt());
        self.value
    }
}

/// A standard normal number (Box–Muller).
fn normal(random: &mut Pcg64Mcg) -> f64 {
    let (a, b): (f64, f64) = (random.random(), random.random());
    (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

fn normal3(random: &mut Pcg64Mcg) -> DVec3 {
    DVec3::new(normal(random), normal(random), normal(random))
}

/// One straight stretch, with the places along it where pictures are taken, metres from its start.
#[derive(Clone, Debug)]
pub struct Leg {
    from: DVec3,
    to: DVec3,
    shots: Vec<f64>,
    /// Heading that a picture waits for, radians clockwise from north; else the nose follows the leg.
    yaw: Option<f64>,
}

impl Leg {
    /// The legs of a survey alternate: a line with pictures, then the way to the next one.
    pub fn of_lines(lines: &[Line], height_m: f64) -> Vec<Self> {
        let leg = |from: DVec2, to: DVec2, shots: &[f64]| Self {
            from: from.extend(height_m),
            to: to.extend(height_m),
            shots: shots.to_vec(),
            yaw: None,
        };
        let mut legs = Vec::with_capacity(2 * lines.len());
        for (k, line) in lines.iter().enumerate() {
            if k > 0 {
                legs.push(leg(lines[k - 1].to, line.from, &[]));
            }
            legs.push(leg(line.from, line.to, &line.exposures));
        }
        legs
    }

    /// The legs of a route; pictures are taken at their ends, or along them.
    pub fn of_route(route: &Route) -> Vec<Self> {
        let mut legs = Vec::with_capacity(route.waypoints.len());
        let mut from = route.waypoints.first().map_or(DVec3::ZERO, |w| w.position - DVec3::Y * RUN_UP);
        // Metres between pictures, and from here to the next one.
        let mut along: Option<(f64, f64)> = None;
        for waypoint in &route.waypoints {
            let to = waypoint.position;
            let length = (to - from).length();
            let end = length - NEAR;
            let mut shots = Vec::new();
            if let Some((every_m, next)) = &mut along {
                while *next <= length && shots.len() < MOST_SHOTS {
                    shots.push(next.min(end.max(0.0)));
                    *next += *every_m;
                }
                *next -= length;
            }
            if waypoint.picture && shots.last().is_none_or(|last| *last < end) {
                shots.push(end);
            }
            legs.push(Self { from, to, shots, yaw: waypoint.yaw_deg.map(f64::to_radians) });
            // The distance is counted anew where it changes.
            along = waypoint.every_m.map(|m| along.filter(|a| a.0 == m).unwrap_or((m, 0.0)));
            from = to;
        }
        legs
    }

    /// Pictures along it.
    pub fn pictures(&self) -> usize {
        self.shots.len()
    }

    fn direction(&self) -> Option<DVec3> {
        let way = self.to - self.from;
        (way.length() > 1e-6).then(|| way.normalize())
    }

    /// Where the nose points along it, radians clockwise from north; `None` when it goes straight up or nowhere.
    fn heading(&self) -> Option<f64> {
        self.direction().map(|d| d.truncate()).filter(|d| d.length() > 1e-6).map(|d| d.x.atan2(d.y))
    }
}

/// How legs are flown.
#[derive(Clone, Copy, Debug)]
pub struct Manner {
    /// Speed along them, m/s.
    pub speed_ms: f64,
    /// Pitch of the camera, degrees.
    pub gimbal_pitch_deg: f64,
}

/// Name of a camera's picture by its number.
pub fn picture_name(prefix: &str, number: u64) -> String {
    format!("{prefix}{number:04}.jpg")
}

/// Flies `legs`, metres around `origin`; `None` when there are none.
///
/// Pictures are called `{prefix}0001.jpg` and so on.
pub fn fly(
    origin: Geodetic,
    legs: &[Leg],
    manner: Manner,
    wrong: &Imperfections,
    prefix: &str,
    seed: u64,
) -> Option<Flight> {
    let (first, last) = (legs.first()?, legs.last()?);
    let random = &mut Pcg64Mcg::seed_from_u64(seed);
    let mut gust = Wander::new(wrong.gust_ms, 2.0, random);
    let mut bias = Wander::new(wrong.gps_bias_m, 150.0, random);
    let mut noise = Wander::new(wrong.gps_noise_m, 1.0, random);
    let mut tilt_error = Wander::new(wrong.attitude_noise_deg.to_radians(), 8.0, random);
    let mut stray = Wander::new(wrong.gimbal_stray_deg.to_radians(), 0.8, random);
    let yaw_bias = wrong.yaw_bias_deg.to_radians() * normal(random);
    let mean_wind = DVec3::new(wrong.wind_ms[0], wrong.wind_ms[1], 0.0);
    let pitch = manner.gimbal_pitch_deg.to_radians();
    let mut yaw = first.yaw.or(first.heading()).unwrap_or(0.0);

    let (mut truth, mut reported, mut exposures) = (Vec::new(), Vec::new(), Vec::new());
    let mut position = first.from;
    let mut velocity = DVec3::ZERO;
    let (mut leg, mut progress, mut pace, mut shot) = (0, 0.0, 0.0, 0);
    let mut after = 0.0;
    for k in 0.. {
        let time_s = k as f64 * STEP;
        // The point the autopilot follows, slowing down before each corner.
        let current = legs.get(leg).unwrap_or(last);
        let shots = legs.get(leg).map_or(&[][..], |leg| &leg.shots);
        let (from, length) = (current.from, (current.to - current.from).length());
        let direction = current.direction().unwrap_or(DVec3::Y);
        if leg < legs.len() && time_s > HOVER {
            let limit = (2.0 * ACCELERATION * (length - progress).max(0.0)).sqrt() + 0.3;
            pace = (pace + ACCELERATION * STEP).min(manner.speed_ms).min(limit);
            progress += pace * STEP;
        } else {
            pace = 0.0;
        }
        let aim = from + direction * progress.min(length);
        let aim_velocity = direction * pace;
        // Position controller (critically damped at 1.6 rad/s) against drag from wind and gusts.
        let wind = mean_wind + gust.step(random);
        let drag = 0.12 * (wind - velocity);
        let wanted = (aim - position) * 2.56 + (aim_velocity - velocity) * 3.2;
        let control = wanted.clamp_length_max(6.0) - 0.12 * (mean_wind - aim_velocity);
        let acceleration = control + drag;
        velocity += acceleration * STEP;
        position += velocity * STEP;
        // A multirotor leans the way its thrust must point; yaw follows the leg at 60°/s at most.
        let heading = current.yaw.or(current.heading()).unwrap_or(yaw);
        let turn = (heading - yaw + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
        yaw += turn.clamp(-1.05 * STEP, 1.05 * STEP);
        let attitude = lean(control + DVec3::Z * GRAVITY, yaw);
        let s = stray.step(random);
        let gimbal = euler_to_ned(s.z, pitch + s.y, yaw + s.x);
        truth.push(Sample { time_s, position, velocity, attitude, gimbal });

        let e = tilt_error.step(random);
        let error = DQuat::from_scaled_axis(DVec3::new(e.x, e.y, yaw_bias + 0.5 * e.z));
        let (b, n) = (bias.step(random), noise.step(random));
        let gps = DVec3::new(b.x + n.x, b.y + n.y, 1.5 * (b.z + n.z));
        reported.push(Sample {
            time_s,
            position: position + gps,
            velocity: velocity + 0.05 * n,
            attitude: (error * attitude).normalize(),
            gimbal: (error * gimbal).normalize(),
        });

        // Triggered by distance along the line, as CAM_TRIGG_DIST does; with a heading asked for, when it is there.
        let turned = current.yaw.is_none() || turn.abs() < TURNED;
        while turned && shot < shots.len() && (position - from).dot(direction) >= shots[shot] {
            let middle_s =
                time_s + (wrong.shutter_delay_ms + wrong.shutter_jitter_ms * normal(random)).max(0.0) / 1000.0;
            let name = picture_name(prefix, exposures.len() as u64 + 1);
            exposures.push(Exposure {
                trigger_s: time_s,
                middle_s,
                ready_s: middle_s + wrong.transfer_ms / 1000.0,
                name,
            });
            shot += 1;
        }
        // The vehicle lags its aim: a leg ends when its last picture is taken.
        if leg < legs.len() && progress >= length && (shot == shots.len() || (aim - position).length() < 0.05) {
            (leg, progress, shot) = (leg + 1, 0.0, 0);
        }
        if leg >= legs.len() {
            (leg, progress) = (legs.len(), length);
            after += STEP;
        }
        if after > HOVER || time_s > LONGEST {
            break;
        }
    }
    Some(Flight { origin, truth: Track::new(truth)?, reported: Track::new(reported)?, exposures })
}

/// FRD → NED of a multirotor that pushes along `thrust` (ENU) with its nose towards `yaw`.
fn lean(thrust: DVec3, yaw: f64) -> DQuat {
    let down = -ned_to_enu(thrust).normalize();
    let (sin, cos) = yaw.sin_cos();
    // In the frame turned by yaw: down = (sin p cos r, −sin r, cos p cos r).
    let (fx, fy, fz) = (cos * down.x + sin * down.y, -sin * down.x + cos * down.y, down.z);
    euler_to_ned(-fy.clamp(-1.0, 1.0).asin(), fx.atan2(fz), yaw)
}

/// Angle between two attitudes, radians.
pub fn angle_between(a: DQuat, b: DQuat) -> f64 {
    2.0 * (a.conjugate() * b).xyz().length().min(1.0).asin()
}

#[cfg(test)]
mod tests;

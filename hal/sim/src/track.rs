//! A path through space and attitude, sampled in time.

use glam::{DQuat, DVec3};

/// Where vehicle and camera mount were at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Seconds since the start of the flight.
    pub time_s: f64,
    /// East, north, up, metres.
    pub position: DVec3,
    /// East, north, up, m/s.
    pub velocity: DVec3,
    /// Vehicle FRD → NED.
    pub attitude: DQuat,
    /// Gimbal FRD (x along the optical axis) → NED.
    pub gimbal: DQuat,
}

/// Samples in order of time, at least one.
#[derive(Clone, Debug)]
pub struct Track {
    samples: Vec<Sample>,
}

impl Track {
    /// A track of samples with strictly growing times; `None` when there is no sample or time stands still.
    pub fn new(samples: Vec<Sample>) -> Option<Self> {
        let ordered = samples.windows(2).all(|w| w[1].time_s > w[0].time_s);
        let finite = samples.iter().all(|s| s.time_s.is_finite() && s.position.is_finite() && s.attitude.is_finite());
        (!samples.is_empty() && ordered && finite).then_some(Self { samples })
    }

    /// Samples at given places with velocities such that the path through them is smooth (Catmull–Rom on uneven times).
    pub fn smooth(mut samples: Vec<Sample>) -> Option<Self> {
        let n = samples.len();
        for k in 0..n {
            let (a, b) = (k.saturating_sub(1), (k + 1).min(n - 1));
            let span = samples[b].time_s - samples[a].time_s;
            samples[k].velocity =
                if span > 0.0 { (samples[b].position - samples[a].position) / span } else { DVec3::ZERO };
        }
        // At rest at both ends, as before take-off and after landing.
        if let Some(first) = samples.first_mut() {
            first.velocity = DVec3::ZERO;
        }
        if let Some(last) = samples.last_mut() {
            last.velocity = DVec3::ZERO;
        }
        Self::new(samples)
    }

    /// Time of the last sample, seconds.
    pub fn end_s(&self) -> f64 {
        self.samples[self.samples.len() - 1].time_s
    }

    /// The state at a time: cubic Hermite in position, slerp in attitude, at rest before the start and after the end.
    pub fn at(&self, time_s: f64) -> Sample {
        let next = self.samples.partition_point(|s| s.time_s <= time_s);
        if next == 0 || next == self.samples.len() {
            let s = self.samples[next.saturating_sub(1)];
            return Sample { time_s, velocity: DVec3::ZERO, ..s };
        }
        let (a, b) = (&self.samples[next - 1], &self.samples[next]);
        let h = b.time_s - a.time_s;
        let u = (time_s - a.time_s) / h;
        let (u2, u3) = (u * u, u * u * u);
        let position = a.position * (2.0 * u3 - 3.0 * u2 + 1.0)
            + a.velocity * (h * (u3 - 2.0 * u2 + u))
            + b.position * (3.0 * u2 - 2.0 * u3)
            + b.velocity * (h * (u3 - u2));
        let velocity = (b.position - a.position) * (6.0 * (u - u2) / h)
            + a.velocity * (3.0 * u2 - 4.0 * u + 1.0)
            + b.velocity * (3.0 * u2 - 2.0 * u);
        Sample {
            time_s,
            position,
            velocity,
            attitude: a.attitude.slerp(b.attitude, u).normalize(),
            gimbal: a.gimbal.slerp(b.gimbal, u).normalize(),
        }
    }

    /// Angular velocity of the vehicle about its own axes, rad/s.
    pub fn rates(&self, time_s: f64) -> DVec3 {
        const STEP: f64 = 0.02;
        let (a, b) = (self.at(time_s - STEP).attitude, self.at(time_s + STEP).attitude);
        let turn = a.conjugate() * b;
        let turn = if turn.w < 0.0 { -turn } else { turn };
        turn.to_scaled_axis() / (2.0 * STEP)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(time_s: f64, x: f64, yaw: f64) -> Sample {
        let attitude = DQuat::from_rotation_z(yaw);
        Sample { time_s, position: DVec3::new(x, -x, 40.0), velocity: DVec3::ZERO, attitude, gimbal: attitude }
    }

    #[test]
    fn a_track_passes_through_its_samples_without_corners() {
        let track = Track::smooth(vec![
            sample(0.0, 0.0, 0.0),
            sample(10.0, 20.0, 0.2),
            sample(14.0, 21.0, 0.5),
            sample(30.0, 0.0, 3.0),
        ])
        .expect("ordered");
        for (t, x) in [(0.0, 0.0), (10.0, 20.0), (14.0, 21.0), (30.0, 0.0), (-5.0, 0.0), (99.0, 0.0)] {
            assert!((track.at(t).position.x - x).abs() < 1e-9, "{t}");
        }
        let (before, after) = (track.at(10.0 - 1e-6).velocity, track.at(10.0 + 1e-6).velocity);
        assert!((before - after).length() < 1e-3 && before.length() > 0.5);
        // The velocity is the derivative of the position.
        let slope = (track.at(5.001).position - track.at(4.999).position) / 0.002;
        assert!((slope - track.at(5.0).velocity).length() < 1e-4);
        assert!((track.rates(5.0).z - 0.02).abs() < 1e-9);
    }

    #[test]
    fn times_that_do_not_grow_are_refused() {
        assert!(Track::new(vec![]).is_none());
        assert!(Track::new(vec![sample(1.0, 0.0, 0.0), sample(1.0, 1.0, 0.0)]).is_none());
    }
}

//! A curve of fixed size for a series of unknown length: when it is full, neighbours become one point and every point stands
//! for twice as many values.

/// Points at most: one for every other pixel of the drawing.
const POINTS: usize = 256;

/// Means of a series, oldest first. Takes its memory when it is made.
#[derive(Clone, Debug)]
pub struct Curve {
    points: Vec<[f32; 2]>,
    /// Values that a point stands for.
    stride: u32,
    sum: [f64; 2],
    summed: u32,
}

impl Default for Curve {
    fn default() -> Self {
        Self { points: Vec::with_capacity(POINTS), stride: 1, sum: [0.0; 2], summed: 0 }
    }
}

impl Curve {
    /// Adds a value; one that is no number is left out.
    pub fn push(&mut self, x: f64, y: f64) {
        if !x.is_finite() || !y.is_finite() {
            return;
        }
        self.sum = [self.sum[0] + x, self.sum[1] + y];
        self.summed += 1;
        if self.summed < self.stride {
            return;
        }
        if self.points.len() == POINTS {
            self.halve();
            if self.summed < self.stride {
                return;
            }
        }
        let n = f64::from(self.summed);
        self.points.push(self.sum.map(|v| (v / n) as f32));
        (self.sum, self.summed) = ([0.0; 2], 0);
    }

    fn halve(&mut self) {
        for i in 0..POINTS / 2 {
            let [a, b] = [self.points[2 * i], self.points[2 * i + 1]];
            self.points[i] = [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])];
        }
        self.points.truncate(POINTS / 2);
        self.stride = self.stride.saturating_mul(2);
    }

    /// The points.
    pub fn points(&self) -> &[[f32; 2]] {
        &self.points
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_keeps_its_size_its_ends_and_its_shape() {
        let mut curve = Curve::default();
        let room = curve.points.capacity();
        for i in 0..1_000_000u32 {
            curve.push(f64::from(i), 2.0 * f64::from(i));
            curve.push(f64::from(i), f64::NAN);
        }
        let points = curve.points();
        assert_eq!(curve.points.capacity(), room);
        assert!((POINTS / 2..=POINTS).contains(&points.len()), "{}", points.len());
        assert!(points.iter().all(|p| (p[1] - 2.0 * p[0]).abs() < 1.0));
        assert!(points.is_sorted_by(|a, b| a[0] < b[0]));
        assert!(points[0][0] < 10_000.0 && points[points.len() - 1][0] > 980_000.0);
    }
}

//! The ground: a bilinear height field that a ray meets exactly (a quadratic per cell), flat beyond its border.

use glam::{DVec2, DVec3};

use super::noise::noise;

/// Spacing of the height samples, metres.
const CELL: f64 = 2.0;
/// Width of the band along the border over which the relief falls to the plane z = 0, metres.
const BORDER: f64 = 40.0;

/// Heights on a square grid around the origin; z = 0 outside of it.
pub struct Terrain {
    half: f64,
    n: usize,
    heights: Vec<f32>,
    low: f64,
    high: f64,
}

impl Terrain {
    /// Rolling ground of about `relief` metres from lowest to highest, over ±`half` metres.
    pub fn new(seed: u32, half: f64, relief: f32) -> Self {
        let n = (2.0 * half / CELL).ceil() as usize + 1;
        let half = (n - 1) as f64 * CELL / 2.0;
        let mut heights = Vec::with_capacity(n * n);
        for j in 0..n {
            for i in 0..n {
                let (x, y) = (i as f64 * CELL - half, j as f64 * CELL - half);
                let inside = ((half - x.abs().max(y.abs())) / BORDER).clamp(0.0, 1.0) as f32;
                let shape = 0.6 * noise(x / 160.0, y / 160.0, seed)
                    + 0.3 * noise(x / 61.0, y / 61.0, seed ^ 0x51)
                    + 0.1 * noise(x / 23.0, y / 23.0, seed ^ 0xA3);
                heights.push(0.5 * relief * shape * inside * inside * (3.0 - 2.0 * inside));
            }
        }
        let (low, high) = heights.iter().fold((0.0f32, 0.0f32), |(l, h), &z| (l.min(z), h.max(z)));
        Self { half, n, heights, low: f64::from(low), high: f64::from(high) }
    }

    /// Half the side of the square that has relief, metres.
    pub fn half(&self) -> f64 {
        self.half
    }

    /// The four heights of a cell as a + b·u + c·v + d·u·v with u, v in 0..1.
    #[inline]
    fn patch(&self, i: usize, j: usize) -> [f64; 4] {
        let k = j * self.n + i;
        let (h00, h10) = (f64::from(self.heights[k]), f64::from(self.heights[k + 1]));
        let (h01, h11) = (f64::from(self.heights[k + self.n]), f64::from(self.heights[k + self.n + 1]));
        [h00, h10 - h00, h01 - h00, h00 + h11 - h10 - h01]
    }

    /// Cell index along one axis, None outside.
    #[inline]
    fn cell(&self, a: f64) -> Option<usize> {
        let c = (a + self.half) / CELL;
        (c >= 0.0 && c < (self.n - 1) as f64).then_some(c as usize)
    }

    /// Height above z = 0 at a place, metres.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        let (Some(i), Some(j)) = (self.cell(x), self.cell(y)) else { return 0.0 };
        let (u, v) = ((x + self.half) / CELL - i as f64, (y + self.half) / CELL - j as f64);
        let [a, b, c, d] = self.patch(i, j);
        a + b * u + c * v + d * u * v
    }

    /// Upward unit normal at a place.
    pub fn normal(&self, x: f64, y: f64) -> DVec3 {
        let (Some(i), Some(j)) = (self.cell(x), self.cell(y)) else { return DVec3::Z };
        let (u, v) = ((x + self.half) / CELL - i as f64, (y + self.half) / CELL - j as f64);
        let [_, b, c, d] = self.patch(i, j);
        DVec3::new(-(b + d * v) / CELL, -(c + d * u) / CELL, 1.0).normalize()
    }

    /// Parameter t ≥ `from` at which `origin + t·direction` first meets the ground, if it does.
    pub fn hit(&self, origin: DVec3, direction: DVec3, from: f64) -> Option<f64> {
        // Enter the slab that holds the relief; above it there is nothing to meet.
        let mut t = from;
        if origin.z + t * direction.z > self.high {
            if direction.z >= 0.0 {
                return None;
            }
            t = (self.high - origin.z) / direction.z;
        }
        // The square's own interval along the ray; before and after it the ground is the plane z = 0.
        let (mut enter, mut leave) = (t, f64::INFINITY);
        for axis in 0..2 {
            if direction[axis].abs() < 1e-12 {
                if origin[axis].abs() > self.half {
                    leave = f64::NEG_INFINITY;
                }
                continue;
            }
            let a = (-self.half - origin[axis]) / direction[axis];
            let b = (self.half - origin[axis]) / direction[axis];
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        let plane = (direction.z < 0.0).then(|| -origin.z / direction.z).filter(|p| *p >= t);
        if enter >= leave {
            return plane;
        }
        match plane {
            Some(p) if p < enter => Some(p),
            _ => self.walk(origin, direction, enter, leave).or(plane.filter(|p| *p >= leave)),
        }
    }

    /// Cell by cell between two parameters.
    fn walk(&self, origin: DVec3, direction: DVec3, enter: f64, leave: f64) -> Option<f64> {
        let start = (origin.truncate() + enter * direction.truncate() + DVec2::splat(self.half)) / CELL;
        let last = (self.n - 2) as f64;
        let (mut i, mut j) = (start.x.clamp(0.0, last) as i64, start.y.clamp(0.0, last) as i64);
        let step = |d: f64| if d > 0.0 { 1i64 } else { -1 };
        let (si, sj) = (step(direction.x), step(direction.y));
        let delta = |d: f64| if d.abs() < 1e-12 { f64::INFINITY } else { CELL / d.abs() };
        let next = |cell: i64, s: i64, o: f64, d: f64| {
            if d.abs() < 1e-12 { f64::INFINITY } else { ((cell + i64::from(s > 0)) as f64 * CELL - self.half - o) / d }
        };
        let (di, dj) = (delta(direction.x), delta(direction.y));
        let mut ti = next(i, si, origin.x, direction.x);
        let mut tj = next(j, sj, origin.y, direction.y);
        let mut t = enter;
        while i >= 0 && j >= 0 && i < (self.n - 1) as i64 && j < (self.n - 1) as i64 {
            let out = ti.min(tj).min(leave);
            // In the cell's own coordinates the gap between ray and ground is quadratic in t.
            let [a, b, c, d] = self.patch(i as usize, j as usize);
            let u0 = (origin.x + self.half) / CELL - i as f64;
            let v0 = (origin.y + self.half) / CELL - j as f64;
            let (du, dv) = (direction.x / CELL, direction.y / CELL);
            let q2 = -d * du * dv;
            let q1 = direction.z - b * du - c * dv - d * (u0 * dv + v0 * du);
            let q0 = origin.z - a - b * u0 - c * v0 - d * u0 * v0;
            if out.is_infinite() {
                // Straight down (or up): the gap is linear.
                return (q1 < 0.0).then(|| -q0 / q1).filter(|t| *t >= enter);
            }
            if q0 + out * (q1 + out * q2) <= 0.0 {
                return Some(first_root(q2, q1, q0, t, out));
            }
            if direction.z < 0.0 && origin.z + out * direction.z < self.low {
                return None;
            }
            if direction.z >= 0.0 && origin.z + out * direction.z > self.high {
                return None;
            }
            t = out;
            if t >= leave {
                return None;
            }
            if ti < tj {
                i += si;
                ti += di;
            } else {
                j += sj;
                tj += dj;
            }
        }
        None
    }
}

/// The root of q2·t² + q1·t + q0 inside [low, high], in the form that does not cancel.
#[inline]
fn first_root(q2: f64, q1: f64, q0: f64, low: f64, high: f64) -> f64 {
    if q2.abs() < 1e-14 {
        return if q1 == 0.0 { low } else { (-q0 / q1).clamp(low, high) };
    }
    let s = -0.5 * (q1 + q1.signum() * (q1 * q1 - 4.0 * q2 * q0).max(0.0).sqrt());
    let (r1, r2) = (s / q2, if s == 0.0 { f64::INFINITY } else { q0 / s });
    let slack = 1e-9 * (1.0 + high.abs());
    [r1.min(r2), r1.max(r2)]
        .into_iter()
        .find(|r| *r >= low - slack && *r <= high + slack)
        .unwrap_or(high)
        .clamp(low, high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_hit_lies_on_the_height_field() {
        let ground = Terrain::new(3, 100.0, 8.0);
        let mut hits = 0;
        for k in 0..4_000 {
            let a = f64::from(k) * 0.37;
            let origin = DVec3::new(70.0 * a.sin(), 60.0 * (1.3 * a).cos(), 30.0 + 8.0 * (0.7 * a).sin());
            let tilt = f64::from(k % 41) * 0.03;
            let direction = DVec3::new(tilt * (2.1 * a).cos(), tilt * (2.1 * a).sin(), -1.0);
            let t = ground.hit(origin, direction, 0.0).expect("downward rays always hit");
            let p = origin + t * direction;
            assert!((p.z - ground.height(p.x, p.y)).abs() < 1e-7, "{k}: {p} over {}", ground.height(p.x, p.y));
            hits += 1;
        }
        assert_eq!(hits, 4_000);
    }

    #[test]
    fn flat_ground_gives_the_analytic_depth_inside_and_beyond_the_border() {
        let ground = Terrain::new(3, 60.0, 0.0);
        for (x, y) in [(0.0, 0.0), (0.3, -0.7), (3.0, 0.0), (-5.0, 4.0)] {
            let t = ground.hit(DVec3::new(1.0, 2.0, 40.0), DVec3::new(x, y, -1.0), 0.0).expect("hit");
            assert!((t - 40.0).abs() < 1e-9, "{x} {y}: {t}");
        }
        assert_eq!(ground.hit(DVec3::new(0.0, 0.0, 5.0), DVec3::new(1.0, 0.0, 0.1), 0.0), None);
    }
}

//! The sums a voxel keeps of its samples: enough for mean, covariance, colour and the error of merging.

use glam::{Mat3, Vec3};

use super::{Merged, Sample};

/// Sums over the samples of one cell, positions relative to the cell's centre (f32 keeps its digits).
#[derive(Clone, Copy, Debug)]
pub struct Cell {
    /// Morton key.
    pub key: u64,
    /// Samples.
    count: f32,
    /// Σ w.
    weight: f32,
    /// Σ w·x.
    first: Vec3,
    /// Σ w·x·xᵀ: xx, xy, xz, yy, yz, zz.
    second: [f32; 6],
    /// Σ w·Σₛ, same order.
    own: [f32; 6],
    /// Σ w·colour.
    color: Vec3,
    /// Σ w·|colour|².
    color2: f32,
    /// Σ w·opacity.
    opacity: f32,
}

fn outer(v: Vec3) -> [f32; 6] {
    [v.x * v.x, v.x * v.y, v.x * v.z, v.y * v.y, v.y * v.z, v.z * v.z]
}

fn symmetric(m: &[f32; 6]) -> Mat3 {
    Mat3::from_cols(Vec3::new(m[0], m[1], m[2]), Vec3::new(m[1], m[3], m[4]), Vec3::new(m[2], m[4], m[5]))
}

impl Cell {
    /// Nothing yet.
    pub fn empty(key: u64) -> Self {
        Self {
            key,
            count: 0.0,
            weight: 0.0,
            first: Vec3::ZERO,
            second: [0.0; 6],
            own: [0.0; 6],
            color: Vec3::ZERO,
            color2: 0.0,
            opacity: 0.0,
        }
    }

    /// Adds a sample; `center` is the cell's centre.
    pub fn add(&mut self, s: &Sample, center: Vec3) {
        let x = s.position - center;
        let w = s.weight;
        self.count += 1.0;
        self.weight += w;
        self.first += x * w;
        let xx = outer(x);
        let c = s.covariance;
        let own = [c.x_axis.x, c.x_axis.y, c.x_axis.z, c.y_axis.y, c.y_axis.z, c.z_axis.z];
        for k in 0..6 {
            self.second[k] += w * xx[k];
            self.own[k] += w * own[k];
        }
        self.color += s.color * w;
        self.color2 += s.color.length_squared() * w;
        self.opacity += s.opacity * w;
    }

    /// Adds a child whose centre lies `offset` away from this cell's centre (parallel axis theorem).
    pub fn add_child(&mut self, child: &Self, offset: Vec3) {
        self.count += child.count;
        self.weight += child.weight;
        let f = child.first;
        let cross = [
            2.0 * f.x * offset.x,
            f.x * offset.y + f.y * offset.x,
            f.x * offset.z + f.z * offset.x,
            2.0 * f.y * offset.y,
            f.y * offset.z + f.z * offset.y,
            2.0 * f.z * offset.z,
        ];
        let oo = outer(offset);
        for k in 0..6 {
            self.second[k] += child.second[k] + cross[k] + child.weight * oo[k];
            self.own[k] += child.own[k];
        }
        self.first += f + offset * child.weight;
        self.color += child.color;
        self.color2 += child.color2;
        self.opacity += child.opacity;
    }

    /// What one Gaussian in place of the samples costs: their number times the variance of their colour. A constant
    /// keeps the order sensible where colour does not vary at all.
    pub fn error(&self) -> f32 {
        let mean = self.color / self.weight;
        let variance = (self.color2 / self.weight - mean.length_squared()).max(0.0);
        self.count * (variance + 1e-6)
    }

    /// The Gaussian in place of the samples.
    pub fn gaussian(&self, center: Vec3, spread: f32) -> Merged {
        let w = 1.0 / self.weight;
        let mean = self.first * w;
        let scatter = symmetric(&self.second.map(|v| v * w)) - symmetric(&outer(mean));
        let covariance = symmetric(&self.own.map(|v| v * w)) + scatter * (spread * spread);
        Merged { position: center + mean, color: self.color * w, covariance, opacity: self.opacity * w }
    }
}

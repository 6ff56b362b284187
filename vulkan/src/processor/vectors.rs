//! Points and directions of eight Gaussians at once.

use super::gaussians::Vec4;
use super::lanes::{F8, LANES, splat};
use fearless_simd::Simd;
use fearless_simd::prelude::*;
use glam::Vec3;

/// Eight vectors of three numbers.
#[derive(Clone, Copy)]
pub(super) struct V3<S: Simd> {
    pub x: F8<S>,
    pub y: F8<S>,
    pub z: F8<S>,
}

impl<S: Simd> V3<S> {
    /// One vector in all lanes.
    #[inline(always)]
    pub fn splat(s: S, v: Vec3) -> Self {
        Self { x: splat(s, v.x), y: splat(s, v.y), z: splat(s, v.z) }
    }

    /// The first three of four numbers.
    #[inline(always)]
    pub fn of([x, y, z, _]: [F8<S>; 4]) -> Self {
        Self { x, y, z }
    }

    /// The inner product.
    #[inline(always)]
    pub fn dot(self, other: Self) -> F8<S> {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    /// The cross product.
    #[inline(always)]
    pub fn cross(self, other: Self) -> Self {
        Self {
            x: self.y * other.z - self.z * other.y,
            y: self.z * other.x - self.x * other.z,
            z: self.x * other.y - self.y * other.x,
        }
    }

    /// The sum.
    #[inline(always)]
    pub fn plus(self, other: Self) -> Self {
        Self { x: self.x + other.x, y: self.y + other.y, z: self.z + other.z }
    }

    /// The product with a number for each lane.
    #[inline(always)]
    pub fn times(self, factor: F8<S>) -> Self {
        Self { x: self.x * factor, y: self.y * factor, z: self.z * factor }
    }
}

/// Rows of eight Gaussians, number by number.
#[inline(always)]
pub(super) fn fetch<S: Simd>(s: S, row: impl Fn(usize) -> Vec4) -> [F8<S>; 4] {
    let mut columns = [[0.0; LANES]; 4];
    for lane in 0..LANES {
        let row = row(lane);
        for c in 0..4 {
            columns[c][lane] = row[c];
        }
    }
    let [a, b, c, d] = &columns;
    [F8::from_slice(s, a), F8::from_slice(s, b), F8::from_slice(s, c), F8::from_slice(s, d)]
}

/// Rows of eight Gaussians, as `columns` have their numbers.
#[inline(always)]
pub(super) fn rows<S: Simd>([a, b, c, d]: [F8<S>; 4]) -> [Vec4; LANES] {
    let mut columns = [[0.0; LANES]; 4];
    a.store_slice(&mut columns[0]);
    b.store_slice(&mut columns[1]);
    c.store_slice(&mut columns[2]);
    d.store_slice(&mut columns[3]);
    let mut rows = [[0.0; 4]; LANES];
    for (lane, row) in rows.iter_mut().enumerate() {
        *row = [columns[0][lane], columns[1][lane], columns[2][lane], columns[3][lane]];
    }
    rows
}

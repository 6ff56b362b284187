//! What one picture sees of the ground, point by point.

use glam::{DVec2, DVec3};

use models::camera::{Pinhole, Pose, View};

/// Rays that come down less than this per unit of length (75° from the vertical) meet the ground too far away, and through too
/// much else, to count.
const STEEPEST: f64 = 0.25;

/// Which part of a picture counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Seen {
    /// All of it.
    Whole,
    /// All but this share of its sides at every edge.
    Inner(f64),
    /// A disc about its middle, this share of the shorter side across: the same ground whichever way the aircraft heads.
    Disc(f64),
}

/// From a point on the ground to a camera that sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    /// Unit vector.
    pub(super) up: DVec3,
    /// What a pixel spans there, across the ray, metres.
    pub(super) gsd_m: f64,
}

/// A usable picture.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frustum {
    camera: Pinhole,
    size: DVec2,
    seen: Seen,
}

impl Frustum {
    /// `None` for a lens or a pose that is no number.
    pub(super) fn of(view: &View, seen: Seen) -> Option<Self> {
        if !view.is_usable() {
            return None;
        }
        let k = &view.intrinsics;
        let pose = Pose { rotation: view.pose.rotation.normalize(), center: view.pose.center };
        Some(Self { camera: Pinhole::new(pose, k, 1.0), size: DVec2::new(k.width.into(), k.height.into()), seen })
    }

    /// The ray from a point on the ground, when the picture sees it.
    pub(super) fn ray(&self, point: DVec3) -> Option<Ray> {
        let away = self.camera.pose.center - point;
        let range = away.length();
        if away.z < STEEPEST * range || range <= 0.0 {
            return None;
        }
        let pixel = self.camera.project(point)?;
        let in_picture = match self.seen {
            Seen::Whole => pixel.cmpge(DVec2::ZERO).all() && pixel.cmplt(self.size).all(),
            Seen::Inner(edge) => pixel.cmpge(self.size * edge).all() && pixel.cmplt(self.size * (1.0 - edge)).all(),
            Seen::Disc(share) => pixel.distance(0.5 * self.size) <= 0.5 * share * self.size.min_element(),
        };
        in_picture.then(|| Ray { up: away / range, gsd_m: range / (self.camera.f.x * self.camera.f.y).sqrt() })
    }

    /// A box, metres east and north, that holds all ground in sight between two heights; an empty one (low above high) where
    /// none can be. A picture with the horizon in it reaches as far as rays count.
    pub(super) fn bounds(&self, [lowest, highest]: [f64; 2]) -> (DVec2, DVec2) {
        let center = self.camera.pose.center;
        let over = center.z - lowest;
        if over <= 0.0 {
            return (center.truncate(), center.truncate() - DVec2::ONE);
        }
        let reach = DVec2::splat(over * (STEEPEST.powi(-2) - 1.0).sqrt());
        let (mut low, mut high) = (center.truncate(), center.truncate());
        if self.camera.pose.forward().z > -STEEPEST {
            return (low - reach, high + reach);
        }
        (low, high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for (u, v) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let ray = self.camera.world_ray([(u * self.size.x) as f32, (v * self.size.y) as f32]);
            if -ray.z < STEEPEST * ray.length() {
                let center = center.truncate();
                return (center - reach, center + reach);
            }
            for height in [lowest, highest] {
                let met = center.truncate() + ray.truncate() * ((center.z - height).max(0.0) / -ray.z);
                (low, high) = (low.min(met), high.max(met));
            }
        }
        (low, high)
    }
}

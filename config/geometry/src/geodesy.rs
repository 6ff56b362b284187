//! WGS-84 geodetic coordinates ↔ local East-North-Up, in f64 through ECEF.
//!
//! The only place where ellipsoid numbers appear. No ECEF or UTM value ever reaches an f32: everything that
//! leaves this module is either geodetic (f64 degrees) or metres around a nearby origin.

use glam::{DMat3, DVec3};

/// WGS-84 semi-major axis, metres (NIMA TR8350.2).
const A: f64 = 6_378_137.0;
/// WGS-84 flattening (NIMA TR8350.2).
const F: f64 = 1.0 / 298.257_223_563;
/// First eccentricity squared.
const E2: f64 = F * (2.0 - F);

/// A position on the WGS-84 ellipsoid.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "std", derive(serde::Serialize, serde::Deserialize))]
pub struct Geodetic {
    /// Latitude, degrees, north positive.
    pub lat_deg: f64,
    /// Longitude, degrees, east positive.
    pub lon_deg: f64,
    /// Height in metres on whatever vertical scale the source uses; only differences matter.
    pub alt_m: f64,
}

impl Geodetic {
    /// True when every field is finite and latitude and longitude are in range.
    pub fn is_valid(&self) -> bool {
        self.alt_m.is_finite() && self.lat_deg.abs() <= 90.0 && self.lon_deg.abs() <= 180.0
    }

    /// Earth-centred, earth-fixed metres.
    pub fn to_ecef(self) -> DVec3 {
        let (sin_lat, cos_lat) = libm::sincos(self.lat_deg.to_radians());
        let (sin_lon, cos_lon) = libm::sincos(self.lon_deg.to_radians());
        let n = A / libm::sqrt(1.0 - E2 * sin_lat * sin_lat);
        DVec3::new(
            (n + self.alt_m) * cos_lat * cos_lon,
            (n + self.alt_m) * cos_lat * sin_lon,
            (n * (1.0 - E2) + self.alt_m) * sin_lat,
        )
    }

    /// Inverse of [`Geodetic::to_ecef`]: fixed-point iteration on latitude (Bowring's start), below 1e-9 m
    /// for heights within ±100 km.
    pub fn from_ecef(p: DVec3) -> Self {
        let rho = libm::hypot(p.x, p.y);
        let mut lat = libm::atan2(p.z, rho * (1.0 - E2));
        let mut alt = 0.0;
        for _ in 0..6 {
            let (s, c) = libm::sincos(lat);
            let n = A / libm::sqrt(1.0 - E2 * s * s);
            // Stable at the poles, where rho / cos(lat) is not.
            alt = rho * c + p.z * s - A * A / n;
            lat = libm::atan2(p.z, rho * (1.0 - E2 * n / (n + alt)));
        }
        Self { lat_deg: lat.to_degrees(), lon_deg: libm::atan2(p.y, p.x).to_degrees(), alt_m: alt }
    }
}

/// A local East-North-Up frame, metres, around a geodetic origin.
#[derive(Clone, Copy, Debug)]
pub struct EnuFrame {
    origin: Geodetic,
    ecef: DVec3,
    /// Rows: east, north, up.
    to_enu: DMat3,
}

impl EnuFrame {
    /// The tangent frame at `origin`.
    pub fn new(origin: Geodetic) -> Self {
        let (sin_lat, cos_lat) = libm::sincos(origin.lat_deg.to_radians());
        let (sin_lon, cos_lon) = libm::sincos(origin.lon_deg.to_radians());
        let east = DVec3::new(-sin_lon, cos_lon, 0.0);
        let north = DVec3::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat);
        let up = DVec3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat);
        Self { origin, ecef: origin.to_ecef(), to_enu: DMat3::from_cols(east, north, up).transpose() }
    }

    /// The origin this frame was made from.
    pub fn origin(&self) -> Geodetic {
        self.origin
    }

    /// The rotation from axes through the middle of the Earth (ECEF) to east, north, up.
    pub fn axes(&self) -> DMat3 {
        self.to_enu
    }

    /// Geodetic → east, north, up in metres.
    pub fn to_enu(&self, p: Geodetic) -> DVec3 {
        self.to_enu * (p.to_ecef() - self.ecef)
    }

    /// East, north, up in metres → geodetic.
    pub fn to_geodetic(&self, enu: DVec3) -> Geodetic {
        Geodetic::from_ecef(self.ecef + self.to_enu.transpose() * enu)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enu_round_trip_stays_below_a_micrometre_everywhere() {
        for lat in [-90.0, -46.0, 0.0, 28.04, 89.99] {
            for lon in [-180.0, -82.7, 0.0, 179.9] {
                let frame = EnuFrame::new(Geodetic { lat_deg: lat, lon_deg: lon, alt_m: -69.7 });
                for p in [DVec3::ZERO, DVec3::new(1e4, -2e4, 300.0), DVec3::new(-3.0, 2.0, -1.0)] {
                    let back = frame.to_enu(frame.to_geodetic(p));
                    assert!((back - p).length() < 1e-6, "{lat} {lon} {p}: {back}");
                }
            }
        }
    }

    #[test]
    fn one_degree_of_latitude_has_its_known_length() {
        // Meridian arc from 45.0° to 45.001° on WGS-84: 111.1318 m (Vincenty).
        let frame = EnuFrame::new(Geodetic { lat_deg: 45.0, lon_deg: 7.0, alt_m: 0.0 });
        let p = frame.to_enu(Geodetic { lat_deg: 45.001, lon_deg: 7.0, alt_m: 0.0 });
        assert!((p.y - 111.1318).abs() < 1e-3 && p.x.abs() < 1e-9, "{p}");
    }
}

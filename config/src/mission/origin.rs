//! `origin`: where the local East-North-Up frame lies. The type is shared with the `no_std` core, hence described here.

use crate::settings::{Limits, described};
use geometry::geodesy::Geodetic;

described!(Geodetic {
    ["Latitude, north positive."] lat_deg: f64, in Limits::within(-90.0, 90.0);
    ["Longitude, east positive."] lon_deg: f64, in Limits::within(-180.0, 180.0);
    ["Height on whatever vertical scale the autopilot reports; only differences matter."] alt_m: f64;
});

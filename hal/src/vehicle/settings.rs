//! What a vehicle needs of the mission.

use std::time::SystemTime;

use config::failsafe::FailsafeSettings;
use config::link::LinkSettings;
use config::mission::{Aircraft, CameraSettings, CameraSource, Mission, MountSettings};
use geometry::geodesy::Geodetic;

use crate::error::HalError;
use crate::link::LinkAddress;

/// One aircraft's part of the mission, as the HAL needs it.
#[derive(Clone, Debug)]
pub struct VehicleSettings {
    /// Where the autopilot is.
    pub address: LinkAddress,
    /// Wait for a link that cannot be opened yet (a cable not plugged in) instead of refusing to start.
    pub patient: bool,
    /// Its MAVLink system id; 0 takes the first autopilot heard.
    pub system_id: u8,
    /// Link, signing and matching.
    pub link: LinkSettings,
    /// From when on position, camera and battery count as poor.
    pub failsafe: FailsafeSettings,
    /// Where pictures come from; `None` = poses and triggers only.
    pub camera: Option<CameraSource>,
    /// A continued flight: pictures of the folder that were written after this are taken as well, with the pose in their own
    /// data if the exposure was not heard. `None` = only pictures that come from now on.
    pub pictures_since: Option<SystemTime>,
    /// The lens.
    pub lens: CameraSettings,
    /// How the camera sits on the airframe.
    pub mount: MountSettings,
    /// Origin of the ENU frame.
    pub origin: Geodetic,
}

impl VehicleSettings {
    /// An autopilot of system 1 at `address`, with defaults in everything else: poses and triggers only, no camera.
    pub fn new(address: LinkAddress, lens: CameraSettings, origin: Geodetic) -> Self {
        Self {
            address,
            patient: false,
            system_id: 1,
            link: LinkSettings::default(),
            failsafe: FailsafeSettings::default(),
            camera: None,
            pictures_since: None,
            lens,
            mount: MountSettings::default(),
            origin,
        }
    }

    /// The settings of one aircraft of a mission.
    ///
    /// # Errors
    /// [`HalError::Address`] when its link cannot be understood.
    pub fn from_mission(mission: &Mission, aircraft: &Aircraft) -> Result<Self, HalError> {
        let address: LinkAddress = aircraft.link.parse()?;
        Ok(Self {
            // A cable that is not plugged in yet; one that this user may not open is an error.
            patient: matches!(&address, LinkAddress::Serial { path, .. } if !path.exists()),
            system_id: aircraft.system_id,
            link: mission.link.clone(),
            failsafe: mission.failsafe,
            camera: Some(aircraft.camera.clone()),
            mount: mission.mount,
            ..Self::new(address, mission.camera, mission.origin)
        })
    }
}

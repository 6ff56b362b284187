//! Every value of the mission that could make a flight fail later is refused here, before anything starts.

use super::{CameraSource, Mission, MissionError};

/// Longest id or name, so that keys on the wire stay short and bounded.
const MAX_NAME: usize = 32;
/// Most aircraft of one mission.
const MAX_AIRCRAFT: usize = 64;
/// Most corners of a region.
const MAX_CORNERS: usize = 256;
/// Largest side of a picture; beyond it a Pi-class companion cannot even decode in time.
const MAX_SIDE: u32 = 16_384;

fn invalid<T>(field: impl Into<String>, what: impl Into<String>) -> Result<T, MissionError> {
    Err(MissionError::Invalid { field: field.into(), what: what.into() })
}

fn check_name(field: &str, name: &str) -> Result<(), MissionError> {
    let fits = !name.is_empty()
        && name.len() <= MAX_NAME
        && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
    if fits { Ok(()) } else { invalid(field, format!("'{name}' must be 1 to {MAX_NAME} letters, digits, '-' or '_'")) }
}

pub(super) fn check(m: &Mission) -> Result<(), MissionError> {
    check_name("name", &m.name)?;
    if !m.origin.is_valid() {
        return invalid("origin", "lat_deg must be within ±90, lon_deg within ±180, alt_m finite");
    }
    check_camera(m)?;
    let k = &m.keyframes;
    if !(k.t_min_m >= 0.0 && k.t_min_m.is_finite() && k.r_max_deg > 0.0 && k.r_max_deg <= 180.0) {
        return invalid("keyframes", "t_min_m must be ≥ 0 and r_max_deg within 0..180");
    }
    if !(2..=4096).contains(&k.max) {
        return invalid("keyframes.max", format!("{} is not within 2..4096", k.max));
    }
    let mem = &m.memory;
    if !(16..=131_072).contains(&mem.device_mib) || !(64..=1_048_576).contains(&mem.host_mib) {
        return invalid("memory", "device_mib must be within 16..131072 and host_mib within 64..1048576");
    }
    if !(mem.image_scale > 0.0 && mem.image_scale <= 1.0) {
        return invalid("memory.image_scale", format!("{} is not within 0..1", mem.image_scale));
    }
    m.upload.validate().or_else(|e| invalid("upload", e.to_string()))?;
    m.ground.validate().or_else(|e| invalid("ground", e.to_string()))?;
    if let Err((name, why)) = m.init.check() {
        return invalid(format!("init.{name}"), why);
    }
    if let Err(e) = m.refine.check() {
        return invalid("refine", e.to_string());
    }
    if let Err(e) = m.training.check() {
        return invalid("training", e.to_string());
    }
    m.faults.check().or_else(|e| invalid("faults", e))?;
    check_aircraft(m)
}

fn check_camera(m: &Mission) -> Result<(), MissionError> {
    let c = &m.camera;
    if !(1..=MAX_SIDE).contains(&c.width) || !(1..=MAX_SIDE).contains(&c.height) {
        return invalid("camera", format!("width and height must be within 1..{MAX_SIDE} pixels"));
    }
    if !(c.fx.is_finite() && c.fy.is_finite() && c.fx > 0.0 && c.fy > 0.0) {
        return invalid("camera", "fx and fy must be positive pixels");
    }
    if !c.cx.is_finite() || !c.cy.is_finite() || !c.distortion.iter().all(|d| d.is_finite()) {
        return invalid("camera", "cx, cy and distortion must be finite");
    }
    if !c.exposure_delay_ms.is_finite() || c.exposure_delay_ms.abs() > 10_000.0 {
        return invalid("camera.exposure_delay_ms", "must be within ±10000 ms");
    }
    let mount = m.mount.rotation_deg.iter().chain(&m.mount.lever_arm_m);
    if !mount.into_iter().all(|v| v.is_finite()) {
        return invalid("mount", "rotation_deg and lever_arm_m must be finite");
    }
    if !(m.mount.max_tilt_deg > 0.0 && m.mount.max_tilt_deg <= 180.0) {
        return invalid("mount.max_tilt_deg", "must be above 0 and at most 180 degrees");
    }
    Ok(())
}

fn check_aircraft(m: &Mission) -> Result<(), MissionError> {
    if m.aircraft.is_empty() || m.aircraft.len() > MAX_AIRCRAFT {
        return invalid("aircraft", format!("give 1 to {MAX_AIRCRAFT} [[aircraft]] tables"));
    }
    for (i, a) in m.aircraft.iter().enumerate() {
        let field = format!("aircraft[{i}]");
        check_name(&format!("{field}.id"), &a.id)?;
        if m.aircraft[..i].iter().any(|b| b.id == a.id) {
            return invalid(format!("{field}.id"), format!("'{}' is used twice", a.id));
        }
        if a.system_id == 0 {
            return invalid(format!("{field}.system_id"), "0 is MAVLink's broadcast; use 1..255");
        }
        if let CameraSource::Command(c) = &a.camera
            && c.is_empty()
        {
            return invalid(format!("{field}.camera"), "command needs at least a program");
        }
        if let CameraSource::V4l2(device) = &a.camera
            && !device.is_absolute()
        {
            return invalid(format!("{field}.camera"), "v4l2 needs the device's whole path, e.g. /dev/video0");
        }
        if a.region_enu.is_empty() == a.region_wgs84.is_empty() {
            return invalid(field, "give exactly one of region_enu and region_wgs84");
        }
        let corners = m.region(a);
        if !(3..=MAX_CORNERS).contains(&corners.len()) || !corners.iter().flatten().all(|v| v.is_finite()) {
            return invalid(field, format!("a region has 3 to {MAX_CORNERS} finite corners"));
        }
        // Shoelace: a region without area owns nothing.
        let twice_area: f64 =
            corners.iter().zip(corners.iter().cycle().skip(1)).map(|(p, q)| p[0] * q[1] - q[0] * p[1]).sum();
        if twice_area.abs() < 2.0 {
            return invalid(field, "the region's area is below 1 m²; are the corners in order?");
        }
    }
    Ok(())
}

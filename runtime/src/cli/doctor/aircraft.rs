//! What a flight of this mission would complain of in its first ten seconds: the camera's folder, and who is heard on the link.

use std::io::ErrorKind::{AddrInUse, ResourceBusy};
use std::time::{Duration, Instant};

use config::mission::{Aircraft, CameraSource, Mission};
use hal::error::HalError;
use hal::link::LinkAddress;
use hal::vehicle::{Complaint, Event, Vehicle, VehicleSettings};

use super::Finding;

/// What is wrong was said by then.
const LISTENING: Duration = Duration::from_millis(9500);
/// Links that are listened to at the same time.
const LINKS: usize = 16;

/// One line on each camera's folder and each link.
pub(super) fn findings(mission: &Mission) -> Vec<(&'static str, Finding)> {
    let is_alone = mission.aircraft.len() == 1;
    let folders = mission.aircraft.iter().filter_map(|a| Some(("camera", folder(a, is_alone)?)));
    let mut all: Vec<_> = folders.collect();
    for some in mission.aircraft.chunks(LINKS) {
        let heard: Vec<Vec<Finding>> = std::thread::scope(|scope| {
            let threads: Vec<_> = some.iter().map(|a| scope.spawn(move || listen(mission, a))).collect();
            threads.into_iter().map(|t| t.join().unwrap_or_default()).collect()
        });
        all.extend(heard.into_iter().flatten().map(|finding| ("autopilot", finding)));
    }
    all
}

/// The folder that a camera's pictures come to; `None` where they come otherwise.
fn folder(aircraft: &Aircraft, is_alone: bool) -> Option<Finding> {
    let CameraSource::Folder(path) = &aircraft.camera else { return None };
    let is_there = path.is_dir();
    let (id, path) = (&aircraft.id, path.display());
    let mend = "make it, or mend camera of this aircraft in the mission file";
    Some(match is_there {
        true => Finding::Ok(format!("{id}: pictures come to {path}")),
        // Of several aircraft one computer carries one.
        false if is_alone => Finding::missing(format!("{id}: the camera's folder is missing: {path}"), mend),
        false => Finding::note(format!("{id}: the camera's folder is missing here: {path}"), mend),
    })
}

/// Listens on a link as a flight does.
fn listen(mission: &Mission, aircraft: &Aircraft) -> Vec<Finding> {
    let id = &aircraft.id;
    let mend = "mend link of this aircraft in the mission file";
    let Ok(settings) = VehicleSettings::from_mission(mission, aircraft) else { return Vec::new() };
    if matches!(settings.address, LinkAddress::File(_) | LinkAddress::Pty(_)) {
        return Vec::new();
    }
    let mut vehicle = match Vehicle::open(&VehicleSettings { camera: None, ..settings }) {
        Ok(vehicle) => vehicle,
        Err(HalError::Open { source, .. }) if matches!(source.kind(), AddrInUse | ResourceBusy) => {
            let what = format!("{id}: another program has {}", aircraft.link);
            return vec![Finding::note(what, "where that is a flight, it names what is wrong itself")];
        }
        Err(e) => return vec![Finding::missing(format!("{id}: {e}"), mend)],
    };
    let (started, mut found) = (Instant::now(), Vec::<(Complaint, String)>::new());
    while started.elapsed() < LISTENING {
        match vehicle.poll(Duration::from_millis(100)) {
            Ok(Some(Event::Complaint { what, line })) => {
                found.retain(|f| f.0 != what);
                found.extend(line.map(|line| (what, line)));
            }
            Ok(_) => {}
            Err(e) => return vec![Finding::missing(format!("{id}: {e}"), mend)],
        }
    }
    if found.is_empty() {
        return vec![match vehicle.autopilot().heartbeat_ns {
            Some(_) => Finding::Ok(format!("{id}: heard on {}", aircraft.link)),
            None => Finding::note(format!("{id}: no autopilot is heard on {}", aircraft.link), "switch it on"),
        }];
    }
    let finding = |(complaint, line): (Complaint, String)| {
        let text = format!("{id}: {line}");
        match complaint {
            // It may be switched off.
            Complaint::Closed | Complaint::Nobody => Finding::note(text, "switch the autopilot on"),
            _ => Finding::missing(text, mend),
        }
    };
    found.into_iter().map(finding).collect()
}

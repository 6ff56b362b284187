//! The ground's whole job, through a folder, without distillation (which has its own tests).

use uplink::{Offerer, Source};

use super::*;
use crate::testing::{carpet, model};

/// An aircraft without keys, every start of which is its first flight.
pub(super) fn unsigned(mission: &str, aircraft: &str) -> Source {
    let (mission, aircraft, identity) = (mission.into(), aircraft.into(), Identity::unsigned());
    Source {
        mission,
        aircraft,
        identity,
        flight_number: None,
        session: None,
        disk: Default::default(),
        territory: None,
    }
}

pub(super) const MISSION_TEXT: &str = r#"
name = "park"
origin = { lat_deg = 28.0, lon_deg = -82.0, alt_m = 0.0 }
camera = { width = 64, height = 48, fx = 50.0, fy = 50.0, cx = 32.0, cy = 24.0 }
upload = { folder = "stick", chunk_kib = 16, poll_s = 0.05 }
ground = { epochs = 0 }
[[aircraft]]
id = "west"
link = "udpin:127.0.0.1:14550"
camera = { folder = "w" }
region_enu = [[-40.0, -20.0], [0.0, -20.0], [0.0, 20.0], [-40.0, 20.0]]
[[aircraft]]
id = "east"
link = "udpin:127.0.0.1:14551"
camera = { folder = "e" }
region_enu = [[0.0, -20.0], [40.0, -20.0], [40.0, 20.0], [0.0, 20.0]]
"#;

pub(super) fn mission(dir: &Path) -> Mission {
    Mission::parse(MISSION_TEXT, dir).expect("mission")
}

fn fly(mission: &Mission, dir: &Path, id: &str) {
    let path = dir.join(format!("{id}.dgtr"));
    let local = model(id, &[], carpet([-40.0, -20.0], [40.0, 20.0], 1.0));
    models::formats::model::write(&path, &local.header, &local.cloud).expect("write");
    let offerer = Offerer::start(&mission.upload, unsigned(&mission.name, id)).expect("offerer");
    offerer.offer_final(&path);
    assert!(offerer.wait_delivered(Duration::from_secs(30), || false));
    offerer.shutdown();
}

#[test]
fn all_aircraft_arrive_and_each_keeps_its_own_region() {
    let dir = tempfile::tempdir().expect("temp dir");
    let (mission, out) = (mission(dir.path()), dir.path().join("out"));
    fly(&mission, dir.path(), "west");
    fly(&mission, dir.path(), "east");
    let mut told = 0;
    let stop = AtomicBool::new(false);
    let mut board = Board::new(&mission, &out);
    let mut tell = |p: &Progress| {
        told = p.finished;
        board.round(p);
    };
    let reception = receive(&mission, &out, None, &stop, &mut tell).expect("received");
    assert!(told == 2 && reception.missing.is_empty());
    let page = board.watch().freeze();
    for (craft, id) in page.aircraft.iter().zip(["west", "east"]) {
        assert_eq!((craft.name.as_str(), craft.state, craft.gaussians), (id, "final model is here", Some(3200)));
        assert!(craft.bytes > Some(0) && craft.chunks.is_none(), "{craft:?}");
    }
    assert_eq!(page.subtitle, "2 of 2 final models are here");
    let (outcome, unreadable) = merge(&mission, &reception, &out, &|| false).expect("merged");
    assert!(unreadable.is_empty() && outcome.path == out.join("global.dgtr"));
    // The models themselves name no region: the mission's were used.
    assert_eq!((outcome.gaussians, outcome.kept[0].own, outcome.kept[1].own), (3200, 1600, 1600));
    assert_eq!(outcome.header.origin, Some(mission.origin));
}

#[test]
fn after_a_timeout_what_has_arrived_is_merged_and_the_rest_is_named() {
    let dir = tempfile::tempdir().expect("temp dir");
    let (mission, out) = (mission(dir.path()), dir.path().join("out"));
    let stop = AtomicBool::new(false);
    let none = receive(&mission, &out, Some(Duration::ZERO), &stop, &mut |_| {}).expect("received");
    assert!(matches!(merge(&mission, &none, &out, &|| false), Err(ServeError::Nothing(_))));
    fly(&mission, dir.path(), "east");
    let one = receive(&mission, &out, Some(Duration::from_secs(1)), &stop, &mut |_| {}).expect("received");
    assert_eq!(one.missing, ["west"]);
    // East saw the western half too, and nobody else did.
    assert_eq!(merge(&mission, &one, &out, &|| false).expect("merged").0.gaussians, 3200);
    // Started again, it continues where it was.
    fly(&mission, dir.path(), "west");
    let both = receive(&mission, &out, None, &stop, &mut |_| {}).expect("received");
    assert!(both.missing.is_empty() && both.counters.models == 1);
}

#[test]
fn a_received_file_that_is_no_model_does_not_cost_the_others() {
    let dir = tempfile::tempdir().expect("temp dir");
    let (mission, out) = (mission(dir.path()), dir.path().join("out"));
    fly(&mission, dir.path(), "west");
    let path = dir.path().join("junk.dgtr");
    std::fs::write(&path, b"not a model").expect("write");
    let offerer = Offerer::start(&mission.upload, unsigned(&mission.name, "east")).expect("offerer");
    offerer.offer_final(&path);
    assert!(offerer.wait_delivered(Duration::from_secs(30), || false));
    let reception = receive(&mission, &out, None, &AtomicBool::new(false), &mut |_| {}).expect("received");
    assert_eq!((reception.missing.as_slice(), reception.counters.models_damaged), (&["east".to_owned()][..], 1));
    assert!(reception.refusals.iter().any(|(why, n)| why.contains("east's model") && n == 1));
    let (outcome, left_out) = merge(&mission, &reception, &out, &|| false).expect("merged");
    assert_eq!((outcome.models.len(), left_out.len()), (1, 0));
    // Damaged on the ground afterwards: left out, and the other one is merged all the same.
    fly(&mission, dir.path(), "east");
    let reception = receive(&mission, &out, None, &AtomicBool::new(false), &mut |_| {}).expect("received");
    std::fs::write(&reception.received[1].path, b"not a model").expect("write");
    let (outcome, left_out) = merge(&mission, &reception, &out, &|| false).expect("merged");
    assert_eq!((outcome.models.len(), left_out.len()), (1, 1));
}

//! Every fault of the simulator, one at a time, and what the real [`crate::vehicle::Vehicle`] says about it.

use std::fmt::Write as _;
use std::sync::atomic::AtomicBool;

use config::faults::FaultSettings;
use config::link::{LinkSettings, Signing};

use super::listener::{Companion, accompany};
use super::tests::quick;
use super::{SessionReport, run};
use crate::link::LinkAddress;

type Verdict = fn(&SessionReport, &Companion) -> bool;

/// One row: what is set, what happened by the simulator's account, and what the companion must have noticed.
struct Row {
    fault: &'static str,
    settings: &'static [(&'static str, f32)],
    happened: Verdict,
    reported: Verdict,
    /// Fewest of the ten pictures that still become posed frames.
    frames: usize,
}

const KEY: [u8; 32] = [7; 32];

const ROWS: &[Row] = &[
    Row {
        fault: "none",
        settings: &[],
        happened: |_, _| true,
        reported: |_, c| c.counters.damaged == 0 && c.counters.lost == 0,
        frames: 10,
    },
    Row {
        fault: "bytes lost",
        settings: &[("SIM_UART_LOSS", 0.3)],
        happened: |r, _| r.line.bytes_lost > 50,
        reported: |_, c| c.counters.damaged > 20 && c.counters.lost > 20,
        frames: 6,
    },
    Row {
        fault: "bits flipped",
        settings: &[("SIM_UART_FLIP", 0.3)],
        happened: |r, _| r.line.bytes_flipped > 50,
        reported: |_, c| c.counters.damaged > 20 && c.counters.lost > 20,
        frames: 6,
    },
    Row {
        fault: "frames lost",
        settings: &[("SIM_FRAME_LOSS", 20.0)],
        happened: |r, _| r.line.frames_lost > 100,
        reported: |_, c| c.counters.lost > 100 && c.counters.damaged == 0,
        frames: 4,
    },
    Row {
        fault: "line silent",
        settings: &[("SIM_LINK_PAUSE", 1.0), ("SIM_FLT_START", 8.0), ("SIM_FLT_LENGTH", 16.0)],
        happened: |r, _| r.line.frames_paused > 300,
        reported: |_, c| c.links_lost > 0 && c.links_back > 0,
        frames: 1,
    },
    Row {
        fault: "GPS lost",
        settings: &[("SIM_GPS1_ENABLE", 0.0), ("SIM_FLT_START", 6.0)],
        happened: |_, _| true,
        reported: |_, c| c.frames.last().is_some_and(|f| f.pose.position_sigma_m[0] > 10.0),
        frames: 10,
    },
    Row {
        fault: "GPS glitch",
        settings: &[("SIM_GPS1_GLTCH_X", 0.001), ("SIM_FLT_START", 10.0), ("SIM_FLT_LENGTH", 5.0)],
        happened: |_, _| true,
        reported: |_, c| c.counters.position_steps > 0,
        frames: 7,
    },
    Row {
        fault: "attitude spikes",
        settings: &[("SIM_ATT_SPK_PCT", 4.0), ("SIM_ATT_SPK_DEG", 60.0)],
        happened: |_, _| true,
        reported: |_, c| c.counters.spikes > 5,
        frames: 10,
    },
    Row {
        fault: "NaN fields",
        settings: &[("SIM_NAN_PCT", 10.0)],
        happened: |_, _| true,
        reported: |_, c| c.counters.impossible > 50,
        frames: 10,
    },
    Row {
        fault: "boot clock jumps",
        settings: &[("SIM_CLK_JUMP", 500.0), ("SIM_FLT_START", 12.0)],
        happened: |_, _| true,
        reported: |_, c| c.counters.clock_restarts + c.counters.clock_steps > 0,
        // What follows is within two wall-clock seconds: the companion is still learning the new clock.
        frames: 3,
    },
    Row {
        fault: "Unix time lost",
        settings: &[("SIM_UNIX_LOST", 1.0)],
        happened: |_, _| true,
        reported: |_, c| c.counters.triggers == 10,
        frames: 8,
    },
    Row {
        fault: "feedback in boot time",
        settings: &[("SIM_CAM_BOOTTIME", 1.0), ("SIM_FLT_START", 12.0)],
        happened: |_, _| true,
        reported: |_, c| c.counters.triggers == 10 && c.counters.triggers_unmatched == 0,
        frames: 10,
    },
    Row {
        fault: "announcements lost",
        settings: &[("SIM_CAM_TRG_LOSS", 60.0)],
        happened: |r, _| r.triggers_lost > 0,
        reported: |_, c| c.counters.trigger_gaps > 0 && c.counters.pictures_unmatched > 0,
        frames: 3,
    },
    Row {
        fault: "pictures lost",
        settings: &[("SIM_PIC_LOSS", 40.0)],
        happened: |r, _| r.pictures.lost > 0,
        reported: |r, c| c.counters.triggers_unmatched == r.pictures.lost,
        frames: 3,
    },
    Row {
        fault: "pictures twice",
        settings: &[("SIM_PIC_TWICE", 40.0)],
        happened: |r, _| r.pictures.twice > 0,
        reported: |r, c| c.counters.picture_duplicates + c.counters.pictures_unmatched == r.pictures.twice,
        frames: 10,
    },
    Row {
        fault: "pictures late",
        settings: &[("SIM_PIC_LATE", 40.0), ("SIM_PIC_LATE_S", 6.0)],
        happened: |r, _| r.pictures.late > 0,
        reported: |_, c| c.counters.pictures_late > 0,
        frames: 8,
    },
    Row {
        fault: "black pictures",
        settings: &[("SIM_PIC_BLACK", 40.0)],
        happened: |r, _| r.pictures.spoiled > 0,
        reported: |_, c| c.counters.pictures == 10,
        frames: 10,
    },
    Row {
        fault: "overexposed pictures",
        settings: &[("SIM_PIC_OVER", 40.0)],
        happened: |r, _| r.pictures.spoiled > 0,
        reported: |_, c| c.counters.pictures == 10,
        frames: 10,
    },
    Row {
        fault: "pictures cut off",
        settings: &[("SIM_PIC_CUT", 40.0)],
        happened: |r, _| r.pictures.cut > 0,
        // The camera waits for the rest of such a file for longer than this flight lasts; its exposure stays alone.
        reported: |r, c| c.counters.triggers_unmatched == r.pictures.cut,
        frames: 3,
    },
    Row {
        fault: "signed with another key",
        settings: &[("SIM_SIGN_BAD", 1.0), ("SIM_FLT_START", 12.0)],
        happened: |_, _| true,
        reported: |_, c| c.counters.wrong_key > 100 && c.links_lost > 0,
        frames: 2,
    },
];

fn fly(row: &Row) -> (SessionReport, Companion) {
    let folder = tempfile::tempdir().expect("folder");
    let key_file = folder.path().join("key");
    std::fs::write(&key_file, KEY).expect("key");
    let pictures = folder.path().join("pictures");
    std::fs::create_dir(&pictures).expect("folder");
    let mut settings = quick();
    (settings.session.speed, settings.session.settle_s, settings.session.linger_s) = (8.0, 3.0, 2.5);
    let mut faults = FaultSettings::default();
    for (name, value) in row.settings {
        faults.set(name, *value).expect(name);
    }
    settings.autopilot.faults = faults;
    let signed = row.settings.iter().any(|(name, _)| *name == "SIM_SIGN_BAD");
    settings.autopilot.signing_key = signed.then_some(KEY);
    let link = LinkSettings {
        heartbeat_timeout_s: 1.0,
        patience_s: 1.5,
        exif_pose: false,
        signing: if signed { Signing::Require } else { Signing::Off },
        signing_key: signed.then_some(key_file),
        ..LinkSettings::default()
    };
    let never = AtomicBool::new(false);
    accompany(settings.origin, &pictures, link, |ready| {
        run(&settings, &LinkAddress::Pty(None), &pictures, None, &never, ready).expect("a flight")
    })
}

/// The fields of a counter struct's debug text that are not 0.
fn nonzero(counters: &str) -> String {
    let inner = counters.split_once('{').map_or("", |c| c.1).trim_end_matches('}');
    inner.split(',').map(str::trim).filter(|f| !f.ends_with(": 0")).collect::<Vec<_>>().join(", ")
}

#[test]
fn every_fault_is_survived_and_noticed() {
    let mut table = String::from("fault | simulator | companion | frames\n");
    let mut wrong = Vec::new();
    for batch in ROWS.chunks(5) {
        let results: Vec<_> = std::thread::scope(|scope| {
            let flights: Vec<_> = batch.iter().map(|row| scope.spawn(move || fly(row))).collect();
            flights.into_iter().map(|f| f.join().expect("no panic")).collect()
        });
        for (row, (report, companion)) in batch.iter().zip(&results) {
            let _ = writeln!(
                table,
                "{} | {} {} | {} lost {} back {} | {} of 10",
                row.fault,
                nonzero(&format!("{:?}", report.line)),
                nonzero(&format!("{:?}", report.pictures)),
                nonzero(&format!("{:?}", companion.counters)),
                companion.links_lost,
                companion.links_back,
                companion.frames.len()
            );
            if !report.completed || !(row.happened)(report, companion) {
                wrong.push(format!("{}: did not happen", row.fault));
            }
            if !(row.reported)(report, companion) {
                wrong.push(format!("{}: not reported", row.fault));
            }
            if companion.frames.len() < row.frames {
                wrong.push(format!("{}: {} frames, {:?}", row.fault, companion.frames.len(), companion.unmatched));
            }
        }
    }
    println!("{table}");
    assert!(wrong.is_empty(), "{wrong:#?}\n{table}");
}

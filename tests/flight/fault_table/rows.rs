//! The rows of the fault table: one fault each, what it must leave in the counters, and what the mission must end with.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use config::link::Signing;
use disk::bounded::Bounded;
use disk::{Disk, Operations, Output, System};
use hal::camera::Picture;
use hal::counters::HalCounters;
use hal::failsafe::Action;
use models::camera::{Pose, PoseSigma, PosedImage, View};
use sim::SessionReport;
use sim::autopilot::Announcing;

use super::super::rehearsal::{Script, intrinsics};
use crate::keyframe_store::{KeyFrame, KeyframeStore};

pub(super) const KEY: [u8; 32] = [7; 32];
/// Exposures of the flight: two lines of five.
const EXPOSURES: u64 = 10;

/// One row: what is set, what must have happened and been noticed, and what must remain.
pub(super) struct Row {
    pub(super) fault: &'static str,
    pub(super) settings: &'static [(&'static str, f32)],
    /// What else is unlike the usual flight.
    pub(super) also: fn(&mut Script),
    pub(super) noticed: fn(&HalCounters, &SessionReport) -> bool,
    /// What must remain.
    pub(super) end: End,
    /// The highest rung of the failsafe ladder.
    pub(super) rung: Action,
}

/// What a mission ends with.
pub(super) enum End {
    /// A finished model of at least and at most so many views.
    Model(usize, usize),
    /// A valid checkpoint of at least and at most so many views.
    Checkpoint(usize, usize),
    /// Nothing to build from, and this named as the cause.
    Nothing(&'static str),
}

const USUAL: Row = Row {
    fault: "none",
    settings: &[],
    also: |_| {},
    noticed: |c, _| {
        c.link.damaged
            + c.link.lost
            + c.link.link_losses
            + c.pictures.pictures_unmatched
            + c.exposures.triggers_unmatched
            == 0
    },
    end: End::Model(10, 10),
    rung: Action::Nominal,
};

fn px4(announcing: Announcing, script: &mut Script) {
    script.sim.autopilot.announcing = announcing;
}

pub(super) const ROWS: &[Row] = &[
    USUAL,
    Row {
        fault: "bytes lost",
        settings: &[("SIM_UART_LOSS", 0.3)],
        noticed: |c, r| r.line.bytes_lost > 100 && c.link.damaged > 50 && c.link.lost > 50,
        end: End::Model(7, 10),
        ..USUAL
    },
    Row {
        fault: "bits flipped",
        settings: &[("SIM_UART_FLIP", 0.3)],
        noticed: |c, r| r.line.bytes_flipped > 100 && c.link.damaged > 50 && c.link.lost > 50,
        end: End::Model(7, 10),
        ..USUAL
    },
    Row {
        fault: "frames lost",
        settings: &[("SIM_FRAME_LOSS", 20.0)],
        noticed: |c, r| r.line.frames_lost > 200 && c.link.lost > 200 && c.link.damaged == 0,
        end: End::Model(7, 10),
        ..USUAL
    },
    Row {
        fault: "line silent for 12 s",
        settings: &[("SIM_LINK_PAUSE", 1.0), ("SIM_FLT_START", 12.0), ("SIM_FLT_LENGTH", 12.0)],
        noticed: |c, r| r.line.frames_paused > 300 && c.link.link_losses == 1 && c.pictures.pictures_unmatched > 0,
        end: End::Model(4, 8),
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "line silent for good",
        settings: &[("SIM_LINK_PAUSE", 1.0), ("SIM_FLT_START", 16.0)],
        also: |script| script.end.silence = Duration::from_secs(150),
        noticed: |c, _| c.link.link_losses == 1,
        end: End::Model(3, 6),
        rung: Action::Hold,
    },
    Row {
        fault: "GPS lost",
        settings: &[("SIM_GPS1_ENABLE", 0.0), ("SIM_FLT_START", 8.0)],
        noticed: |c, _| c.posed_frames == EXPOSURES,
        end: End::Model(8, 10),
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "GPS glitch of 111 m for 5 s",
        settings: &[("SIM_GPS1_GLTCH_X", 0.001), ("SIM_FLT_START", 12.0), ("SIM_FLT_LENGTH", 5.0)],
        noticed: |c, _| c.telemetry.position_steps > 0 && c.telemetry.spikes > 0,
        end: End::Model(8, 10),
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "attitude spikes of 60°",
        settings: &[("SIM_ATT_SPK_PCT", 4.0), ("SIM_ATT_SPK_DEG", 60.0)],
        noticed: |c, _| c.telemetry.spikes > 20,
        ..USUAL
    },
    Row {
        fault: "NaN in attitudes",
        settings: &[("SIM_NAN_PCT", 10.0)],
        noticed: |c, _| c.telemetry.impossible > 100,
        ..USUAL
    },
    Row {
        fault: "boot clock jumps by 500 s",
        settings: &[("SIM_CLK_JUMP", 500.0), ("SIM_FLT_START", 15.0)],
        // A jump costs one exposure at most, the one whose pose was still being sought: the clock's rate outlives it, and
        // TIMESYNC is asked as often again as at the start.
        noticed: |c, _| c.telemetry.clock_restarts == 1,
        end: End::Model(9, 10),
        ..USUAL
    },
    Row {
        fault: "boot clock starts again (reboot)",
        settings: &[("SIM_CLK_JUMP", -40.0), ("SIM_FLT_START", 15.0)],
        noticed: |c, _| c.telemetry.clock_restarts == 1,
        end: End::Model(9, 10),
        ..USUAL
    },
    Row {
        fault: "no Unix time",
        settings: &[("SIM_UNIX_LOST", 1.0)],
        noticed: |c, _| c.exposures.trigger_times_mended == EXPOSURES,
        ..USUAL
    },
    Row {
        fault: "exposures suddenly in boot time",
        settings: &[("SIM_CAM_BOOTTIME", 1.0), ("SIM_FLT_START", 15.0)],
        noticed: |c, _| c.exposures.triggers == EXPOSURES && c.exposures.trigger_times_mended == 0,
        ..USUAL
    },
    Row {
        fault: "announcements lost",
        settings: &[("SIM_CAM_TRG_LOSS", 60.0)],
        noticed: |c, r| {
            r.triggers_lost > 0 && c.exposures.trigger_gaps > 0 && c.pictures.pictures_unmatched == r.triggers_lost
        },
        end: End::Model(3, 9),
        ..USUAL
    },
    Row {
        fault: "pictures lost",
        settings: &[("SIM_PIC_LOSS", 40.0)],
        noticed: |c, r| r.pictures.lost > 0 && c.exposures.triggers_unmatched == r.pictures.lost,
        end: End::Model(4, 9),
        ..USUAL
    },
    Row {
        fault: "pictures twice",
        settings: &[("SIM_PIC_TWICE", 40.0)],
        noticed: |c, r| {
            r.pictures.twice > 0 && c.pictures.picture_duplicates + c.pictures.pictures_unmatched == r.pictures.twice
        },
        ..USUAL
    },
    Row {
        fault: "pictures 6 s late",
        settings: &[("SIM_PIC_LATE", 40.0), ("SIM_PIC_LATE_S", 6.0)],
        noticed: |c, r| r.pictures.late > 0 && c.pictures.pictures_late > 0,
        end: End::Model(8, 10),
        ..USUAL
    },
    Row {
        fault: "every picture 40 s late",
        settings: &[("SIM_PIC_LATE", 100.0), ("SIM_PIC_LATE_S", 40.0)],
        noticed: |c, r| {
            r.pictures.late == EXPOSURES && c.pictures.pictures_reconciled == EXPOSURES && c.posed_frames == EXPOSURES
        },
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "every picture 80 s late, line silent from the last exposure on",
        settings: &[("SIM_LINK_PAUSE", 1.0), ("SIM_FLT_START", 40.0)],
        also: |script| script.sim.imperfections.transfer_ms = 80_000.0,
        noticed: |c, _| {
            c.link.link_losses == 1 && c.pictures.pictures_reconciled == EXPOSURES && c.posed_frames == EXPOSURES
        },
        rung: Action::Hold,
        ..USUAL
    },
    Row {
        fault: "somebody says disarmed, twice a second",
        settings: &[("SIM_FORGE_DISARM", 1.0), ("SIM_FLT_START", 12.0)],
        noticed: |c, r| r.completed && c.posed_frames == EXPOSURES,
        ..USUAL
    },
    Row {
        fault: "never disarmed, silent after the flight",
        settings: &[],
        also: |script| script.sim.autopilot.stays_armed = true,
        noticed: |c, _| c.posed_frames == EXPOSURES && c.link.link_losses == 1,
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "black pictures",
        settings: &[("SIM_PIC_BLACK", 40.0)],
        noticed: |c, r| r.pictures.spoiled > 0 && c.pictures.pictures_black == r.pictures.spoiled,
        end: End::Model(4, 9),
        ..USUAL
    },
    Row {
        fault: "overexposed pictures",
        settings: &[("SIM_PIC_OVER", 100.0), ("SIM_FLT_START", 15.0)],
        noticed: |c, r| r.pictures.spoiled > 0 && c.pictures.pictures_overexposed == r.pictures.spoiled,
        end: End::Model(4, 9),
        rung: Action::Warn,
        ..USUAL
    },
    Row {
        fault: "pictures cut off",
        settings: &[("SIM_PIC_CUT", 40.0)],
        noticed: |c, r| {
            r.pictures.cut > 0
                && c.pictures.pictures_broken == r.pictures.cut
                && c.exposures.triggers_unmatched == r.pictures.cut
        },
        end: End::Model(4, 9),
        ..USUAL
    },
    Row {
        fault: "signed with another key from 16 s on",
        settings: &[("SIM_SIGN_BAD", 1.0), ("SIM_FLT_START", 16.0)],
        also: signed,
        noticed: |c, _| c.link.wrong_key > 500 && c.link.link_losses == 1,
        end: End::Model(3, 6),
        rung: Action::Warn,
    },
    Row {
        fault: "signed with another key from the start",
        settings: &[("SIM_SIGN_BAD", 1.0)],
        also: signed,
        noticed: |c, _| {
            c.link.wrong_key > 500 && c.exposures.triggers == 0 && c.pictures.pictures_unmatched == EXPOSURES
        },
        end: End::Nothing("signing refused"),
        rung: Action::Nominal,
    },
    Row {
        fault: "PX4: CAMERA_TRIGGER and two commands",
        also: |script| px4(Announcing::Trigger, script),
        noticed: |c, _| {
            c.exposures.triggers == EXPOSURES
                && c.exposures.trigger_duplicates >= EXPOSURES
                && c.posed_frames == EXPOSURES
        },
        ..USUAL
    },
    Row {
        fault: "PX4: and CAMERA_IMAGE_CAPTURED",
        also: |script| px4(Announcing::TriggerAndCaptured, script),
        noticed: |c, _| {
            c.exposures.triggers == EXPOSURES
                && c.exposures.trigger_duplicates >= 2 * EXPOSURES
                && c.posed_frames == EXPOSURES
        },
        ..USUAL
    },
    Row {
        fault: "CAMERA_IMAGE_CAPTURED alone",
        also: |script| px4(Announcing::Captured, script),
        noticed: |c, _| {
            c.exposures.triggers == EXPOSURES && c.exposures.trigger_duplicates == 0 && c.posed_frames == EXPOSURES
        },
        ..USUAL
    },
    Row {
        fault: "camera 30° off the planned pitch, 20° allowed",
        also: |script| {
            script.sim.survey.gimbal_pitch_deg = -60.0;
            (script.vehicle.mount.rotation_deg, script.vehicle.mount.max_tilt_deg) = ([0.0, -90.0, 0.0], 20.0);
        },
        noticed: |c, r| r.triggers > 0 && c.exposures.exposures_tilted == r.triggers && c.posed_frames == 0,
        end: End::Nothing("pictures were taken tilted"),
        ..USUAL
    },
    Row {
        fault: "disk full after 9 kB",
        also: |script| script.disk = |out| Disk::new(Bounded::new(System, out, Arc::new(AtomicU64::new(9_000)))),
        noticed: |c, _| c.posed_frames == EXPOSURES,
        // Key frames that are not kept are trained on all the same; the last checkpoint waits for room.
        end: End::Checkpoint(3, 10),
        ..USUAL
    },
    Row {
        fault: "disk read-only from the 13th file on",
        also: |script| script.disk = |_| Disk::new(ReadOnlyAfter(AtomicU32::new(12))),
        noticed: |c, _| c.posed_frames == EXPOSURES,
        end: End::Checkpoint(3, 9),
        ..USUAL
    },
    Row {
        fault: "model and list of key frames damaged before the start",
        also: |script| {
            script.before = |out| {
                std::fs::create_dir_all(out.join("keyframes")).expect("folder");
                std::fs::write(out.join("model.dgtr"), b"dgtr\r\n\x1a\n, cut").expect("damaged");
                std::fs::write(out.join("keyframes/transforms.json"), b"{ \"camera_model\":").expect("damaged");
            };
        },
        ..USUAL
    },
    Row {
        fault: "power cut in an earlier start, while its third key frame was stored",
        also: |script| script.before = power_cut,
        // Two of the earlier start, and all of this one.
        end: End::Model(12, 12),
        ..USUAL
    },
    Row {
        fault: "Ctrl-C at 25 s, while it trains",
        also: |script| script.interrupt_at = Some(Duration::from_secs(25)),
        noticed: |c, r| !r.completed && c.posed_frames > 0 && c.posed_frames < EXPOSURES,
        end: End::Checkpoint(3, 9),
        ..USUAL
    },
];

/// The picture is there, its list is torn, the one before it is whole; two files have only their temporary names.
fn power_cut(out: &Path) {
    let camera = super::usual().vehicle.lens;
    let (lens, folder) = (intrinsics(&camera), out.join("keyframes"));
    let mut store = KeyframeStore::open(&Disk::default(), &folder, &camera, &lens, super::ORIGIN).expect("opened");
    for i in 0..3 {
        let center = glam::DVec3::new(500.0 + 10.0 * f64::from(i), 0.0, 40.0);
        let posed = PosedImage {
            name: format!("earlier_{i}.png"),
            time_ns: 1,
            image: image::RgbImage::from_pixel(lens.width, lens.height, image::Rgb([90; 3])),
            view: View { intrinsics: lens, pose: Pose { rotation: glam::DQuat::IDENTITY, center } },
            mask: None,
            sigma: PoseSigma { position_m: [1.0; 3], rotation_rad: [0.1; 3] },
        };
        let file = Picture::Rgb(posed.image.clone());
        store.add(&KeyFrame { posed, file }).expect("stored");
    }
    let list = folder.join("transforms.json");
    let bytes = std::fs::read(&list).expect("there");
    std::fs::write(&list, [&bytes[..bytes.len() / 2], &vec![0; bytes.len() / 2]].concat()).expect("torn");
    std::fs::write(out.join(".dgtr-1-0"), b"half a mod").expect("left");
    std::fs::write(folder.join("images/.dgtr-1-1"), b"half a pic").expect("left");
}

fn signed(script: &mut Script) {
    script.sim.autopilot.signing_key = Some(KEY);
    script.vehicle.link.signing = Signing::Require;
}

/// A file system that becomes read-only, as ext4 does after an error, once so many files were made.
#[derive(Debug)]
struct ReadOnlyAfter(AtomicU32);

impl ReadOnlyAfter {
    fn checked<T>(&self, made: u32, act: impl FnOnce() -> io::Result<T>) -> io::Result<T> {
        let left = self.0.load(Ordering::Relaxed);
        self.0.store(left.saturating_sub(made), Ordering::Relaxed);
        if left == 0 { Err(io::ErrorKind::ReadOnlyFilesystem.into()) } else { act() }
    }
}

impl Operations for ReadOnlyAfter {
    fn make_folder(&self, path: &Path) -> io::Result<()> {
        self.checked(0, || System.make_folder(path))
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn Output>> {
        self.checked(1, || System.create(path))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn Output>> {
        self.checked(0, || System.append(path))
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.checked(0, || System.link(from, to))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.checked(0, || System.rename(from, to))
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        self.checked(0, || System.remove(path))
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        System.sync_folder(path)
    }
}

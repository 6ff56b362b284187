//! A vehicle whose camera is ours, with an autopilot beside it that hands everything on to a client in a program of its own.

use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use config::mission::{CameraSource, MountAttitude, MountSettings};
use geometry::geodesy::Geodetic;
use hal::link::LinkAddress;
use hal::mavlink::dialect::{
    ATTITUDE_DATA, GLOBAL_POSITION_INT_DATA, HEARTBEAT_DATA, MavAutopilot, MavState, MavType, SYSTEM_TIME_DATA,
};
use hal::mavlink::{Encoder, MessageData};
use hal::vehicle::{Event, Vehicle, VehicleSettings};

mod lens;

use lens::LENS;

const ORIGIN: Geodetic = Geodetic { lat_deg: 46.84265, lon_deg: -91.9939, alt_m: 158.6 };

/// An autopilot at 10 Hz that hands everything on between the vehicle's port and the client's, as routers on board do.
struct Router {
    vehicle: UdpSocket,
    client: UdpSocket,
}

impl Router {
    fn run(&self, over: &AtomicBool) {
        let (mut vehicle_at, mut client_at) = (None::<SocketAddr>, None::<SocketAddr>);
        let mut encoder = Encoder::new(1, 1);
        let (started, mut next) = (Instant::now(), Instant::now());
        let mut bytes = [0; 2048];
        while !over.load(Ordering::Relaxed) {
            while let Ok((n, from)) = self.vehicle.recv_from(&mut bytes) {
                vehicle_at = Some(from);
                client_at.map(|at| self.client.send_to(&bytes[..n], at));
            }
            while let Ok((n, from)) = self.client.recv_from(&mut bytes) {
                client_at = Some(from);
                vehicle_at.map(|at| self.vehicle.send_to(&bytes[..n], at));
            }
            if Instant::now() >= next {
                next += Duration::from_millis(100);
                let boot_ms = 60_000 + started.elapsed().as_millis() as u32;
                let tell = |frame: &[u8]| {
                    client_at.map(|at| self.client.send_to(frame, at));
                    vehicle_at.map(|at| self.vehicle.send_to(frame, at));
                };
                tell(encoded(
                    &mut encoder,
                    &HEARTBEAT_DATA {
                        mavtype: MavType::MAV_TYPE_QUADROTOR,
                        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
                        system_status: MavState::MAV_STATE_STANDBY,
                        mavlink_version: 3,
                        ..HEARTBEAT_DATA::default()
                    },
                ));
                tell(encoded(
                    &mut encoder,
                    &SYSTEM_TIME_DATA {
                        time_unix_usec: 1_780_000_000_000_000 + u64::from(boot_ms) * 1000,
                        time_boot_ms: boot_ms,
                    },
                ));
                tell(encoded(&mut encoder, &ATTITUDE_DATA { time_boot_ms: boot_ms, ..ATTITUDE_DATA::default() }));
                tell(encoded(
                    &mut encoder,
                    &GLOBAL_POSITION_INT_DATA {
                        time_boot_ms: boot_ms,
                        lat: (ORIGIN.lat_deg * 1e7) as i32,
                        lon: (ORIGIN.lon_deg * 1e7) as i32,
                        alt: (ORIGIN.alt_m * 1e3) as i32 + 40_000,
                        relative_alt: 40_000,
                        ..GLOBAL_POSITION_INT_DATA::default()
                    },
                ));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

fn encoded<'e, D: MessageData>(encoder: &'e mut Encoder, message: &D) -> &'e [u8] {
    encoder.encode(message, None)
}

fn socket() -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a port");
    socket.set_nonblocking(true).expect("a socket");
    socket
}

/// What a client of the camera came to.
pub struct Ended {
    /// Its report: the last line that it wrote as JSON.
    pub report: serde_json::Value,
    /// Values of the settings that it set.
    pub asked: Vec<f32>,
    /// Pictures that were posed meanwhile.
    pub posed: usize,
}

/// Runs `script` with a port as its argument until it ends; a picture comes for each exposure.
pub fn with_client(python: PathBuf, script: &str) -> Ended {
    let folder = tempfile::tempdir().expect("a folder");
    let router = Router { vehicle: socket(), client: socket() };
    let settings = VehicleSettings {
        camera: Some(CameraSource::Folder(folder.path().into())),
        mount: MountSettings {
            attitude: MountAttitude::Fixed,
            rotation_deg: [0.0, -90.0, 0.0],
            ..MountSettings::default()
        },
        ..VehicleSettings::new(
            LinkAddress::UdpOut(router.vehicle.local_addr().expect("an address").to_string()),
            LENS,
            ORIGIN,
        )
    };
    let mut vehicle = Vehicle::open(&settings).expect("a link");
    let mut picture = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(32, 24).write_to(&mut picture, image::ImageFormat::Jpeg).expect("encoded");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(script);
    let over = AtomicBool::new(false);
    let (output, asked, posed) = std::thread::scope(|scope| {
        scope.spawn(|| router.run(&over));
        let mut client = Command::new(python)
            .arg(script)
            .arg(router.client.local_addr().expect("an address").port().to_string())
            .stdout(Stdio::piped())
            .spawn()
            .expect("python starts");
        let (mut taken, mut asked, mut posed, mut events) = (0, Vec::new(), 0, Vec::new());
        while client.try_wait().expect("a child").is_none() {
            match vehicle.poll(Duration::from_millis(50)).expect("a link") {
                Some(Event::Trigger(_)) => {
                    taken += 1;
                    std::fs::write(folder.path().join(format!("IMG_{taken:04}.jpg")), picture.get_ref())
                        .expect("written");
                }
                Some(Event::Asked { parameter, value }) => {
                    asked.push(value);
                    vehicle.answer(parameter, Some(value));
                }
                Some(Event::Posed(_)) => posed += 1,
                Some(Event::Pose(_)) | None => {}
                Some(other) => events.push(format!("{other:?}")),
            }
        }
        over.store(true, Ordering::Relaxed);
        println!("{taken} taken, {posed} posed, {events:?}, {:?}", vehicle.counters());
        (client.wait_with_output().expect("its output"), asked, posed)
    });
    let said = String::from_utf8_lossy(&output.stdout);
    // The client writes its own log there, too.
    let report = said.lines().rev().find(|line| line.starts_with('{')).unwrap_or_else(|| panic!("{said}"));
    let report: serde_json::Value = serde_json::from_str(report).expect("its report");
    assert!(output.status.success() && report["failed"].is_null(), "{report}");
    Ended { report, asked, posed }
}

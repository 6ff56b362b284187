//! Every reader of the HAL against broken input: the line to the autopilot, matching and reconciliation, logs, pictures, keys.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::io::Cursor;
use std::path::Path;
use std::time::Duration;

use config::link::{LinkSettings, Signing};
use config::mission::CameraSettings;
use hal::camera::{JpegSplitter, Picture, exif_pose, is_complete};
use hal::link::TlogLink;
use hal::mavlink::signing_store;
use hal::traits::Link;

#[path = "../../tests/readers/driver.rs"]
mod driver;
#[path = "../fuzz/src/targets.rs"]
mod targets;

use driver::{Random, Read, Reader, line, memory_folder, survive};

fn flight() -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/run8_trimmed.tlog");
    std::fs::read(path).expect("the recording in the repository")
}

/// Stretches of a recorded flight.
fn stretches(length: usize) -> Vec<Vec<u8>> {
    let (flight, mut random) = (flight(), Random::new(3));
    let stretch = |_| {
        let from = random.below(flight.len() - length);
        flight[from..from + length].to_vec()
    };
    (0..256).map(stretch).collect()
}

#[test]
fn mavlink() {
    survive(&Reader {
        name: "mavlink",
        seeds: stretches(400),
        text: false,
        shell: None,
        // Rings of a fixed size.
        memory: (256 << 10, 0),
        read: Read::Bytes(&|bytes| {
            let frames = targets::parse(bytes).framer.counters().frames;
            if frames > 0 { Ok(true) } else { Err("no frame".into()) }
        }),
    });
}

/// A download of the definition file, the list of parameters, one of them read and one set.
fn station() -> Vec<Vec<u8>> {
    let request = |kind: u8, bytes: &[u8]| [&[kind, u8::try_from(bytes.len()).expect("short")][..], bytes].concat();
    let file = |opcode: u8, offset: u8, data: &[u8]| {
        let size = u8::try_from(data.len()).expect("short");
        request(0, &[&[1, 0, 0, opcode, size, 0, 0, 0, offset, 0, 0, 0][..], data].concat())
    };
    let named = |kind: u8, head: [u8; 2], name: &str, value: f32| {
        let mut id = [0; 16];
        id[..name.len()].copy_from_slice(name.as_bytes());
        request(kind, &[&head[..], &id, &value.to_le_bytes()].concat())
    };
    vec![
        [file(4, 0, b"/definition.xml"), file(15, 0, &[]), file(5, 9, &[0; 80]), file(1, 0, &[])].concat(),
        [file(3, 0, b"/"), file(14, 0, b"definition.xml"), file(2, 0, &[])].concat(),
        [request(1, &[100]), named(2, [0xFF, 0xFF], "KF_OVERLAP", 0.0), request(4, &[3, 1])].concat(),
        [named(3, [0, 0], "KF_DISTANCE", 12.0), named(3, [4, 0], "TRAIN_SECONDS", 30.0)].concat(),
    ]
}

#[test]
fn a_ground_station_that_asks_the_camera() {
    let settings = std::cell::Cell::new(0);
    survive(&Reader {
        name: "station",
        seeds: station(),
        text: false,
        shell: None,
        // Everything has a fixed size.
        memory: (4 << 10, 0),
        read: Read::Bytes(&|bytes| {
            let answered = targets::ask_camera(bytes);
            settings.set(settings.get() + answered.settings);
            if answered.replies > 0 { Ok(true) } else { Err("no answer".into()) }
        }),
    });
    assert!(settings.get() > 100, "{} settings reached the job", settings.get());
}

/// Events and leftovers are whatever the bytes say: what is checked is that all of them are accounted for.
fn events(name: &'static str, memory: (usize, usize), read: &dyn Fn(&[u8])) {
    survive(&Reader {
        name,
        seeds: stretches(400),
        text: false,
        shell: None,
        memory,
        read: Read::Bytes(&|bytes| {
            read(bytes);
            if bytes.len() >= 16 { Ok(true) } else { Err("no event".into()) }
        }),
    });
}

#[test]
fn matcher() {
    events("matcher", (64 << 10, 0), &targets::match_up);
}

#[test]
fn reconciliation() {
    // Quadratic in what is left, 32 bytes a pair; an input makes fifty of both at most.
    events("reconciliation", ((64 << 10) + 64 * 50 * 50, 0), &targets::reconcile_all);
}

#[test]
fn telemetry_logs() {
    survive(&Reader {
        name: "tlog",
        seeds: stretches(600),
        text: false,
        shell: None,
        memory: (128 << 10, 0),
        read: Read::File("a.tlog", &|path| {
            let (mut link, mut buffer) = (TlogLink::open(path).map_err(|e| e.to_string())?, [0; 512]);
            while link.read(&mut buffer, Duration::ZERO).is_ok() {}
            if link.records() > 0 { Ok(true) } else { Err("a.tlog: no record".into()) }
        }),
    });
}

/// A log that is played back: everything it says of the flight is needed at once.
#[test]
fn addresses_of_links() {
    let seeds =
        ["serial:/dev/ttyAMA0:921600", "udpin:0.0.0.0:14550", "tcpout:ground.local:5760", "file:a.tlog", "pty:port"];
    survive(&Reader {
        name: "link-address",
        seeds: seeds.map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (16 << 10, 16),
        read: Read::Bytes(&|bytes| {
            let text = std::str::from_utf8(bytes).map_err(|e| e.to_string())?;
            line(text.parse::<hal::link::LinkAddress>(), |_| true)
        }),
    });
}

/// A JPEG's head with a GPS position: EXIF in little-endian TIFF, one directory that points to the next.
fn tagged() -> Vec<u8> {
    let entry = |tag: u16, kind: u16, count: u32, value: u32| {
        [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), &value.to_le_bytes()].concat()
    };
    let text = |c: u8| u32::from(c);
    let gps = [
        entry(1, 2, 2, text(b'N')),
        entry(2, 5, 3, 128),
        entry(3, 2, 2, text(b'W')),
        entry(4, 5, 3, 128),
        entry(5, 1, 1, 0),
        entry(6, 5, 1, 128),
    ];
    let mut tiff =
        [&b"II*\0"[..], &8u32.to_le_bytes(), &1u16.to_le_bytes(), &entry(0x8825, 4, 1, 26), &[0; 4]].concat();
    tiff.extend_from_slice(&6u16.to_le_bytes());
    gps.iter().for_each(|e| tiff.extend_from_slice(e));
    tiff.resize(128, 0);
    (0..6u32).for_each(|k| tiff.extend_from_slice(&(1 + k % 2).to_le_bytes()));
    let app1 = [&b"Exif\0\0"[..], &tiff].concat();
    let length = u16::try_from(app1.len() + 2).expect("short").to_be_bytes();
    [&[0xFF, 0xD8, 0xFF, 0xE1][..], &length, &app1, &[0xFF, 0xDA, 0, 4, 1, 2, 3, 4, 0xFF, 0xD9]].concat()
}

#[test]
fn poses_in_pictures() {
    survive(&Reader {
        name: "exif",
        seeds: vec![tagged()],
        text: false,
        shell: None,
        memory: (512 << 10, 64),
        read: Read::File("a.jpg", &|path| {
            let pose = exif_pose(path).ok_or("a.jpg: no pose")?;
            Ok(pose.position.is_valid() && pose.mount.is_none_or(|m| m.is_finite()))
        }),
    });
}

/// What a stream would bring.
fn bytes_of(path: &Path) -> Result<Vec<u8>, String> {
    let is_file = std::fs::metadata(path).is_ok_and(|m| m.is_file());
    is_file.then(|| std::fs::read(path).expect("there")).ok_or_else(|| format!("{}: no file", path.display()))
}

#[test]
fn ends_of_pictures_and_streams_of_them() {
    survive(&Reader {
        name: "jpeg-ends",
        seeds: vec![tagged()],
        text: false,
        shell: None,
        memory: (512 << 10, 64),
        read: Read::File("a.jpg", &|path| {
            let mut splitter = JpegSplitter::default();
            splitter.push(&bytes_of(path)?);
            while splitter.next_jpeg().is_some() {}
            match is_complete(path) {
                Ok(true) => Ok(true),
                Ok(false) => Err("a.jpg: not whole".into()),
                Err(e) => Err(format!("a.jpg: {e}")),
            }
        }),
    });
}

#[test]
fn pixels_of_pictures() {
    let lens = CameraSettings {
        width: 16,
        height: 12,
        fx: 10.0,
        fy: 10.0,
        cx: 8.0,
        cy: 6.0,
        distortion: [0.01, 0.0, 0.0, 0.0],
        exposure_delay_ms: 0.0,
        index: None,
    };
    let picture = image::RgbImage::from_fn(16, 12, |x, y| image::Rgb([(x * 16) as u8, (y * 20) as u8, 90]));
    let encoded = |format| {
        let mut bytes = Cursor::new(Vec::new());
        picture.write_to(&mut bytes, format).expect("encoded");
        bytes.into_inner()
    };
    survive(&Reader {
        name: "camera-pixels",
        seeds: vec![encoded(image::ImageFormat::Jpeg)],
        text: false,
        shell: None,
        memory: (2 << 20, 256),
        // From a folder and from a stream.
        read: Read::File("a.jpg", &|path| {
            let bytes = bytes_of(path).map(Picture::Jpeg).and_then(|p| p.decode(&lens).map_err(|e| e.to_string()));
            let file = line(Picture::Path(path.into()).decode(&lens), |image| image.dimensions() == (16, 12));
            let same = file.is_ok() == bytes.is_ok_and(|image| image.dimensions() == (16, 12));
            file.map(|usable| usable && same)
        }),
    });
}

#[test]
fn signing_keys_and_their_time_stamps() {
    let folder = memory_folder();
    let key = folder.path().join("key");
    let settings =
        |path: &Path| LinkSettings { signing: Signing::Require, signing_key: Some(path.into()), ..Default::default() };
    survive(&Reader {
        name: "signing-key",
        seeds: vec![vec![7; 32], "0123456789abcdef".repeat(4).into_bytes()],
        text: false,
        shell: None,
        memory: (256 << 10, 16),
        read: Read::File("link.key", &|path| line(signing_store::open(&settings(path)), |(_, store)| store.is_some())),
    });
    std::fs::write(&key, [7; 32]).expect("written");
    std::fs::set_permissions(&key, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("its own");
    let settings = settings(&key);
    survive(&Reader {
        name: "signing-time",
        seeds: ["200000000000000\n", "200000000000001"].map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (256 << 10, 16),
        read: Read::Bytes(&|bytes| {
            let path = folder.path().join("key.timestamp");
            std::fs::write(&path, bytes).expect("written");
            let (signer, _) = signing_store::open(&settings).map_err(|e| e.to_string())?;
            // What could not be read is set aside by name, and nothing stands in the way of the next.
            let aside = folder.path().join("key.damaged-1.timestamp");
            match std::fs::remove_file(&aside) {
                Ok(()) => Err(format!("set aside as {}", aside.display())),
                Err(_) => Ok(signer.timestamp() >> 48 == 0),
            }
        }),
    });
}

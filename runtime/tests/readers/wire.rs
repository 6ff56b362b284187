//! What comes over the wire or on a stick: offers, chunks, receipts, models.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use config::mission::Mission;
use config::upload::UploadSettings;
use ground::jobs::serve::admit::admit;
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use pages::watch::request;
use uplink::Source;
use uplink::folder::{FolderInlet, FolderOutlet};
use uplink::keys::Identity;
use uplink::offer::{Offer, OfferedModel, Order, hex};
use uplink::receipt::{Receipt, Verdict};
use uplink::transport::{Inlet, Outlet, Patience};

use crate::driver::{Read, Reader, Shell, line, memory_folder, survive};

const MISSION: &str = r#"
name = "park"
origin = { lat_deg = 28.0, lon_deg = -82.0, alt_m = 0.0 }
camera = { width = 64, height = 48, fx = 50.0, fy = 50.0, cx = 32.0, cy = 24.0 }
[[aircraft]]
id = "west"
link = "udpin:127.0.0.1:14550"
camera = { folder = "w" }
region_enu = [[-40.0, -20.0], [0.0, -20.0], [0.0, 20.0], [-40.0, 20.0]]
"#;

fn settings() -> UploadSettings {
    UploadSettings { chunk_kib: 16, max_model_mib: 1, ..UploadSettings::default() }
}

fn source() -> Source {
    let (mission, aircraft) = ("park".into(), "west".into());
    Source {
        mission,
        aircraft,
        identity: Identity::unsigned(),
        flight_number: None,
        session: None,
        disk: Default::default(),
        territory: None,
    }
}

/// A model file of so many bytes, on offer.
fn offered(bytes: usize) -> OfferedModel {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("m.dgtr");
    std::fs::write(&path, (0..bytes).map(|i| (i / 7) as u8).collect::<Vec<_>>()).expect("written");
    OfferedModel::open(&path, &settings(), &source(), Order { flight: 2, counter: 5 }, bytes > 100).expect("an offer")
}

/// A model of so many Gaussians in cells, on offer.
fn offered_in_cells(n: usize) -> OfferedModel {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("m.dgtr");
    let mut cloud = GaussianCloud::with_capacity(0, n);
    for i in 0..n {
        let place = [(i % 83) as f32, (i / 83) as f32, (i % 7) as f32];
        cloud.push(place, [-2.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.2; 3]);
    }
    let header = ModelHeader::default();
    model::write_rounded(&Default::default(), &path, &header, &cloud, &Default::default()).expect("written");
    OfferedModel::open(&path, &settings(), &source(), Order { flight: 2, counter: 5 }, true).expect("an offer")
}

#[test]
fn offers() {
    let signed = [&offered(40_000).offer.encode()[..], &[7; 64]].concat();
    let known = ["west".to_owned()];
    survive(&Reader {
        name: "offer",
        seeds: vec![
            offered(40_000).offer.encode(),
            offered_in_cells(9000).offer.encode(),
            offered(1).offer.encode(),
            offered(40_000).offer.bound_to(&[9; 32], &Identity::unsigned()).encode(),
            offered_in_cells(9000).offer.bound_to(&[8; 32], &Identity::unsigned()).encode(),
            signed,
        ],
        text: false,
        shell: None,
        memory: (4 << 10, 16),
        read: Read::Bytes(&|bytes| {
            line(Offer::decode(bytes, &settings()), |offer| {
                // It is what it was, whether or not it concerns us, and adds up.
                let bytes_of_chunks: u64 = (0..offer.chunks.len()).map(|i| offer.chunk_len(i)).sum();
                let told = offer.check("park", &known, &Identity::unsigned()).err().map(|e| e.to_string());
                Offer::decode(&offer.encode(), &settings()).as_ref() == Ok(&offer)
                    && bytes_of_chunks == offer.size
                    && told.is_none_or(|line| !line.contains('\n'))
            })
        }),
    });
}

#[test]
fn receipts() {
    let offer = offered(40_000).offer;
    let nobody = Identity::unsigned();
    let seeds = [Verdict::Received, Verdict::Refused("its origin is no place".into())];
    survive(&Reader {
        name: "receipt",
        seeds: seeds.map(|verdict| Receipt::new(&offer, verdict).seal(&nobody)).into(),
        text: false,
        shell: None,
        memory: (4 << 10, 16),
        read: Read::Bytes(&|bytes| {
            let receipt = Receipt::open(bytes, &nobody, "park", "west").ok_or("no receipt of ours")?;
            let _ = receipt.bearing(&offer);
            Ok(receipt.seal(&nobody).len() <= bytes.len())
        }),
    });
}

/// Whatever lies under a chunk's name on a stick: only the bytes that were promised are taken.
#[test]
fn chunks() {
    let folder = memory_folder();
    let model = offered(700);
    let mut outlet = FolderOutlet::new(&folder.path().join("stick"), source());
    outlet
        .offer(&Arc::new(model.renumbered(model.offer.order, &Identity::unsigned()).expect("open")))
        .expect("offered");
    let inlet = FolderInlet::new(&folder.path().join("stick"), "park", &[1; 32], &Identity::unsigned(), 4096);
    let whole = model.chunk(0).expect("a chunk");
    let path = folder.path().join("stick/park/west/chunk").join(hex(&model.offer.chunks[0]));
    let stop = AtomicBool::new(false);
    survive(&Reader {
        name: "chunk",
        seeds: vec![whole.clone()],
        text: false,
        shell: None,
        memory: (4 << 10, 4),
        read: Read::Bytes(&|bytes| {
            std::fs::write(&path, bytes).expect("written");
            let mut seen = Vec::new();
            let mut accept = |bytes: &[u8]| {
                seen = bytes.to_vec();
                blake3::hash(bytes).as_bytes() == &model.offer.chunks[0]
            };
            let patience = Patience { limit: Duration::ZERO, stop: &stop };
            match inlet.chunk(&model.offer, 0, patience, &mut accept) {
                Ok(taken) => Ok(taken == whole && bytes == whole),
                // Shown to the check of its hash, and not taken.
                Err(_) if seen == bytes && bytes != whole => Ok(true),
                Err(e) => Err(e.to_string()),
            }
        }),
    });
}

/// A model of four Gaussians in the aircraft's region.
fn model(header: &ModelHeader) -> Vec<u8> {
    let mut cloud = GaussianCloud::with_capacity(0, 4);
    for i in 0..4 {
        cloud.push([-10.0 * i as f32, 2.0, 1.0], [-2.0; 3], [1.0, 0.0, 0.0, 0.0], 1.0, &[0.1, 0.2, 0.3]);
    }
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("m.dgtr");
    model::write(&path, header, &cloud).expect("written");
    std::fs::read(path).expect("there")
}

#[test]
fn received_models() {
    let mission = Mission::parse(MISSION, Path::new(".")).expect("a mission");
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
    let pose = Pose { rotation: glam::DQuat::IDENTITY, center: glam::DVec3::new(-20.0, 0.0, 50.0) };
    let own = ModelHeader {
        mission: "park".into(),
        aircraft: "west".into(),
        origin: Some(mission.origin),
        region: vec![[-40.0, -20.0], [0.0, -20.0], [0.0, 20.0]],
        views: vec![("a.png".into(), View { intrinsics, pose })],
        ..ModelHeader::default()
    };
    let shell = Shell {
        open: |file| file[..file.len() - 32].to_vec(),
        close: |mut content| {
            content.extend_from_slice(blake3::hash(&content).as_bytes());
            content
        },
    };
    survive(&Reader {
        name: "received-model",
        seeds: vec![model(&own), model(&ModelHeader::default())],
        text: false,
        shell: Some(shell),
        memory: (512 << 10, 32),
        read: Read::File("model.dgtr", &|path| match admit(&mission, "west", path) {
            Ok(admitted) => {
                let header = &admitted.header;
                let corners = header.region.iter().flatten().all(|v| v.is_finite());
                Ok(corners && header.aircraft == "west" && header.region.len() == 4)
            }
            // The gate leaves the name to whoever asks: it lies under a temporary one.
            Err(why) => Err(format!("{}: {why}", path.display())),
        }),
    });
}

#[test]
fn requests_of_a_page() {
    let browser = "GET /thumbnail?of=3&token=abc HTTP/1.1\r\nHost: localhost:8080\r\nAccept: */*\r\n\
                   Cookie: a=b; dgtr=uvw\r\nConnection: keep-alive\r\n\r\n";
    let tool = "GET /state.json HTTP/1.1\r\nhost: 127.0.0.1\r\nAuthorization: Bearer xyz\r\n\r\n";
    survive(&Reader {
        name: "page request",
        seeds: [browser, tool].map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (16 << 10, 8),
        read: Read::Bytes(&|bytes| match request::parse(bytes) {
            Ok(Some(asked)) => {
                let parts = asked.host.iter().chain(&asked.shown).chain(&asked.in_address).map(String::len);
                Ok(parts.sum::<usize>() <= bytes.len())
            }
            Ok(None) => Err("its end has not come".into()),
            Err(why) => Err(format!("{why:?}")),
        }),
    });
}

//! Gaussian models: `.dgtr`, PLY, SPZ, SOG, glTF, `.splat`.

use std::fmt::Display;
use std::io::Read as _;
use std::path::Path;

use flate2::read::GzDecoder;
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::delivery::Rounding;
use models::formats::{gltf, model, ply, sog, splats, spz};

use crate::driver::{Random, Read, Reader, Shell, line, survive};

fn cloud(degree: u8, n: usize) -> GaussianCloud {
    let mut random = Random::new(u64::from(degree));
    let mut cloud = GaussianCloud::with_capacity(degree, n);
    for _ in 0..n {
        let mut number = || random.below(2000) as f32 / 500.0 - 2.0;
        let (mean, scale) = ([(); 3].map(|()| 20.0 * number()), [(); 3].map(|()| number()));
        let (rotation, logit) = ([1.0, number(), number(), number()], number());
        let sh: Vec<f32> = (0..cloud.sh_stride()).map(|_| number()).collect();
        cloud.push(mean, scale, rotation, logit, &sh);
    }
    cloud
}

fn all_valid(cloud: &GaussianCloud) -> bool {
    (0..cloud.len()).all(|i| cloud.is_valid(i))
}

/// What a writer wrote.
fn written<E: Display>(write: impl FnOnce(&Path) -> Result<(), E>) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("tempdir");
    let path = folder.path().join("seed");
    write(&path).map_err(|e| e.to_string()).expect("a seed");
    std::fs::read(&path).expect("read")
}

fn headers() -> [model::ModelHeader; 2] {
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 40.0, fy: 41.0, cx: 32.0, cy: 24.5 };
    let view = View { intrinsics, pose: Pose { rotation: DQuat::IDENTITY, center: DVec3::new(1.0, -2.5, 60.0) } };
    let views = (0..3).map(|i| (format!("v{i}.jpg"), view)).collect();
    let region = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]];
    [
        model::ModelHeader { mission: "park".into(), aircraft: "a1".into(), region, views, ..Default::default() },
        model::ModelHeader::default(),
    ]
}

/// The hash that ends a `.dgtr` file.
const HASHED: Shell = Shell {
    open: |file| file[..file.len() - 32].to_vec(),
    close: |mut content| {
        content.extend_from_slice(blake3::hash(&content).as_bytes());
        content
    },
};

/// The hashes of a `.dgtr` in cells: that of each cell's words in its entry, and that of the index behind it.
const HASHED_CELLS: Shell = Shell {
    open: <[u8]>::to_vec,
    close: |mut file| {
        let word = |file: &[u8], at: usize| {
            file.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize)
        };
        let (Some(header), cells) = (word(&file, 12), 28) else { return file };
        let Some(index) = header.checked_add(cells).filter(|at| *at < file.len()) else { return file };
        let Some(n) = word(&file, index + 4) else { return file };
        let Some(end) = n.checked_mul(93).map(|b| index + 8 + b).filter(|at| at + 32 <= file.len()) else {
            return file;
        };
        let mut at = end + 32;
        // Of each cell its words' number and hash; the coarse layers come first in the file.
        for (words, hash) in [(57, 61), (13, 21)] {
            for entry in (0..n).map(|i| index + 8 + 93 * i) {
                let Some(bytes) = word(&file, entry + words).and_then(|w| file.get(at..at + 4 * w)) else { break };
                let (own, length) = (blake3::hash(bytes), bytes.len());
                file[entry + hash..entry + hash + 32].copy_from_slice(own.as_bytes());
                at += length;
            }
        }
        let hash = blake3::hash(&file[..end]);
        file[end..end + 32].copy_from_slice(hash.as_bytes());
        file
    },
};

#[test]
fn rounded_dgtr_models() {
    let [full, empty] = headers();
    let rounded = |header, cloud| {
        written(|path| model::write_rounded(&Default::default(), path, header, &cloud, &Rounding::default()).map(drop))
    };
    survive(&Reader {
        name: "dgtr, rounded",
        seeds: vec![rounded(&full, cloud(1, 20)), rounded(&empty, cloud(0, 2)), rounded(&full, cloud(0, 1400))],
        text: false,
        shell: Some(HASHED_CELLS),
        memory: (4 << 20, 16),
        read: Read::File("m.dgtr", &|path| line(model::read(path), |(_, cloud)| all_valid(&cloud))),
    });
}

#[test]
fn dgtr_models() {
    let [full, empty] = headers();
    let seeds = vec![
        written(|path| model::write(path, &full, &cloud(1, 4))),
        written(|path| model::write(path, &empty, &cloud(0, 2))),
    ];
    survive(&Reader {
        name: "dgtr",
        seeds,
        text: false,
        shell: Some(HASHED),
        memory: (512 << 10, 16),
        read: Read::File("m.dgtr", &|path| {
            line(model::read(path), |(header, cloud)| {
                all_valid(&cloud) && header.views.iter().all(|(_, view)| view.is_usable())
            })
        }),
    });
}

/// PlayCanvas' compressed form: bounds of a chunk, and four words for each of two Gaussians.
fn compressed() -> Vec<u8> {
    let bounds = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
    let mut file = "ply\nformat binary_little_endian 1.0\nelement chunk 1\n".to_owned();
    for side in bounds.chunks(3).flat_map(|of| ["min", "max"].map(|side| of.iter().map(move |b| (side, b)))) {
        side.for_each(|(side, of)| file += &format!("property float {side}_{of}\n"));
    }
    file += "element vertex 2\n";
    ["position", "rotation", "scale", "color"].iter().for_each(|of| file += &format!("property uint packed_{of}\n"));
    let mut bytes = (file + "end_header\n").into_bytes();
    let range = |low: f32, high: f32| [[low; 3], [high; 3]].concat();
    let numbers = [range(-5.0, 5.0), range(-6.0, -1.0), range(0.0, 1.0)].concat();
    bytes.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
    let words =
        [0x1234_5678u32, 0x2A55_5555, 0x7654_3210, 0x80FF_40C0, 0x9ABC_DEF0, 0x1555_5AAA, 0x0F0F_0F0F, 0xFF00_FF80];
    bytes.extend(words.iter().flat_map(|w| w.to_le_bytes()));
    bytes
}

/// Flat Gaussians (2DGS) as text.
fn flat() -> Vec<u8> {
    let names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3".split(' ');
    let names: String = names.map(|n| format!("property float {n}\n")).collect();
    let rows = "1 2 3 0.1 0.2 0.3 1.5 -2 -3 1 0 0 0\n-1 -2 3e1 0 0 0 -2 -2 -3.5 0.5 0.5 -0.5 0.5\n";
    format!("ply\nformat ascii 1.0\ncomment flat\nelement vertex 2\n{names}end_header\n{rows}").into_bytes()
}

#[test]
fn ply_models() {
    let [small, full] = [(0, 5), (2, 2)].map(|(degree, n)| written(|path| ply::write(path, &cloud(degree, n), None)));
    survive(&Reader {
        name: "ply",
        seeds: vec![small, full, compressed(), flat()],
        text: true,
        shell: None,
        memory: (256 << 10, 64),
        read: Read::File("m.ply", &|path| line(ply::read(path), |model| all_valid(&model.cloud))),
    });
}

#[test]
fn spz_models() {
    let shell = Shell {
        open: |file| {
            let mut content = Vec::new();
            GzDecoder::new(file).read_to_end(&mut content).expect("a seed unpacks");
            content
        },
        // Stored, not packed: packing is no part of what is tested, and takes most of the time.
        close: |content| {
            let (parts, last) = content.split_at(content.len() - content.len().min(0xFFFF));
            assert!(parts.is_empty(), "a short file");
            let length = last.len() as u16;
            let mut crc = flate2::Crc::new();
            crc.update(last);
            let mut out = vec![0x1F, 0x8B, 8, 0, 0, 0, 0, 0, 0, 255, 1];
            out.extend([length.to_le_bytes(), (!length).to_le_bytes()].concat());
            out.extend(last);
            out.extend([crc.sum().to_le_bytes(), crc.amount().to_le_bytes()].concat());
            out
        },
    };
    survive(&Reader {
        name: "spz",
        seeds: [(0, 9), (3, 3)]
            .map(|(degree, n)| {
                written(|path| spz::write(path, &cloud(degree, n), spz::SpzOptions::default()).map(drop))
            })
            .into(),
        text: false,
        shell: Some(shell),
        memory: (512 << 10, 400),
        read: Read::File("m.spz", &|path| line(spz::read(path, spz::Axes::Rub), |model| all_valid(&model.cloud))),
    });
}

/// Streams of zstd, each with its length in a table.
#[test]
fn spz_models_of_version_4() {
    let options = spz::SpzOptions { is_latest: true, ..Default::default() };
    survive(&Reader {
        name: "spz, version 4",
        seeds: [(0, 9), (3, 3)]
            .map(|(degree, n)| written(|path| spz::write(path, &cloud(degree, n), options).map(drop)))
            .into(),
        text: false,
        shell: None,
        // A window of zstd is as large as its frame says, up to the reader's bound.
        memory: (24 << 20, 400),
        read: Read::File("m.spz", &|path| line(spz::read(path, spz::Axes::Rub), |model| all_valid(&model.cloud))),
    });
}

/// What `dgtr import` does with a file of any name.
#[test]
fn models_that_are_known_by_their_content() {
    survive(&Reader {
        name: "splats",
        seeds: vec![
            written(|path| gltf::write(path, &cloud(0, 5))),
            written(|path| sog::write(path, &cloud(1, 5)).map(drop)),
            written(|path| ply::write(path, &cloud(1, 4), None)),
            // Position, scales, colour and opacity, rotation.
            [[0u8; 12], [60; 12]].map(|xyz| [&xyz[..], &[61; 12], &[90; 4], &[128, 200, 10, 77]].concat()).concat(),
        ],
        text: false,
        shell: None,
        memory: (24 << 20, 400),
        read: Read::File("m.splat", &|path| line(splats::read(path, spz::Axes::Rub), |model| all_valid(&model.cloud))),
    });
}

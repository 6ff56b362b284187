//! Every reader of a file survives broken ones: no panic, memory in proportion to the file, and what is accepted is usable.
//! 10⁵ inputs for each reader, from a fixed seed; `DGTR_FUZZ_INPUTS` sets another number. Overflow checks and debug
//! assertions are on in the profile that builds this.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::fmt::Display;
use std::io::{Read, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use glam::{DQuat, DVec3};
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::{colmap, model, ply, spz, transforms};
use models::onnx::manifest::Manifest;

#[path = "readers/memory.rs"]
mod memory;
#[path = "readers/mutation.rs"]
mod mutation;

use mutation::{Random, mutate};

/// Inputs for each reader unless the environment says otherwise.
const INPUTS: usize = 100_000;

/// A file format under test.
struct Format<'a> {
    name: &'static str,
    /// Name under which the inputs are written.
    file: &'static str,
    /// Whole files.
    seeds: Vec<Vec<u8>>,
    /// Mutated as text rather than as words.
    text: bool,
    /// A shell around the content that hides it from mutation (checksum, compression): taken off and put on again for half
    /// of the inputs.
    shell: Option<Shell>,
    /// Bytes that reading may take whatever the file holds, and for each byte of it.
    memory: (usize, usize),
    /// Reads; `Err` is the error's line, `Ok` whether what was accepted is usable.
    read: &'a dyn Fn(&Path) -> Result<bool, String>,
}

#[derive(Clone, Copy)]
struct Shell {
    open: fn(&[u8]) -> Vec<u8>,
    close: fn(Vec<u8>) -> Vec<u8>,
}

/// Feeds the reader; says how many inputs were accepted and what the most memory was.
fn survive(format: &Format<'_>) {
    let inputs = std::env::var("DGTR_FUZZ_INPUTS").ok().and_then(|n| n.parse().ok()).unwrap_or(INPUTS);
    let folder = ["/dev/shm"].into_iter().find(|f| Path::new(f).is_dir()).map(tempfile::tempdir_in);
    let folder = folder.unwrap_or_else(tempfile::tempdir).expect("a folder for the inputs");
    let path = folder.path().join(format.file);
    for seed in &format.seeds {
        std::fs::write(&path, seed).expect("write");
        assert_eq!((format.read)(&path), Ok(true), "{}: a whole file is accepted", format.name);
    }
    let mut random = Random::new(1);
    let (mut accepted, mut largest) = (0, 0);
    for i in 0..inputs {
        let [seed, other] = [(); 2].map(|()| &format.seeds[random.below(format.seeds.len())]);
        let bytes = match format.shell.filter(|_| i % 2 == 0) {
            Some(shell) => (shell.close)(mutate(&(shell.open)(seed), &(shell.open)(other), format.text, &mut random)),
            None => mutate(seed, other, format.text, &mut random),
        };
        std::fs::write(&path, &bytes).expect("write");
        let keep = |why: &str| {
            let kept = std::env::temp_dir().join(format!("{}-{i}-{}", format.name, format.file));
            std::fs::write(&kept, &bytes).expect("write");
            panic!("{} input {i}: {why}; kept as {}", format.name, kept.display())
        };
        let (read, bytes_held) = memory::peak(|| catch_unwind(AssertUnwindSafe(|| (format.read)(&path))));
        match read {
            Err(_) => keep("the reader panicked"),
            Ok(Err(line)) if line.contains('\n') || !line.contains(format.file) => keep(&format!("says {line:?}")),
            Ok(Err(_)) => {}
            Ok(Ok(false)) => keep("what was accepted is not usable"),
            Ok(Ok(true)) => accepted += 1,
        }
        if bytes_held > format.memory.0 + format.memory.1 * bytes.len() {
            keep(&format!("{bytes_held} bytes held for a file of {}", bytes.len()));
        }
        largest = largest.max(bytes_held);
    }
    println!("{}: {inputs} inputs, {accepted} accepted, {largest} bytes held at most", format.name);
    // Neither all refused at the door nor all let through.
    assert!(accepted * 1000 > inputs && accepted < inputs, "{}: {accepted} of {inputs} accepted", format.name);
}

fn line<T, E: Display>(read: Result<T, E>, usable: impl FnOnce(T) -> bool) -> Result<bool, String> {
    read.map(usable).map_err(|e| e.to_string())
}

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

#[test]
fn dgtr_models() {
    let [full, empty] = headers();
    let seeds = vec![
        written(|path| model::write(path, &full, &cloud(1, 4))),
        written(|path| model::write(path, &empty, &cloud(0, 2))),
    ];
    let shell = Shell {
        open: |file| file[..file.len() - 32].to_vec(),
        close: |mut content| {
            content.extend_from_slice(blake3::hash(&content).as_bytes());
            content
        },
    };
    survive(&Format {
        name: "dgtr",
        file: "m.dgtr",
        seeds,
        text: false,
        shell: Some(shell),
        memory: (512 << 10, 16),
        read: &|path| {
            line(model::read(path), |(header, cloud)| {
                all_valid(&cloud) && header.views.iter().all(|(_, view)| view.is_usable())
            })
        },
    });
}

#[test]
fn ply_models() {
    survive(&Format {
        name: "ply",
        file: "m.ply",
        seeds: [(0, 5), (2, 2)].map(|(degree, n)| written(|path| ply::write(path, &cloud(degree, n), None))).into(),
        text: true,
        shell: None,
        memory: (256 << 10, 64),
        read: &|path| line(ply::read(path), |model| all_valid(&model.cloud)),
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
        close: |content| {
            let mut out = GzEncoder::new(Vec::new(), flate2::Compression::fast());
            out.write_all(&content).and_then(|()| out.finish()).expect("packs")
        },
    };
    survive(&Format {
        name: "spz",
        file: "m.spz",
        seeds: [(0, 9), (3, 3)].map(|(degree, n)| written(|path| spz::write(path, &cloud(degree, n)))).into(),
        text: false,
        shell: Some(shell),
        memory: (512 << 10, 400),
        read: &|path| line(spz::read(path), |model| all_valid(&model.cloud)),
    });
}

/// Little-endian fields of COLMAP's binary files.
#[derive(Default)]
struct Fields(Vec<u8>);

impl Fields {
    fn words(mut self, words: &[u32]) -> Self {
        self.0.extend(words.iter().flat_map(|w| w.to_le_bytes()));
        self
    }

    fn longs(mut self, longs: &[u64]) -> Self {
        self.0.extend(longs.iter().flat_map(|w| w.to_le_bytes()));
        self
    }

    fn numbers(mut self, numbers: &[f64]) -> Self {
        self.0.extend(numbers.iter().flat_map(|w| w.to_le_bytes()));
        self
    }

    fn bytes(mut self, bytes: &[u8]) -> Self {
        self.0.extend(bytes);
        self
    }
}

#[test]
fn colmap_cameras() {
    let opencv = Fields::default().longs(&[2]).words(&[1, 4]).longs(&[64, 48]).numbers(&[40.0, 41.0, 32.0, 24.0]);
    let opencv = opencv.numbers(&[0.01, -0.01, 0.001, 0.0]).words(&[2, 1]).longs(&[64, 48]);
    let simple = Fields::default().longs(&[1]).words(&[7, 0]).longs(&[640, 480]).numbers(&[400.0, 320.0, 240.0]);
    survive(&Format {
        name: "colmap-cameras",
        file: "cameras.bin",
        seeds: vec![opencv.numbers(&[40.0, 41.0, 32.0, 24.0]).0, simple.0],
        text: false,
        shell: None,
        memory: (64 << 10, 32),
        read: &|path| line(colmap::read_cameras(path), |cameras| cameras.len() < 1000),
    });
}

#[test]
fn colmap_images() {
    let image = |fields: Fields, id: u32| {
        let fields = fields.words(&[id]).numbers(&[1.0, 0.1, 0.0, 0.0, 3.0, -2.0, 60.0]).words(&[1]);
        fields.bytes(b"a/b.jpg\0").longs(&[1]).numbers(&[10.0, 20.0]).longs(&[u64::MAX])
    };
    let seeds = vec![image(image(Fields::default().longs(&[2]), 1), 2).0, image(Fields::default().longs(&[1]), 9).0];
    survive(&Format {
        name: "colmap-images",
        file: "images.bin",
        seeds,
        text: false,
        shell: None,
        memory: (64 << 10, 32),
        read: &|path| {
            line(colmap::read_images(path), |images| {
                images.iter().all(|i| i.pose.center.is_finite() && i.pose.rotation.is_finite())
            })
        },
    });
}

#[test]
fn colmap_points() {
    let point = |fields: Fields, id: u64| {
        let fields = fields.longs(&[id]).numbers(&[1.0, 2.0, 3.0]).bytes(&[1, 2, 3]).numbers(&[0.4]);
        fields.longs(&[2]).words(&[1, 5, 2, 6])
    };
    let seeds = vec![point(point(Fields::default().longs(&[2]), 1), 2).0, point(Fields::default().longs(&[1]), 7).0];
    survive(&Format {
        name: "colmap-points",
        file: "points3D.bin",
        seeds,
        text: false,
        shell: None,
        memory: (64 << 10, 32),
        read: &|path| {
            let mut finite = true;
            let read = colmap::read_points(path, &mut |p| finite &= p.position.is_finite());
            line(read, |_| finite)
        },
    });
}

#[test]
fn nerfstudio_transforms() {
    let frame = "{\n\"file_path\": \"a.jpg\",\n\"transform_matrix\": [\n[1, 0, 0, 1.5],\n[0, 1, 0, 2],\n[0, 0, 1, 3],\n[0, 0, 0, 1]\n]\n}";
    let lens = "\"w\": 64,\n\"h\": 48,\n\"fl_x\": 40.0,\n\"fl_y\": 41,\n\"cx\": 32,\n\"cy\": 24.5,\n\"k1\": 0.01,";
    let shared = format!("{{\n{lens}\n\"frames\": [\n{frame},\n{frame}\n]\n}}\n");
    let own = format!(
        "{{\n\"camera_angle_x\": 0.9,\n\"enu_origin_wgs84\": {{\n\"lat\": 48.1,\n\"lon\": 11.5,\n\"alt\": 500\n}},\n\"frames\": [\n{frame}\n]\n}}\n"
    );
    survive(&Format {
        name: "transforms",
        file: "transforms.json",
        seeds: vec![shared.into_bytes(), own.into_bytes()],
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: &|path| {
            line(transforms::read(path), |file| {
                file.shots.iter().all(|f| f.pose.center.is_finite() && f.pose.rotation.is_finite())
            })
        },
    });
}

#[test]
fn network_manifests() {
    let networks = Path::new(env!("CARGO_MANIFEST_DIR")).join("networks");
    let seeds = ["random_pair", "plane_sweep", "random_depth", "mean_square"];
    survive(&Format {
        name: "manifest",
        file: "n.toml",
        seeds: seeds.map(|name| std::fs::read(networks.join(name).with_extension("toml")).expect("a manifest")).into(),
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: &|path| {
            line(Manifest::read(path), |m| {
                let (w, h) = m.input_size(4000, 3000);
                w > 0 && h > 0 && m.input.std.iter().all(|s| s.is_finite() && *s != 0.0)
            })
        },
    });
}

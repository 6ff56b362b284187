//! What a Gaussian weighs in each format that a model is written in, and what writing and reading it costs; `tests/codecs.sh` asks
//! it of a real model and adds what each file's pictures lose.
#![allow(clippy::unwrap_used, reason = "a measurement fails by panicking")]

use std::path::{Path, PathBuf};
use std::time::Instant;

use models::cloud::GaussianCloud;
use models::formats::delivery::Rounding;
use models::formats::{model, ply, spz as our_spz};

/// Rounds, of which the best counts.
const ROUNDS: usize = 3;

fn milliseconds<T>(mut work: impl FnMut() -> T) -> (f64, T) {
    let mut best = (f64::INFINITY, None);
    for _ in 0..ROUNDS {
        let clock = Instant::now();
        let result = work();
        best = (best.0.min(clock.elapsed().as_secs_f64() * 1e3), Some(result));
    }
    (best.0, best.1.unwrap())
}

/// As the crate `spz` holds a cloud: the same axes and the same order of coefficients as here.
fn as_the_crate_has_it(cloud: &GaussianCloud) -> spz::GaussianSplat {
    let mut splat = spz::GaussianSplat {
        num_points: i32::try_from(cloud.len()).unwrap(),
        spherical_harmonics_degree: i32::from(cloud.sh_degree),
        positions: cloud.means.as_flattened().to_vec(),
        scales: cloud.log_scales.as_flattened().to_vec(),
        rotations: cloud.rotations.iter().flat_map(|q| [q[1], q[2], q[3], q[0]]).collect(),
        alphas: cloud.opacity_logits.clone(),
        ..Default::default()
    };
    for sh in cloud.sh.chunks_exact(cloud.sh_stride()) {
        splat.colors.extend(&sh[..3]);
        splat.spherical_harmonics.extend(&sh[3..]);
    }
    splat
}

/// `DGTR_MODEL=m.dgtr DGTR_OUT=folder`: the files stay there. A line each: file, bytes a Gaussian, ms to write, ms to read.
#[test]
#[ignore = "a measurement, not a promise"]
fn bytes_of_a_gaussian_and_milliseconds_to_write_and_read_it() {
    let asked = |name| std::env::var_os(name).map(PathBuf::from);
    let (Some(path), Some(out)) = (asked("DGTR_MODEL"), asked("DGTR_OUT")) else {
        println!("skipped: DGTR_MODEL and DGTR_OUT say which model and where to");
        return;
    };
    let (header, cloud) = model::read(&path).unwrap();
    let report = |file: &str, write: &mut dyn FnMut(&Path), read: &mut dyn FnMut(&Path)| {
        let path = out.join(file);
        let (writing, ()) = milliseconds(|| write(&path));
        let (reading, ()) = milliseconds(|| read(&path));
        let each = std::fs::metadata(&path).unwrap().len() as f64 / cloud.len() as f64;
        println!("{file}\t{each:.2}\t{writing:.0}\t{reading:.0}");
    };
    let count = |read: usize| assert_eq!(read, cloud.len());
    let mut read_model = |path: &Path| count(model::read(path).unwrap().1.len());
    report("exact.dgtr", &mut |path| model::write(path, &header, &cloud).unwrap(), &mut read_model);
    for (file, rounding) in [("delivery.dgtr", Rounding::default()), ("fine.dgtr", Rounding::fine())] {
        let mut write = |path: &Path| {
            model::write_rounded(&Default::default(), path, &header, &cloud, &rounding).unwrap();
        };
        report(file, &mut write, &mut read_model);
    }
    report(
        "ours.spz",
        &mut |path| {
            our_spz::write(path, &cloud, Default::default()).unwrap();
        },
        &mut |path| {
            count(our_spz::read(path, Default::default()).unwrap().cloud.len());
        },
    );
    let theirs = as_the_crate_has_it(&cloud);
    report(
        "crate.spz",
        &mut |path| theirs.save_as_packed(path, &spz::PackOptions::builder().build()).unwrap(),
        &mut |path| {
            let read = spz::GaussianSplat::load_packed_from_file(path, &spz::UnpackOptions::builder().build());
            count(usize::try_from(read.unwrap().num_points).unwrap());
        },
    );
    report("exact.ply", &mut |path| ply::write(path, &cloud, header.origin).unwrap(), &mut |path| {
        count(ply::read(path).unwrap().cloud.len());
    });
}

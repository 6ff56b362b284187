//! Shows a `.dgtr` in Rerun's viewer, and every later version of it: what `dgtr train`, `dgtr fly` and `dgtr serve` write while they go on.
//!
//! `dgtr-rerun out/model.dgtr` starts to send to a viewer on this machine; `--to FILE.rrd` writes a file for one.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, SystemTime};

use anyhow::Context;
use clap::Parser;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use rerun::components::{SphericalHarmonics3Rgb, SphericalHarmonicsDegree};
use rerun::{
    Color, GaussianSplats3D, Pinhole, Quaternion, RecordingStream, RecordingStreamBuilder, RecordingStreamResult,
    Transform3D, ViewCoordinates,
};

/// Distance at which a camera's outline is drawn, metres.
const OUTLINE_M: f32 = 2.0;
/// Between two looks at the file; it is replaced whole.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Shows a model in Rerun's viewer, and every later version of it until Ctrl-C.
#[derive(Parser)]
#[command(version)]
struct Args {
    /// The model; it need not be there yet.
    model: PathBuf,
    /// A viewer's address, or a file for one (FILE.rrd).
    #[arg(long, default_value = "rerun+http://127.0.0.1:9876/proxy")]
    to: String,
    /// Show the present version and end.
    #[arg(long)]
    once: bool,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::clone(&stop))?;
    let view = open(&args.to)?;
    let mut last = None;
    while !stop.load(Ordering::Relaxed) {
        if let Some(step) = show_if_new(&view, &args.model, &mut last)? {
            println!("{}: step {step}", args.model.display());
        }
        if args.once {
            anyhow::ensure!(last.is_some(), "{}: is not there", args.model.display());
            break;
        }
        std::thread::sleep(LOOK_EVERY);
    }
    view.flush_blocking()?;
    Ok(())
}

fn open(target: &str) -> anyhow::Result<RecordingStream> {
    let builder = RecordingStreamBuilder::new("dgtr");
    let opened = match target.contains("://") {
        true => builder.connect_grpc_opts(target),
        false => builder.save(target),
    };
    let view = opened.with_context(|| {
        format!("--to {target}: give a file to write (FILE.rrd) or a viewer's address (rerun+http://HOST:9876/proxy)")
    })?;
    view.log_static("world", &ViewCoordinates::RIGHT_HAND_Z_UP())?;
    Ok(view)
}

/// Shows the file if it is another one than that of `last`, and says of which step it is.
fn show_if_new(view: &RecordingStream, path: &Path, last: &mut Option<SystemTime>) -> anyhow::Result<Option<u64>> {
    let Ok(changed) = path.metadata().and_then(|m| m.modified()) else { return Ok(None) };
    if *last == Some(changed) {
        return Ok(None);
    }
    let (header, cloud) = model::read(path)?;
    show(view, &header, &cloud)?;
    *last = Some(changed);
    Ok(Some(header.steps))
}

fn show(view: &RecordingStream, header: &ModelHeader, cloud: &GaussianCloud) -> RecordingStreamResult<()> {
    view.set_time_sequence("step", i64::try_from(header.steps).unwrap_or(i64::MAX));
    for (i, (_, shot)) in header.views.iter().enumerate() {
        let (k, pose) = (&shot.intrinsics, &shot.pose);
        let rotation = Quaternion::from_xyzw(pose.rotation.as_quat().to_array());
        let at = Transform3D::from_translation_rotation(pose.center.as_vec3().to_array(), rotation);
        let lens = Pinhole::from_focal_length_and_resolution([k.fx, k.fy], [k.width as f32, k.height as f32])
            .with_principal_point([k.cx, k.cy])
            .with_image_plane_distance(OUTLINE_M);
        view.log(format!("world/pictures/{i}"), &at)?;
        view.log(format!("world/pictures/{i}"), &lens)?;
    }
    view.log("world/model", &splats(cloud))
}

/// In Rerun's units: standard deviations, colours and opacities of 8 bits.
fn splats(cloud: &GaussianCloud) -> GaussianSplats3D {
    let byte = |v: f32| (255.0 * v.clamp(0.0, 1.0)).round() as u8;
    let color = |i: usize| {
        let [r, g, b] = cloud.color(i).map(byte);
        Color::from_unmultiplied_rgba(r, g, b, byte(1.0 / (1.0 + (-cloud.opacity_logits[i]).exp())))
    };
    let rotation = |[w, x, y, z]: [f32; 4]| {
        let length = (w * w + x * x + y * y + z * z).sqrt().max(f32::MIN_POSITIVE);
        Quaternion::from_xyzw([x, y, z, w].map(|v| v / length))
    };
    let all = GaussianSplats3D::new(cloud.means.iter().copied())
        .with_scales(cloud.log_scales.iter().map(|s| s.map(f32::exp)))
        .with_quaternions(cloud.rotations.iter().map(|q| rotation(*q)))
        .with_colors((0..cloud.len()).map(color));
    match cloud.sh_degree {
        0 => all.with_spherical_harmonics_degree(SphericalHarmonicsDegree::from(0)),
        degree => all
            .with_sh_coefficients(cloud.sh.chunks_exact(cloud.sh_stride()).map(higher))
            .with_spherical_harmonics_degree(SphericalHarmonicsDegree::from(u32::from(degree))),
    }
}

/// Coefficients of a Gaussian without the first, which is its colour; those above the model's degree are nothing.
fn higher(row: &[f32]) -> SphericalHarmonics3Rgb {
    let mut all = [[0.0; 3]; 15];
    all.iter_mut().zip(row.as_chunks::<3>().0.iter().skip(1)).for_each(|(to, from)| *to = *from);
    SphericalHarmonics3Rgb::from(all)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use models::camera::{Intrinsics, Pose, View};

    use super::*;

    fn model(path: &Path, steps: u64) {
        let mut cloud = GaussianCloud::with_capacity(1, 100);
        let sh: Vec<f32> = (0..12).map(|i| i as f32 / 10.0).collect();
        (0..100).for_each(|i| cloud.push([i as f32, 2.0, 3.0], [0.0, -1.0, 1.0], [2.0, 0.0, 0.0, 0.0], 0.0, &sh));
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        let pose = Pose { rotation: glam::DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: glam::DVec3::Z * 30.0 };
        let views = vec![("a".into(), View { intrinsics, pose })];
        model::write(path, &ModelHeader { steps, views, ..Default::default() }, &cloud).unwrap();
    }

    #[test]
    fn every_version_of_a_model_is_shown_once() {
        let dir = tempfile::tempdir().unwrap();
        let (path, rrd) = (dir.path().join("model.dgtr"), dir.path().join("scene.rrd"));
        let view = open(rrd.to_str().unwrap()).unwrap();
        let mut last = None;
        assert_eq!(show_if_new(&view, &path, &mut last).unwrap(), None, "it is not there yet");
        model(&path, 7);
        assert_eq!(show_if_new(&view, &path, &mut last).unwrap(), Some(7));
        assert_eq!(show_if_new(&view, &path, &mut last).unwrap(), None);
        std::thread::sleep(Duration::from_millis(20));
        model(&path, 9);
        assert_eq!(show_if_new(&view, &path, &mut last).unwrap(), Some(9));
        drop(view);
        assert!(std::fs::read(&rrd).unwrap().starts_with(b"RRF2"));
        std::fs::write(&path, b"no model").unwrap();
        assert!(show_if_new(&open(rrd.to_str().unwrap()).unwrap(), &path, &mut last).is_err());
    }

    #[test]
    fn a_target_that_is_none_is_refused_in_a_line_that_says_what_is() {
        for bad in ["/missing/folder/scene.rrd", "gopher://nowhere"] {
            let said = open(bad).err().unwrap().to_string();
            assert!(said.contains(bad) && said.contains("FILE.rrd") && said.lines().count() == 1, "{said}");
        }
    }

    #[test]
    fn numbers_are_in_the_units_that_rerun_shows() {
        let row: Vec<f32> = (0..12).map(|i| i as f32 / 10.0).collect();
        let shown: [[f32; 3]; 15] = higher(&row).0.0.map(|c| c.map(f32::from));
        let near = |i: usize, c: usize| (shown[i][c] - row[3 * i + 3 + c]).abs() < 1e-3;
        assert!((0..3).all(|i| (0..3).all(|c| near(i, c))), "{shown:?}");
        assert!(shown[3..].iter().flatten().all(|v| *v == 0.0));
    }
}

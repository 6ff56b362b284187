//! Instances: very few, very many, and in lists longer than a driver lets a loop turn.
#![allow(missing_docs, reason = "their names say what they promise")]

use super::device::{ready, survive};
use super::scenes::{answer, answer_in, cloud, grey, photo, plain, posed, view};
use super::{Broken, Outcome, Tally};
use crate::fixture::Fixture;
use crate::gpu::Gpu;
use crate::reference::camera::Camera;
use crate::reference::gaussian::{Gaussian, PARAMETERS};
use crate::reference::project::Limits;
use crate::reference::step::forward;
use crate::trainer::{Rendering, StepReport};
use config::plan::{Plan, PlanRequest};
use models::camera::View;
use models::cloud::GaussianCloud;

/// Specks in one corner.
fn specks() -> GaussianCloud {
    let mut c = GaussianCloud::with_capacity(0, 3);
    for i in 0..3 {
        c.push([-0.9, -0.7, 2.0 + i as f32], [-7.0; 3], [1.0, 0.0, 0.0, 0.0], 3.0, &[grey(0.9); 3]);
    }
    c
}

pub fn more_tiles_than_instances_leave_the_other_tiles_empty(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let v = view(64, 48);
    let c = specks();
    let (drawn, report) = survive(&mut counted, &mut ready(gpu, 0, &v, &plain())?, &c, &v, "specks")?;
    promise!((1..192).contains(&report.instances), "{} instances", report.instances);
    let expected = answer(&c, &v, &photo(1, &v), &Default::default());
    for (i, p) in expected.picture.iter().enumerate() {
        promise!((drawn.transmittance[i] - p.transmittance).abs() < 1.0 / 255.0, "pixel {i}");
    }
    Ok(counted.said())
}

pub fn more_tiles_than_instances_leave_the_other_tiles_empty_in_the_reference() -> Outcome {
    let mut counted = Tally::default();
    let v = view(64, 48);
    let got = counted.ask(&specks(), &v, &photo(1, &v), &Default::default());
    got.check_finite("specks")?;
    promise!((1..192).contains(&got.instances), "{} instances", got.instances);
    let empty = got.picture.iter().filter(|p| p.transmittance == 1.0 && p.rgb == [0.0; 3]).count();
    promise!((64 * 48 - 100..64 * 48).contains(&empty), "{empty} empty pixels");
    Ok(counted.said())
}

/// Needles at every angle, giants, specks, Gaussians across the picture's edges and almost at the camera.
fn odd_shapes() -> GaussianCloud {
    let mut c = cloud(31, 160, 0);
    for i in 0..c.len() {
        match i % 5 {
            0 => (c.means[i], c.log_scales[i]) = ([0.1, -0.1, 3.0], [3.0, -40.0, -40.0]),
            1 => c.log_scales[i] = [4.0; 3],
            2 => c.log_scales[i] = [-30.0; 3],
            3 => c.means[i] = [1.2 * c.means[i][0], 1.2 * c.means[i][1], c.means[i][2]],
            _ => c.means[i] = c.means[i].map(|x| 0.01 * x),
        }
    }
    c
}

/// A trainer with room for `instances`, the cloud loaded and one photograph.
fn loaded(gpu: &Gpu, c: &GaussianCloud, v: &View, instances: usize) -> Result<Fixture, Broken> {
    let request = PlanRequest {
        device_mib: 64,
        width: v.intrinsics.width,
        height: v.intrinsics.height,
        views: 1,
        sh_degree: c.sh_degree,
        max_gaussians: None,
        scene_gaussians: None,
        ..Default::default()
    };
    let mut t = Fixture::new(gpu, &Plan::with_capacities(&request, c.len(), instances), &plain())?;
    t.load(c)?;
    t.add_view(&posed(v, &photo(1, v)), None)?;
    Ok(t)
}

/// Picture, cloud after some steps and the last step's report, with room for `instances`.
fn trained(
    gpu: &Gpu,
    c: &GaussianCloud,
    v: &View,
    instances: usize,
    steps: u32,
) -> Result<(Rendering, GaussianCloud, StepReport), Broken> {
    let mut t = loaded(gpu, c, v, instances)?;
    let mut drawn = Rendering::default();
    t.render(v, &mut drawn)?;
    for _ in 1..steps {
        t.step()?;
    }
    let report = t.step()?;
    let mut after = GaussianCloud::default();
    t.snapshot(&mut after)?;
    Ok((drawn, after, report))
}

/// A tile's list begins where the count of those before it ends: one instance more or fewer than counted, and a plan that
/// just fits, or one cut elsewhere, would draw something else.
pub fn every_shape_emits_exactly_the_instances_it_was_counted_for(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let (c, v) = (odd_shapes(), view(64, 48));
    let (drawn, after, report) = trained(gpu, &c, &v, 1 << 16, 3)?;
    promise_eq!(report.bands, 1);
    let exact = report.instances as usize;
    for instances in [exact, exact - 1, exact / 3, c.len()] {
        let (again, after_again, r) = trained(gpu, &c, &v, instances, 3)?;
        promise!(again == drawn && after_again == after, "room for {instances} instead of 65,536 changes something");
        promise_eq!((r.instances, r.bands > 1), (report.instances, instances < exact), "room for {instances}");
        counted.scene(3, r.visible, r.instances);
    }
    Ok(counted.said())
}

/// 2,000 layers of α = 1/250 or so: towards the end T·α is 3·10⁻⁷, a twentieth of what f16 holds as a normal number.
fn faint_layers() -> GaussianCloud {
    let mut c = GaussianCloud::with_capacity(0, 2000);
    for i in 0..2000 {
        let z = 2.0 + 1e-3 * i as f32;
        c.push([0.0, 0.0, z], [4.0; 3], [1.0, 0.0, 0.0, 0.0], -5.515, &[grey(1.0); 3]);
    }
    c
}

/// Transmittance and depth of the middle pixel in f64.
fn faint_truth(c: &GaussianCloud, v: &View) -> (f64, f64) {
    let all = |_: usize| 1.0;
    let (gaussians, camera) = (Gaussian::<f64>::of_cloud(c), Camera::<f64>::of(v));
    let picture = forward(&gaussians, &camera, |_| 0, all, &Limits::default()).picture;
    let middle = picture[picture.len() / 2];
    (middle.transmittance, middle.depth)
}

fn faint_holds(transmittance: f32, depth: f32, truth: (f64, f64)) -> Outcome {
    promise!(truth.0 < 1e-3, "transmittance {}: not the case that was meant", truth.0);
    let (t, d) = ((f64::from(transmittance) / truth.0 - 1.0).abs(), (f64::from(depth) / truth.1 - 1.0).abs());
    promise!(t < 1e-3 && d < 1e-5, "transmittance off by {t}, depth by {d} of itself");
    Ok(format!("T {transmittance:.3e}, off by {t:.1e} of itself"))
}

pub fn light_and_contributions_below_sixteen_bits_are_still_summed(gpu: &Gpu) -> Outcome {
    let (c, v) = (faint_layers(), view(9, 9));
    let (drawn, after, _) = trained(gpu, &c, &v, 1 << 16, 3)?;
    promise!((0..after.len()).all(|i| after.is_valid(i)), "a row went bad");
    let middle = drawn.transmittance.len() / 2;
    faint_holds(drawn.transmittance[middle], drawn.depth[middle], faint_truth(&c, &v))
}

pub fn light_and_contributions_below_sixteen_bits_are_still_summed_in_the_reference() -> Outcome {
    let (c, v) = (faint_layers(), view(9, 9));
    let got = answer(&c, &v, &photo(1, &v), &Default::default());
    got.check_finite("faint layers")?;
    let middle = got.picture[got.picture.len() / 2];
    faint_holds(middle.transmittance, middle.depth, faint_truth(&c, &v))
}

/// Behind four opaque Gaussians all others wait in one tile.
fn crowded_tile(v: &View, n: usize) -> GaussianCloud {
    let k = v.intrinsics;
    let mut c = GaussianCloud::with_capacity(0, n);
    for i in 0..n {
        // The middle of a tile.
        let z = 3.0 + 1e-4 * i as f32;
        let speck = [z * (142.0 - k.cx) / k.fx, z * (102.0 - k.cy) / k.fy, z];
        let (mean, scale, logit) = if i < 4 { ([0.0, 0.0, 2.0], 3.0, 80.0) } else { (speck, -9.0, 0.0) };
        c.push(mean, [scale; 3], [1.0, 0.0, 0.0, 0.0], logit, &[grey(0.8); 3]);
    }
    c
}

/// llvmpipe ends the loops of an invocation after 65,535 turns; here 70,000 wait. Their gradient slots hold SSIM's maps
/// before, so that one which is not cleared is a gradient of nonsense.
pub fn a_tile_with_more_gaussians_than_a_loop_may_turn_leaves_those_behind_alone(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let (v, n) = (view(256, 256), 70_000);
    let c = crowded_tile(&v, n);
    let (_, after, report) = trained(gpu, &c, &v, 1 << 17, 3)?;
    promise_eq!((report.instances, report.bands), (n as u64 - 4 + 4 * 32 * 64, 1));
    let moved = (4..n).filter(|i| after.means[*i] != c.means[*i] || after.sh[3 * i] != c.sh[3 * i]).count();
    promise_eq!(moved, 0, "Gaussians that nobody sees and yet move");
    promise!(after.sh[0] != c.sh[0], "the first one does not learn");
    counted.scene(3, report.visible, report.instances);
    Ok(counted.said())
}

pub fn a_crowded_tile_leaves_those_behind_opaque_ones_alone_in_the_reference() -> Outcome {
    let mut counted = Tally::default();
    let (v, n) = (view(256, 256), 70_000);
    let got = counted.ask(&crowded_tile(&v, n), &v, &photo(1, &v), &Default::default());
    promise_eq!(got.instances, n - 4 + 4 * 32 * 64);
    let mut gradients = got.gradient.gaussians;
    let moved = gradients[4..].iter_mut().filter_map(|g| (0..PARAMETERS).find(|k| *g.parameter(*k) != 0.0)).count();
    promise_eq!(moved, 0, "Gaussians that nobody sees and yet would move");
    promise!(gradients[0].sh[0][0] != 0.0, "the first one does not learn");
    Ok(counted.said())
}

/// One Gaussian over 70,400 tiles and a photograph that is dark below: the tiles that a loop would miss say something else
/// than the others.
fn wide_scene() -> (GaussianCloud, View, Vec<[f32; 3]>) {
    let mut c = GaussianCloud::with_capacity(0, 1);
    c.push([0.1, 0.2, 5.0], [1.5; 3], [1.0, 0.0, 0.0, 0.0], 0.3, &[grey(0.7); 3]);
    let photo = (0..2200 * 1024).map(|i| if i < 2200 * 900 { [1.0; 3] } else { [0.0; 3] }).collect();
    (c, view(2200, 1024), photo)
}

/// Its gradient is that of f64: colour and opacity, in 32 bits.
fn wide_holds(sh: &[f32], opacity: f32) -> Outcome {
    let (c, v, photo) = wide_scene();
    let expected = answer_in::<f64>(&c, &v, &photo, &plain().loss).gradient.gaussians[0];
    let pairs = (0..3).map(|k| (sh[k], expected.sh[0][k])).chain([(opacity, expected.opacity_logit)]);
    let mut worst = 0.0f64;
    for (got, want) in pairs {
        worst = worst.max((f64::from(got) / want - 1.0).abs());
        promise!(worst < 1e-3, "{got} instead of {want}");
    }
    Ok(format!("off by {worst:.1e} of itself"))
}

pub fn a_gaussian_over_more_tiles_than_sixteen_bits_count_has_its_whole_gradient_in_the_reference() -> Outcome {
    let (c, v, photo) = wide_scene();
    let got = answer(&c, &v, &photo, &plain().loss);
    got.check_finite("one Gaussian")?;
    promise_eq!(got.instances, 70_400);
    let gradient = got.gradient.gaussians[0];
    wide_holds(&gradient.sh[0], gradient.opacity_logit)
}

/// Its gradient is the sum over all of them.
pub fn a_gaussian_with_more_tiles_than_a_loop_may_turn_has_its_whole_gradient(gpu: &Gpu) -> Outcome {
    let (c, v, photo) = wide_scene();
    let request = PlanRequest {
        device_mib: 256,
        width: 2200,
        height: 1024,
        views: 1,
        sh_degree: 0,
        max_gaussians: None,
        scene_gaussians: None,
        ..Default::default()
    };
    let mut t = Fixture::new(gpu, &Plan::with_capacities(&request, 1, 1 << 17), &plain())?;
    t.load(&c)?;
    t.add_view(&posed(&v, &photo), None)?;
    let mut gradient = GaussianCloud::default();
    t.gradient(0, &mut gradient)?;
    wide_holds(&gradient.sh, gradient.opacity_logits[0])
}

/// 2^32 and a few million instances through a whole step: the loss is that of the four opaque Gaussians in front, they
/// learn what they learn alone, and those behind do not move. Up to half an hour on two cores.
pub fn more_instances_than_thirty_two_bits_count(gpu: &Gpu) -> Outcome {
    let mut counted = Tally::default();
    let (v, n, tiles) = (view(1448, 1448), 65_600, 181 * 362);
    let mut c = GaussianCloud::with_capacity(0, n);
    for i in 0..n {
        let (z, logit) = if i < 4 { (2.0, 80.0) } else { (3.0 + 1e-5 * i as f32, 0.0) };
        c.push([0.0, 0.0, z], [9.0; 3], [1.0, 0.0, 0.0, 0.0], logit, &[grey(0.8); 3]);
    }
    let mut front = c.clone();
    front.retain(|i| i < 4);
    let step = |c: &GaussianCloud| -> Result<(StepReport, GaussianCloud), Broken> {
        let mut t = loaded(gpu, c, &v, usize::MAX)?;
        let (report, mut after) = (t.step()?, GaussianCloud::default());
        t.snapshot(&mut after)?;
        Ok((report, after))
    };
    let (expected, expected_after) = step(&front)?;
    let (report, after) = step(&c)?;
    promise_eq!(report.instances, n as u64 * tiles);
    promise_eq!(report.loss, expected.loss);
    // Not the means: their rate follows the extent of the scene.
    promise!(after.sh[..12] == expected_after.sh[..], "those in front learn something else");
    promise!(after.sh[0] != c.sh[0], "the first one does not learn");
    promise!(after.means[4..] == c.means[4..] && after.sh[12..] == c.sh[12..], "some that nobody sees have moved");
    counted.scene(1, report.visible, report.instances);
    Ok(format!("{}, {} bands", counted.said(), report.bands))
}

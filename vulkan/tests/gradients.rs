//! Every gradient the trainer uses, against central differences in f64: relative error ≤ 1e-3, median ≤ 1e-5.
//!
//! The cut-offs (1/255, the transmittance stop) are taken out, because a jump has no derivative; everything else
//! is what the shaders compute. Scenes hold Gaussians behind the camera, off the picture, tiny, huge, overlapping;
//! the principal point is off centre.

use config::training::LossSettings;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use vulkan::reference::camera::{Camera, Rays};
use vulkan::reference::entropy::entropy;
use vulkan::reference::gaussian::{Gaussian, PARAMETERS};
use vulkan::reference::loss::{Exposure, Target, loss};
use vulkan::reference::project::Limits;
use vulkan::reference::step::{Forward, ViewGradient, backward, forward};
use vulkan::reference::view_dependence::magnitude;

const SIZE: [u32; 2] = [29, 21];

/// DropGaussian: one is left out, the others are raised.
fn drop(i: usize) -> f64 {
    if i == 3 { 0.0 } else { 1.1 }
}

#[derive(Clone)]
struct Scene {
    cloud: Vec<Gaussian<f64>>,
    camera: Camera<f64>,
    exposure: Exposure<f64>,
    photo: Vec<[f64; 3]>,
    prior: Vec<f64>,
    confidence: Vec<f64>,
    degree: u8,
    settings: LossSettings,
    background: [f64; 3],
    /// What the weight of view dependence counts.
    shown: Vec<[[bool; 3]; 16]>,
}

fn quaternion(rng: &mut impl Rng) -> [f64; 4] {
    std::array::from_fn(|_| rng.random_range(-1.0..1.0))
}

impl Scene {
    fn random(seed: u64, degree: u8) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let base = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            center: [0.0; 3],
            focal: [24.0, 25.5],
            principal: [16.3, 8.9],
            size: SIZE,
            rays: Rays::Perspective,
        };
        let camera = base.moved([0.2, -0.3, 0.4, 0.1, -0.2, 0.3]);
        let mut cloud = Vec::new();
        for i in 0..32 {
            // In camera space: mostly in view, some behind, some far off the picture, some grazing the clamp.
            let z = match i % 8 {
                7 => rng.random_range(-3.0..-0.5),
                _ => rng.random_range(1.5..6.0),
            };
            let wide = if i % 8 == 6 { 2.5 } else { 0.5 };
            let p = [rng.random_range(-wide..wide) * z, rng.random_range(-wide..wide) * z, z];
            let shifted: [f64; 3] = std::array::from_fn(|k| p[k] - camera.translation[k]);
            let mean = std::array::from_fn(|k| (0..3).map(|r| camera.rotation[r][k] * shifted[r]).sum());
            let size: f64 = match i % 5 {
                0 => 0.005,
                1 => 1.5,
                _ => 0.15,
            };
            cloud.push(Gaussian {
                mean,
                log_scale: std::array::from_fn(|_| size.ln() + rng.random_range(-0.7..0.7)),
                rotation: quaternion(&mut rng),
                opacity_logit: rng.random_range(-3.0..2.5),
                sh: std::array::from_fn(|k| {
                    let bound = if k == 0 { 1.5 } else { 0.3 };
                    std::array::from_fn(|_| rng.random_range(-bound..bound))
                }),
            });
        }
        let n = (SIZE[0] * SIZE[1]) as usize;
        Self {
            cloud,
            camera,
            exposure: Exposure { log_gain: [0.1, -0.2, 0.05], offset: [0.02, -0.01, 0.03] },
            photo: (0..n).map(|_| std::array::from_fn(|_| rng.random_range(0.0..1.0))).collect(),
            prior: (0..n).map(|_| rng.random_range(0.0..1.0)).collect(),
            confidence: (0..n).map(|_| rng.random_range(0.0..1.0)).collect(),
            degree,
            settings: nothing(),
            background: [0.3, 0.6, 0.1],
            shown: Vec::new(),
        }
    }

    fn target(&self) -> Target<'_, f64> {
        let depth: Option<(&[f64], &[f64])> =
            if self.settings.depth > 0.0 { Some((&self.prior, &self.confidence)) } else { None };
        Target { width: SIZE[0] as usize, rgb: &self.photo, depth, kept: None, background: self.background }
    }

    fn rendered(&self) -> Forward<f64> {
        forward(&self.cloud, &self.camera, |_| self.degree, drop, &Limits::smooth())
    }

    fn gradient(&self) -> ViewGradient<f64> {
        let degree = |_: usize| self.degree;
        let limits = Limits::smooth();
        let (target, rendered) = (self.target(), self.rendered());
        backward(&self.cloud, &self.camera, degree, drop, &limits, &rendered, &target, &self.exposure, &self.settings)
    }

    fn total(&self) -> f64 {
        let rendered = self.rendered();
        let seen: Vec<f64> = self
            .cloud
            .iter()
            .zip(&rendered.projected)
            .filter(|(_, p)| p.is_some())
            .map(|(g, _)| entropy(g.opacity_logit))
            .collect();
        let hesitation = seen.iter().sum::<f64>() / seen.len().max(1) as f64;
        let of = |(g, counts): (&Gaussian<f64>, &[[bool; 3]; 16])| -> f64 {
            let all = g.sh.as_flattened().iter().zip(counts.as_flattened()).skip(3);
            all.filter(|(_, counts)| **counts).map(|(c, _)| magnitude(*c)).sum()
        };
        let varies: f64 = self.cloud.iter().zip(&self.shown).map(of).sum();
        loss(&rendered.picture, &self.target(), &self.exposure, &self.settings).total
            + f64::from(self.settings.entropy) * hesitation
            + f64::from(self.settings.view_dependence) * varies
    }

    /// Says which coefficients the picture shows: a small change makes no other ones.
    fn look(&mut self) {
        self.shown = self.gradient().gaussians.iter().map(|g| g.sh.map(|c| c.map(|by| by != 0.0))).collect();
    }
}

/// Collects how far analytic and numeric derivatives of one parameter group differ.
struct Check {
    errors: Vec<f64>,
    group: String,
}

impl Check {
    fn new(group: impl Into<String>) -> Self {
        Self { errors: Vec::new(), group: group.into() }
    }

    fn compare(&mut self, scene: &Scene, analytic: f64, floor: f64, change: impl Fn(&mut Scene, f64)) {
        let h = 2e-6;
        let at = |step: f64| {
            let mut moved = scene.clone();
            change(&mut moved, step);
            moved.total()
        };
        let numeric = (at(h) - at(-h)) / (2.0 * h);
        self.errors.push((analytic - numeric).abs() / analytic.abs().max(numeric.abs()).max(floor));
    }

    fn assert(mut self) {
        self.errors.sort_by(f64::total_cmp);
        let (n, worst) = (self.errors.len(), self.errors.last().copied().unwrap_or(1.0));
        let median = self.errors[n / 2];
        println!("{:<40} n {n:>4}  median {median:.1e}  worst {worst:.1e}", self.group);
        assert!(median <= 1e-5 && worst <= 1e-3, "{}: median {median:.2e}, worst {worst:.2e}", self.group);
    }
}

/// No term at all, shapes free.
fn nothing() -> LossSettings {
    LossSettings { l1: 0.0, ssim: 0.0, depth: 0.0, freeze_shape: false, view_dependence: 0.0, ..Default::default() }
}

/// Each term alone and all together. (L1 has a kink where x = y; with random photographs the rendering is practically never
/// within a step of one.)
fn terms() -> [(&'static str, LossSettings); 6] {
    let none = nothing();
    [
        ("l1", LossSettings { l1: 0.8, ..none }),
        ("ssim", LossSettings { ssim: 0.2, ..none }),
        ("depth", LossSettings { depth: 0.05, ..none }),
        ("entropy", LossSettings { entropy: 0.5, ..none }),
        ("view dependence", LossSettings { l1: 0.8, view_dependence: 1e-3, ..none }),
        ("all", LossSettings { freeze_shape: false, entropy: 0.1, view_dependence: 1e-3, ..Default::default() }),
    ]
}

#[test]
fn every_parameter_group_agrees_with_central_differences() {
    let groups: [(&str, std::ops::Range<usize>); 7] = [
        ("means", 0..3),
        ("log scales", 3..6),
        ("rotations", 6..10),
        ("opacity logits", 10..11),
        ("sh 0", 11..14),
        ("sh 1", 14..23),
        ("sh 2-3", 23..PARAMETERS),
    ];
    for (term, settings) in terms() {
        let mut scene = Scene::random(7, 3);
        scene.settings = settings;
        scene.look();
        let gradient = scene.gradient();
        for (name, range) in &groups {
            let mut check = Check::new(format!("{term}: {name}"));
            let all = |i: usize, k: usize| *gradient.gaussians[i].clone().parameter(k);
            // Below this a central difference in f64 sees only rounding.
            let floor =
                (0..scene.cloud.len()).flat_map(|i| range.clone().map(move |k| all(i, k).abs())).fold(0.0, f64::max)
                    * 1e-5;
            for i in 0..scene.cloud.len() {
                // Every parameter of the small groups, a sample of the large one.
                for k in range.clone().step_by(if range.len() > 10 { 7 } else { 1 }) {
                    check.compare(&scene, all(i, k), floor.max(1e-9), |s, h| *s.cloud[i].parameter(k) += h);
                }
            }
            if !(term == "depth" && name.starts_with("sh")) {
                check.assert();
            }
        }
    }
}

#[test]
fn pose_and_exposure_agree_with_central_differences() {
    for (term, settings) in terms() {
        let (mut pose, mut exposure) = (Check::new(format!("{term}: pose")), Check::new(format!("{term}: exposure")));
        for seed in 0..6 {
            let mut scene = Scene::random(seed, 3);
            scene.settings = settings;
            let gradient = scene.gradient();
            for k in 0..6 {
                pose.compare(&scene, gradient.pose[k], 1e-9, |s, h| {
                    let mut xi = [0.0; 6];
                    xi[k] = h;
                    s.camera = s.camera.moved(xi);
                });
            }
            for c in 0..3 {
                let e = &gradient.loss.exposure;
                exposure.compare(&scene, e.log_gain[c], 1e-9, |s, h| s.exposure.log_gain[c] += h);
                exposure.compare(&scene, e.offset[c], 1e-9, |s, h| s.exposure.offset[c] += h);
            }
        }
        pose.assert();
        exposure.assert();
    }
}

#[test]
fn parallel_rays_have_their_own_gradients() {
    let mut scene = Scene::random(3, 3);
    scene.camera = Camera { rays: Rays::Orthographic, focal: [6.0, 6.4], ..scene.camera };
    // The median depth has none.
    scene.settings = LossSettings { depth: 0.0, ..Default::default() };
    scene.look();
    let gradient = scene.gradient();
    for (name, range) in [("means", 0..3), ("log scales", 3..6), ("rotations", 6..10), ("sh 1", 14..23)] {
        let mut check = Check::new(format!("orthographic: {name}"));
        for i in 0..scene.cloud.len() {
            for k in range.clone() {
                let analytic = *gradient.gaussians[i].clone().parameter(k);
                check.compare(&scene, analytic, 1e-7, |s, h| *s.cloud[i].parameter(k) += h);
            }
        }
        check.assert();
    }
    let mut pose = Check::new("orthographic: pose");
    for k in 0..6 {
        pose.compare(&scene, gradient.pose[k], 1e-9, |s, h| {
            let mut xi = [0.0; 6];
            xi[k] = h;
            s.camera = s.camera.moved(xi);
        });
    }
    pose.assert();
}

#[test]
fn lower_sh_degrees_have_no_gradient_above_them() {
    for degree in 0..3u8 {
        let mut scene = Scene::random(11, degree);
        scene.settings = LossSettings { freeze_shape: false, ..Default::default() };
        let gradient = scene.gradient();
        let first = 11 + 3 * models::cloud::sh_coefficients(degree);
        for g in &gradient.gaussians {
            assert!((first..PARAMETERS).all(|k| *g.clone().parameter(k) == 0.0));
        }
        let mut check = Check::new(format!("degree {degree}: means"));
        for i in 0..scene.cloud.len() {
            for k in 0..3 {
                check.compare(&scene, gradient.gaussians[i].mean[k], 1e-8, |s, h| s.cloud[i].mean[k] += h);
            }
        }
        check.assert();
    }
}

#[test]
fn shape_freezing_keeps_depth_away_from_scales_and_rotations() {
    let mut scene = Scene::random(5, 1);
    scene.settings.depth = 0.05;
    let free = scene.gradient();
    scene.settings.freeze_shape = true;
    let frozen = scene.gradient();
    assert!(free.gaussians.iter().any(|g| g.log_scale.iter().any(|v| v.abs() > 1e-9)));
    for g in &frozen.gaussians {
        assert!(g.log_scale == [0.0; 3] && g.rotation == [0.0; 4]);
    }
    assert!(frozen.gaussians.iter().any(|g| g.mean.iter().any(|v| v.abs() > 1e-9)));
    assert!(frozen.gaussians.iter().any(|g| g.opacity_logit.abs() > 1e-9));
}

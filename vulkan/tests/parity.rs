//! Parity with the published formulas: an f64 evaluation of 3DGS/gsplat, written from the papers without tiles, sorting
//! stages or culling, against the reference in f32 with everything the renderer does.
//!
//! Documented band: a contribution whose α lies within 2e-6 of the cut-off 1/255 may be taken by one and skipped by the
//! other, likewise a pixel whose transmittance passes within 2e-9 of the stop; such pixels are counted and exempt.

use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use vulkan::constants::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};
use vulkan::reference::camera::{Camera, Rays};
use vulkan::reference::gaussian::Gaussian;
use vulkan::reference::project::Limits;
use vulkan::reference::step::forward;

const SIZE: [u32; 2] = [96, 70];

fn scene(seed: u64) -> (Vec<Gaussian<f64>>, Camera<f64>) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let camera = Camera {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        translation: [0.0; 3],
        center: [0.0; 3],
        focal: [80.0, 84.0],
        principal: [53.7, 29.2],
        size: SIZE,
        rays: Rays::Perspective,
    }
    .moved([0.3, -0.1, 0.7, 0.4, 0.2, 0.5]);
    // What f32 can hold exactly, so that both sides see the same numbers.
    let camera: Camera<f64> = camera.cast::<f32>().cast();
    let exact = |v: f64| f64::from(v as f32);
    let cloud = (0..400)
        .map(|i| {
            let z: f64 = if i % 10 == 9 { -1.0 } else { rng.random_range(0.5..12.0) };
            let p = [rng.random_range(-1.2..1.2) * z, rng.random_range(-1.0..1.0) * z, z];
            let shifted: [f64; 3] = std::array::from_fn(|k| p[k] - camera.translation[k]);
            let size: f64 = [0.003, 0.05, 0.2, 1.0][i % 4];
            Gaussian {
                mean: std::array::from_fn(|k| exact((0..3).map(|r| camera.rotation[r][k] * shifted[r]).sum())),
                log_scale: std::array::from_fn(|_| exact(size.ln() + rng.random_range(-1.0..1.0))),
                rotation: std::array::from_fn(|_| exact(rng.random_range(-1.0..1.0))),
                opacity_logit: exact(rng.random_range(-4.0..5.0)),
                sh: std::array::from_fn(|k| {
                    let bound = if k == 0 { 1.5 } else { 0.2 };
                    std::array::from_fn(|_| exact(rng.random_range(-bound..bound)))
                }),
            }
        })
        .collect();
    (cloud, camera)
}

/// 3DGS' `computeCov3D`, `computeCov2D`, `computeColorFromSH` and `renderCUDA`, line by line, for one pixel at a time.
struct Reference {
    depth: f64,
    center: [f64; 2],
    conic: [f64; 3],
    opacity: f64,
    colour: [f64; 3],
}

fn reference(g: &Gaussian<f64>, c: &Camera<f64>) -> Option<Reference> {
    let t: [f64; 3] =
        std::array::from_fn(|r| (0..3).map(|k| c.rotation[r][k] * g.mean[k]).sum::<f64>() + c.translation[r]);
    if t[2] <= 0.01 {
        return None;
    }
    let q = glam::DQuat::from_xyzw(g.rotation[1], g.rotation[2], g.rotation[3], g.rotation[0]).normalize();
    let s = glam::DMat3::from_diagonal(glam::DVec3::from_array(g.log_scale.map(f64::exp)));
    let m = glam::DMat3::from_quat(q) * s;
    let sigma = m * m.transpose();
    let w = glam::DMat3::from_cols_array_2d(&c.rotation).transpose();
    let tan = [0.5 * f64::from(SIZE[0]) / c.focal[0], 0.5 * f64::from(SIZE[1]) / c.focal[1]];
    let limited = |k: usize| {
        let high = (f64::from(SIZE[k]) - c.principal[k]) / c.focal[k] + 0.3 * tan[k];
        let low = c.principal[k] / c.focal[k] + 0.3 * tan[k];
        t[2] * (t[k] / t[2]).clamp(-low, high)
    };
    let (tx, ty, z) = (limited(0), limited(1), t[2]);
    let j = glam::DMat3::from_cols_array_2d(&[
        [c.focal[0] / z, 0.0, 0.0],
        [0.0, c.focal[1] / z, 0.0],
        [-c.focal[0] * tx / (z * z), -c.focal[1] * ty / (z * z), 0.0],
    ]);
    let cov = j * w * sigma * w.transpose() * j.transpose();
    let (a, b, d) = (cov.x_axis.x + 0.3, cov.x_axis.y, cov.y_axis.y + 0.3);
    let det = a * d - b * b;
    let direction = (glam::DVec3::from_array(g.mean) - glam::DVec3::from_array(c.center)).normalize();
    let (x, y, zz) = (direction.x, direction.y, direction.z);
    let (x2, y2, z2) = (x * x, y * y, zz * zz);
    let basis = [
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * zz,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * zz,
        0.31539156525252005 * (2.0 * z2 - x2 - y2),
        -1.0925484305920792 * x * zz,
        0.5462742152960396 * (x2 - y2),
        -0.5900435899266435 * y * (3.0 * x2 - y2),
        2.890611442640554 * x * y * zz,
        -0.4570457994644658 * y * (4.0 * z2 - x2 - y2),
        0.3731763325901154 * zz * (2.0 * z2 - 3.0 * x2 - 3.0 * y2),
        -0.4570457994644658 * x * (4.0 * z2 - x2 - y2),
        1.445305721320277 * zz * (x2 - y2),
        -0.5900435899266435 * x * (x2 - 3.0 * y2),
    ];
    Some(Reference {
        depth: z,
        center: [c.focal[0] * t[0] / z + c.principal[0], c.focal[1] * t[1] / z + c.principal[1]],
        conic: [d / det, -b / det, a / det],
        opacity: 1.0 / (1.0 + (-g.opacity_logit).exp()),
        colour: std::array::from_fn(|k| (0.5 + (0..16).map(|i| basis[i] * g.sh[i][k]).sum::<f64>()).max(0.0)),
    })
}

/// Colour, depth, transmittance, and whether the pixel lies in the documented band.
fn reference_pixel(sorted: &[Reference], x: u32, y: u32) -> ([f64; 3], f64, f64, bool) {
    let (mut rgb, mut depth, mut t, mut band) = ([0.0; 3], 0.0, 1.0, false);
    for g in sorted {
        let d = [f64::from(x) + 0.5 - g.center[0], f64::from(y) + 0.5 - g.center[1]];
        let power = -0.5 * (g.conic[0] * d[0] * d[0] + g.conic[2] * d[1] * d[1]) - g.conic[1] * d[0] * d[1];
        let alpha = (g.opacity * power.exp()).min(f64::from(ALPHA_MAX));
        band |= (alpha - f64::from(ALPHA_MIN)).abs() < 2e-6;
        if power > 0.0 || alpha < f64::from(ALPHA_MIN) {
            continue;
        }
        let next = t * (1.0 - alpha);
        band |= (next - f64::from(TRANSMITTANCE_MIN)).abs() < 2e-9;
        if next < f64::from(TRANSMITTANCE_MIN) {
            break;
        }
        for k in 0..3 {
            rgb[k] += g.colour[k] * alpha * t;
        }
        depth += g.depth * alpha * t;
        t = next;
    }
    (rgb, depth, t, band)
}

#[test]
fn the_picture_is_the_published_formulas_within_one_grey_level() {
    for seed in 0..4 {
        let (cloud, camera) = scene(seed);
        let mut sorted: Vec<Reference> = cloud.iter().filter_map(|g| reference(g, &camera)).collect();
        sorted.sort_by(|a, b| a.depth.total_cmp(&b.depth));
        let single: Vec<Gaussian<f32>> = cloud.iter().map(cast).collect();
        let drawn = forward(&single, &camera.cast::<f32>(), |_| 3, |_| 1.0, &Limits::default());
        let (mut worst, mut banded) = (0.0f64, 0);
        for y in 0..SIZE[1] {
            for x in 0..SIZE[0] {
                let got = &drawn.picture[(y * SIZE[0] + x) as usize];
                let (rgb, depth, t, band) = reference_pixel(&sorted, x, y);
                let mut error =
                    (f64::from(got.transmittance) - t).abs().max((f64::from(got.depth) - depth).abs() / 12.0);
                for k in 0..3 {
                    error = error.max((f64::from(got.rgb[k]) - rgb[k]).abs());
                }
                if band {
                    banded += 1;
                    // Even there, no more than a contribution or two at the cut-off.
                    assert!(error < 4.0 / 255.0, "banded pixel {x},{y}: {error}");
                } else {
                    worst = worst.max(error);
                }
            }
        }
        println!("seed {seed}: worst {worst:.1e} outside the band, {banded} of {} pixels in it", SIZE[0] * SIZE[1]);
        assert!(worst <= 1.0 / 255.0 && banded < SIZE[0] * SIZE[1] / 50);
    }
}

fn cast(g: &Gaussian<f64>) -> Gaussian<f32> {
    Gaussian {
        mean: g.mean.map(|v| v as f32),
        log_scale: g.log_scale.map(|v| v as f32),
        rotation: g.rotation.map(|v| v as f32),
        opacity_logit: g.opacity_logit as f32,
        sh: g.sh.map(|c| c.map(|v| v as f32)),
    }
}

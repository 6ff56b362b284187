//! Promises of the ray-cast world.

use super::*;

/// Straight down, picture's up = north.
fn nadir(position: DVec3) -> PinholeView {
    let rotation = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z));
    PinholeView { width: 96, height: 72, fx: 80.0, fy: 82.0, cx: 48.0, cy: 36.0, position, rotation }
}

#[test]
fn pictures_and_depth_are_the_same_for_a_seed_whatever_the_threads() {
    let world = World::new(11, &WorldSettings::default());
    let view = nadir(DVec3::new(12.0, -30.0, 45.0));
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool").install(|| world.render(&view));
    let again = World::new(11, &WorldSettings::default()).render(&view);
    assert!(one.0 == again.0 && one.1 == again.1);
    let other = World::new(12, &WorldSettings::default()).render(&view);
    assert!(one.0 != other.0);
}

#[test]
fn depth_over_a_plane_is_analytic_for_any_tilt() {
    let world = World::new(1, &WorldSettings { relief_m: 0.0, density: 0.0, ..WorldSettings::default() });
    for tilt in [0.0, 0.2, -0.35, 0.6] {
        let mut view = nadir(DVec3::new(3.0, 4.0, 40.0));
        view.rotation *= DQuat::from_rotation_x(tilt) * DQuat::from_rotation_y(0.5 * tilt);
        let (_, depth) = world.render(&view);
        for (k, d) in depth.iter().enumerate() {
            let (x, y) = ((k % 96) as f64 + 0.5, (k / 96) as f64 + 0.5);
            let direction = view.rotation * DVec3::new((x - view.cx) / view.fx, (y - view.cy) / view.fy, 1.0);
            let exact = if direction.z < 0.0 { -40.0 / direction.z } else { 0.0 };
            assert!((f64::from(*d) - exact).abs() <= 1e-6 * exact, "{tilt} pixel {k}: {d} instead of {exact}");
        }
    }
}

#[test]
fn depth_carries_a_pixel_of_one_view_to_the_same_colour_in_another() {
    // Warping by the exact depth must explain most of a neighbouring view: the textures stick to the surfaces.
    let world = World::new(4, &WorldSettings::default());
    let (a, mut b) = (nadir(DVec3::new(0.0, 0.0, 45.0)), nadir(DVec3::new(3.0, 2.0, 47.0)));
    b.rotation *= DQuat::from_rotation_y(0.05);
    let ((pa, da), (pb, db)) = (world.render(&a), world.render(&b));
    let (mut close, mut seen) = (0, 0);
    for (k, d) in da.iter().enumerate() {
        let (x, y) = ((k % 96) as f64 + 0.5, (k / 96) as f64 + 0.5);
        let p = a.position + a.rotation * (DVec3::new((x - a.cx) / a.fx, (y - a.cy) / a.fy, 1.0) * f64::from(*d));
        let q = b.rotation.conjugate() * (p - b.position);
        let (u, v) = (b.fx * q.x / q.z + b.cx, b.fy * q.y / q.z + b.cy);
        if u < 1.0
            || v < 1.0
            || u >= 95.0
            || v >= 71.0
            || (f64::from(db[v as usize * 96 + u as usize]) - q.z).abs() > 0.3
        {
            continue;
        }
        seen += 1;
        let near = (-1..=1).any(|dv: i32| {
            (-1..=1).any(|du: i32| {
                let other = pb.get_pixel((u as i32 + du) as u32, (v as i32 + dv) as u32);
                pa.get_pixel((k % 96) as u32, (k / 96) as u32).0.iter().zip(other.0).all(|(s, t)| s.abs_diff(t) < 24)
            })
        });
        close += usize::from(near);
    }
    assert!(seen > 4_000 && close * 100 > seen * 90, "{close} of {seen} agree");
}

#[test]
fn every_part_of_the_ground_has_texture_to_match() {
    let world = World::new(9, &WorldSettings::default());
    let mut view = nadir(DVec3::new(-20.0, 35.0, 40.0));
    (view.width, view.height, view.fx, view.fy, view.cx, view.cy) = (320, 240, 250.0, 250.0, 160.0, 120.0);
    let (picture, _) = world.render(&view);
    let grey = |x: u32, y: u32| picture.get_pixel(x, y).0.iter().map(|v| f32::from(*v)).sum::<f32>() / 3.0;
    let mut flat = 0;
    for by in 0..15 {
        for bx in 0..20 {
            let values: Vec<f32> = (0..256).map(|k| grey(bx * 16 + k % 16, by * 16 + k / 16)).collect();
            let mean = values.iter().sum::<f32>() / 256.0;
            let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 256.0).sqrt();
            flat += usize::from(deviation < 3.0);
        }
    }
    assert!(flat < 9, "{flat} of 300 patches are flat");
}

#[test]
fn degenerate_views_give_empty_or_sky_pictures() {
    let world = World::new(2, &WorldSettings::default());
    let mut up = nadir(DVec3::new(0.0, 0.0, 50.0));
    up.rotation = DQuat::IDENTITY; // optical axis straight up
    let (picture, depth) = world.render(&up);
    assert!(depth.iter().all(|d| *d == 0.0) && picture.pixels().all(|p| p.0 == picture.get_pixel(0, 0).0));
    (up.width, up.height) = (0, 0);
    assert_eq!(world.render(&up).1.len(), 0);
    (up.width, up.height) = (1, 17);
    assert_eq!(world.render(&up).1.len(), 17);
}

use super::*;

fn sample(position: Vec3, color: f32) -> Sample {
    Sample { position, color: Vec3::splat(color), covariance: Mat3::IDENTITY * 1e-4, weight: 0.5, opacity: 0.9 }
}

fn push(merge: &mut VoxelMerge, sample: Sample) {
    merge.push_all(&[sample], |_| true);
}

#[test]
fn a_plane_becomes_flat_gaussians_within_the_budget() {
    let mut merge = VoxelMerge::new(0.2, Vec3::new(100.0, -50.0, 0.0), 100_000);
    for i in 0..200 {
        for j in 0..200 {
            push(&mut merge, sample(Vec3::new(100.0 + i as f32 * 0.1, -50.0 + j as f32 * 0.1, 3.0), 0.5));
        }
    }
    let out = merge.finish(1500, 1.0);
    assert!(out.len() <= 1500 && out.len() > 100, "{}", out.len());
    for g in &out {
        assert!((g.position.z - 3.0).abs() < 1e-4);
        assert!(g.covariance.z_axis.z < 2e-4 && g.covariance.x_axis.x > 1e-3, "{}", g.covariance);
    }
}

#[test]
fn the_budget_goes_where_the_colour_varies() {
    let mut merge = VoxelMerge::new(0.1, Vec3::ZERO, 100_000);
    for i in 0..200 {
        for j in 0..200 {
            let checker = ((i + j) % 2) as f32;
            let x = i as f32 * 0.1 - 10.0;
            push(
                &mut merge,
                sample(Vec3::new(x + 0.05, j as f32 * 0.1 + 0.05, 0.05), if x < 0.0 { 0.5 } else { checker }),
            );
        }
    }
    let out = merge.finish(21_000, 1.0);
    let left = out.iter().filter(|g| g.position.x < 0.0).count();
    assert!(left < 1000 && out.len() - left > 15_000, "{left} of {}", out.len());
}

#[test]
fn more_voxels_than_room_are_coarsened_and_nothing_is_lost() {
    let mut merge = VoxelMerge::new(0.01, Vec3::ZERO, 1000);
    for i in 0..20_000 {
        push(&mut merge, sample(Vec3::new(i as f32 * 0.01, 0.0, 0.0), 0.3));
    }
    push(&mut merge, sample(Vec3::NAN, 0.3));
    push(&mut merge, Sample { weight: 0.0, ..sample(Vec3::ZERO, 0.3) });
    assert!(merge.len() <= 1000 && merge.edge() > 0.1);
    assert_eq!(merge.dropped(), 2);
    let out = merge.finish(5000, 1.0);
    let (lo, hi) = out.iter().fold((f32::MAX, f32::MIN), |a, g| (a.0.min(g.position.x), a.1.max(g.position.x)));
    assert!(lo < 0.3 && hi > 199.5, "{lo} {hi}");
}

#[test]
fn merging_is_the_same_bit_for_bit_every_time() {
    let run = || {
        let mut merge = VoxelMerge::new(0.1, Vec3::ZERO, 5000);
        for i in 0..600_000u32 {
            let h = i.wrapping_mul(2_654_435_761);
            let p = Vec3::new((h & 0xff) as f32, (h >> 8 & 0xff) as f32, (h >> 16 & 0xff) as f32) * 0.03;
            push(&mut merge, sample(p, (h >> 24) as f32 / 255.0));
        }
        merge.finish(2000, 1.0).iter().map(|g| g.position.to_array().map(f32::to_bits)).collect::<Vec<_>>()
    };
    assert_eq!(run(), run());
}

#[test]
fn zero_budget_and_no_samples_give_nothing() {
    assert!(VoxelMerge::new(0.1, Vec3::ZERO, 10).finish(10, 1.0).is_empty());
    let mut merge = VoxelMerge::new(0.1, Vec3::ZERO, 10);
    push(&mut merge, sample(Vec3::ZERO, 0.1));
    assert!(merge.finish(0, 1.0).is_empty());
}

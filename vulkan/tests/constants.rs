//! `shaders/constants.glsl` and `src/constants.rs` hold the same numbers.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use vulkan::constants as c;

/// The numbers after `name =` in the GLSL, constructors of arrays left out.
fn glsl(name: &str) -> Vec<f32> {
    let text = include_str!("../shaders/constants.glsl");
    let line = text
        .lines()
        .find(|l| l.split([' ', '[']).any(|w| w == name))
        .unwrap_or_else(|| panic!("{name} is not in the GLSL"));
    let value = line.split(" = ").nth(1).unwrap().trim_end_matches(';');
    let value = value.split_once('(').map_or(value, |(_, inside)| inside.trim_end_matches(')'));
    value.split(',').map(|v| v.trim().parse().unwrap()).collect()
}

#[test]
fn shaders_and_references_share_every_constant() {
    let scalars = [
        ("LOW_PASS", c::LOW_PASS),
        ("ALPHA_MAX", c::ALPHA_MAX),
        ("ALPHA_MIN", c::ALPHA_MIN),
        ("TRANSMITTANCE_MIN", c::TRANSMITTANCE_MIN),
        ("FRUSTUM_MARGIN", c::FRUSTUM_MARGIN),
        ("SCALE_LIMIT", c::SCALE_LIMIT),
        ("COLOUR_MAX", c::COLOUR_MAX),
        ("SSIM_C1", c::SSIM_C1),
        ("SSIM_C2", c::SSIM_C2),
        ("PEARSON_EPSILON", c::PEARSON_EPSILON),
        ("STRIP", c::STRIP as f32),
        ("SHORT_PART", c::SHORT_PART as f32),
        ("TILE_WIDTH", c::TILE_WIDTH as f32),
        ("TILE_HEIGHT", c::TILE_HEIGHT as f32),
        ("RUN", c::RUN as f32),
        ("BLOCK_WIDTH", c::BLOCK[0] as f32),
        ("BLOCK_HEIGHT", c::BLOCK[1] as f32),
        ("SH_SMALL", c::SH_SMALL),
        ("SH_C0", c::SH_C0),
        ("SH_C1", c::SH_C1),
    ];
    for (name, value) in scalars {
        let got = glsl(name)[0];
        assert!((got - value).abs() <= 1e-6 * value.abs(), "{name}: {got} in GLSL, {value} in Rust");
    }
    for (name, values) in [("SSIM_WINDOW", &c::SSIM_WINDOW[..]), ("SH_C2", &c::SH_C2[..]), ("SH_C3", &c::SH_C3[..])] {
        for (a, b) in glsl(name).iter().zip(values) {
            assert!((a - b).abs() <= 1e-6 * b.abs(), "{name}: {a} in GLSL, {b} in Rust");
        }
        assert_eq!(glsl(name).len(), values.len(), "{name}");
    }
    assert_eq!(
        (u64::from(c::TILE_WIDTH), u64::from(c::TILE_HEIGHT)),
        (config::plan::TILE_WIDTH, config::plan::TILE_HEIGHT)
    );
}

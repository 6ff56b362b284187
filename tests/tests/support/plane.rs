//! A small data set with known truth: nadir photographs of textured, gently rolling ground, as a nerfstudio folder.

use std::path::Path;

use engine::evaluate::save_png;
use models::metrics::to_rgb8;

/// Picture size and focal length, pixels.
pub const SIZE: (u32, u32) = (192, 144);
const FOCAL: f64 = 144.0;
const HEIGHT: f64 = 50.0;

/// Writes `lines` × 5 pictures on a grid of 12 × 12 m into `folder`; every 8th is held out.
pub fn plane_dataset(folder: &Path, lines: usize) {
    std::fs::create_dir_all(folder.join("images")).expect("images");
    let mut frames = Vec::new();
    for i in 0..5 * lines {
        let center = [12.0 * (i % 5) as f64, 12.0 * (i / 5) as f64];
        let name = format!("images/{i:03}.png");
        let picture = to_rgb8(&photograph(center), SIZE.0, SIZE.1).expect("as many pixels as its size says");
        save_png(&picture, &folder.join(&name)).expect("picture");
        // Looking down, top of the picture to the north: the axes of OpenGL's camera are the world's.
        let matrix =
            [[1.0, 0.0, 0.0, center[0]], [0.0, 1.0, 0.0, center[1]], [0.0, 0.0, 1.0, HEIGHT], [0.0, 0.0, 0.0, 1.0]];
        frames.push(serde_json::json!({ "file_path": name, "transform_matrix": matrix }));
    }
    let set = serde_json::json!({
        "fl_x": FOCAL, "fl_y": FOCAL, "cx": f64::from(SIZE.0) / 2.0, "cy": f64::from(SIZE.1) / 2.0,
        "w": SIZE.0, "h": SIZE.1, "frames": frames,
    });
    std::fs::write(folder.join("transforms.json"), set.to_string()).expect("transforms.json");
}

/// Height of the ground, metres.
fn ground(x: f64, y: f64) -> f64 {
    2.0 * (x / 11.0).sin() + 1.5 * (y / 8.0).cos()
}

fn photograph(center: [f64; 2]) -> Vec<f32> {
    let mut rgb = Vec::with_capacity(3 * (SIZE.0 * SIZE.1) as usize);
    for v in 0..SIZE.1 {
        for u in 0..SIZE.0 {
            let ray = [
                (f64::from(u) + 0.5 - f64::from(SIZE.0) / 2.0) / FOCAL,
                (f64::from(SIZE.1) / 2.0 - f64::from(v) - 0.5) / FOCAL,
            ];
            let at = |depth: f64| [center[0] + ray[0] * depth, center[1] + ray[1] * depth];
            // The slopes are gentle: a few fixed-point turns find where the ray meets the ground.
            let depth = (0..12).fold(HEIGHT, |depth, _| HEIGHT - ground(at(depth)[0], at(depth)[1]));
            let [x, y] = at(depth);
            rgb.extend([texture(x, y), texture(y + 100.0, x), 0.35]);
        }
    }
    rgb
}

/// Cells of 1.7 and 4.1 m of pseudo-random grey.
fn texture(x: f64, y: f64) -> f32 {
    let cell = |size: f64| {
        let (i, j) = ((x / size).floor() as i64 as u64, (y / size).floor() as i64 as u64);
        (i.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ j.wrapping_mul(0xC2B2_AE3D_27D4_EB4F))
            .wrapping_mul(0x1656_67B1_9E37_79F9)
            >> 57
    };
    (cell(1.7) + cell(4.1)) as f32 / 255.0
}

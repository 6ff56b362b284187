//! Pictures larger than the device draws at once, drawn in tiles: each is the same camera with another principal point.

use models::camera::{Intrinsics, View};
use vulkan::trainer::{Rendering, Trainer};

use crate::error::EngineError;

/// Longest side drawn at once, pixels: what a renderer needs for 2048 x 2048 fits into a GiB.
const SIDE: u32 = 2048;
/// Pixels drawn around a tile and cut off again, so that Gaussians across its edge are flattened alike on both sides.
const BORDER: u32 = 64;

/// What a renderer must be able to draw at once for pictures of this size.
pub fn size((width, height): (u32, u32)) -> (u32, u32) {
    (width.min(SIDE), height.min(SIDE))
}

/// Draws `view`, in tiles where it is larger than [`size`] says.
///
/// # Errors
/// The device fails, or the camera cannot be drawn.
pub fn render(trainer: &mut Trainer, view: &View, into: &mut Rendering) -> Result<(), EngineError> {
    let whole = view.intrinsics;
    if whole.width <= SIDE && whole.height <= SIDE {
        return Ok(trainer.render(view, into)?);
    }
    let pixels = whole.pixels();
    (into.width, into.height) = (whole.width, whole.height);
    into.rgb.clear();
    into.rgb.resize(3 * pixels, 0.0);
    into.depth.clear();
    into.depth.resize(pixels, 0.0);
    into.transmittance.clear();
    into.transmittance.resize(pixels, 1.0);
    let mut tile = Rendering::default();
    for down in spans(whole.height) {
        for along in spans(whole.width) {
            let [left, top] = [along.drawn.0, down.drawn.0];
            let intrinsics = Intrinsics {
                width: along.drawn.1 - left,
                height: down.drawn.1 - top,
                cx: whole.cx - left as f32,
                cy: whole.cy - top as f32,
                ..whole
            };
            trainer.render(&View { intrinsics, pose: view.pose }, &mut tile)?;
            for y in down.kept.0..down.kept.1 {
                let from = ((y - top) * intrinsics.width + along.kept.0 - left) as usize;
                let to = y as usize * whole.width as usize + along.kept.0 as usize;
                let n = (along.kept.1 - along.kept.0) as usize;
                into.rgb[3 * to..3 * (to + n)].copy_from_slice(&tile.rgb[3 * from..3 * (from + n)]);
                into.depth[to..to + n].copy_from_slice(&tile.depth[from..from + n]);
                into.transmittance[to..to + n].copy_from_slice(&tile.transmittance[from..from + n]);
            }
        }
    }
    Ok(())
}

/// Pixels of a side that are drawn at once, and those of them that are kept: from the first to one past the last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Span {
    drawn: (u32, u32),
    kept: (u32, u32),
}

fn spans(side: u32) -> Vec<Span> {
    if side <= SIDE {
        return vec![Span { drawn: (0, side), kept: (0, side) }];
    }
    let n = side.div_ceil(SIDE - 2 * BORDER);
    let at = |i: u32| (u64::from(side) * u64::from(i) / u64::from(n)) as u32;
    let span = |i: u32| {
        let kept = (at(i), at(i + 1));
        Span { drawn: (kept.0.saturating_sub(BORDER), (kept.1 + BORDER).min(side)), kept }
    };
    (0..n).map(span).collect()
}

#[cfg(test)]
mod tests {
    use vulkan::gpu::Gpu;

    use super::*;
    use crate::carpet::{carpet, nadir};
    use crate::device::renderer;

    #[test]
    fn spans_keep_every_pixel_once_and_none_is_too_long() {
        for side in [1, 2048, 2049, 5472, 16_384] {
            let spans = spans(side);
            assert!(spans.iter().all(|s| s.drawn.1 - s.drawn.0 <= SIDE && s.drawn.0 <= s.kept.0), "{side}");
            assert_eq!((spans[0].kept.0, spans[spans.len() - 1].kept.1), (0, side));
            assert!(spans.windows(2).all(|w| w[0].kept.1 == w[1].kept.0));
        }
        assert_eq!((size((5472, 3648)), size((640, 480))), ((2048, 2048), (640, 480)));
    }

    #[test]
    fn a_picture_in_tiles_is_the_picture_in_one_piece() {
        if Gpu::list().is_err() {
            return println!("skipped: no Vulkan device (install mesa-vulkan-drivers)");
        }
        let cloud = carpet([0.0, 0.0], [40.0, 40.0], 0.5);
        let mut view = nadir(20.0, 20.0, 30.0);
        view.intrinsics = view.intrinsics.resized(2200, 64);
        let mut trainer = renderer(None, &cloud, 2200, 64).expect("a device");
        let (mut whole, mut tiled) = (Rendering::default(), Rendering::default());
        trainer.render(&view, &mut whole).expect("drawn");
        render(&mut trainer, &view, &mut tiled).expect("drawn");
        assert_eq!((tiled.width, tiled.height, tiled.rgb.len()), (2200, 64, whole.rgb.len()));
        let off = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off(&whole.rgb, &tiled.rgb) < 2e-3, "{}", off(&whole.rgb, &tiled.rgb));
        assert!(off(&whole.transmittance, &tiled.transmittance) < 2e-3);
        assert!(whole.rgb.iter().any(|v| *v > 0.1), "something is shown");
    }
}

//! Pictures turned by quarter turns before features are extracted. Survey lines are flown back and forth and
//! across; XFeat's descriptors bear some 30° of rotation, not 180°. Quarter turns cost no resampling.

use super::overlap::{Ground, predict};
use crate::camera::{Intrinsics, Pinhole};
use image::{RgbImage, imageops};
use std::borrow::Cow;

/// The picture as the network should see it: at most `side` pixels long and turned clockwise.
pub(crate) fn prepare(image: &RgbImage, side: u32, quarter_turns: u8) -> Cow<'_, RgbImage> {
    let longer = image.width().max(image.height());
    let small = match longer > side {
        true => {
            let shrink = |n: u32| ((u64::from(n) * u64::from(side)) / u64::from(longer)).max(1) as u32;
            Cow::Owned(imageops::thumbnail(image, shrink(image.width()), shrink(image.height())))
        }
        false => Cow::Borrowed(image),
    };
    match quarter_turns % 4 {
        1 => Cow::Owned(imageops::rotate90(small.as_ref())),
        2 => Cow::Owned(imageops::rotate180(small.as_ref())),
        3 => Cow::Owned(imageops::rotate270(small.as_ref())),
        _ => small,
    }
}

/// Key point in the prepared picture (of size `width` × `height`) → pixel of the original.
pub(crate) fn restore(p: [f32; 2], width: u32, height: u32, quarter_turns: u8, original: (u32, u32)) -> [f32; 2] {
    let (w, h) = (width as f32, height as f32);
    let ([x, y], (small_w, small_h)) = match quarter_turns % 4 {
        1 => ([p[1], w - p[0]], (h, w)),
        2 => ([w - p[0], h - p[1]], (w, h)),
        3 => ([h - p[1], p[0]], (h, w)),
        _ => (p, (w, h)),
    };
    [x * original.0 as f32 / small_w, y * original.1 as f32 / small_h]
}

/// Quarter turns that bring picture `b` into the direction of `a`, itself turned by `a_turns`.
pub(crate) fn turns_like(a: &Pinhole, a_turns: u8, b: &Pinhole, b_lens: &Intrinsics, ground: Ground) -> u8 {
    let (x, y) = (b_lens.width as f32 / 2.0, b_lens.height as f32 / 2.0);
    let across = match (predict(b, a, ground, [x - 1.0, y]), predict(b, a, ground, [x + 1.0, y])) {
        (Some(left), Some(right)) => right - left,
        _ => (a.pose.rotation.conjugate() * (b.pose.rotation * glam::DVec3::X)).truncate(),
    };
    let quarters = (across.y.atan2(across.x) / std::f64::consts::FRAC_PI_2).round() as i32;
    (i32::from(a_turns) + quarters).rem_euclid(4) as u8
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;
    use crate::camera::Pose;
    use glam::{DMat3, DQuat, DVec3};

    #[test]
    fn a_bright_pixel_is_found_again_through_every_turn() {
        let mut image = RgbImage::new(64, 48);
        image.put_pixel(10, 30, image::Rgb([255; 3]));
        for turns in 0..4 {
            let seen = prepare(&image, 640, turns);
            let at = seen.enumerate_pixels().find(|(_, _, p)| p.0[0] == 255).map(|(x, y, _)| (x, y)).unwrap();
            let p = [at.0 as f32 + 0.5, at.1 as f32 + 0.5];
            assert_eq!(restore(p, seen.width(), seen.height(), turns, (64, 48)), [10.5, 30.5], "{turns}");
        }
    }

    #[test]
    fn shrunk_pictures_give_key_points_of_the_original_size() {
        let image = RgbImage::new(1280, 960);
        let seen = prepare(&image, 640, 1);
        assert_eq!((seen.width(), seen.height()), (480, 640));
        assert_eq!(restore([480.0, 0.0], 480, 640, 1, (1280, 960)), [0.0, 0.0]);
    }

    #[test]
    fn opposite_and_crossing_headings_are_turned_alike() {
        let lens = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };
        let nadir = DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z);
        let camera = |heading_deg: f64| {
            let rotation = DQuat::from_rotation_z(-heading_deg.to_radians()) * DQuat::from_mat3(&nadir);
            Pinhole::new(Pose { rotation, center: DVec3::new(0.0, 0.0, 50.0) }, &lens, 1.0)
        };
        let north = camera(0.0);
        // Heading east (clockwise by 90°): what points right in it points down in the north-up picture.
        for (heading, expected) in [(0.0, 0), (80.0, 1), (100.0, 1), (180.0, 2), (270.0, 3)] {
            assert_eq!(turns_like(&north, 0, &camera(heading), &lens, Ground(Some(0.0))), expected, "{heading}");
        }
    }
}

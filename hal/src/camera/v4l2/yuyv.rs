//! YUYV (4:2:2, two bytes a pixel) to RGB: BT.601 in its limited range, what V4L2 means unless a driver says otherwise.

use image::RgbImage;

/// The picture of `size` in `bytes`, whose rows begin every `stride` bytes; `None` when they are too few.
pub(super) fn to_rgb(bytes: &[u8], (width, height): (u32, u32), stride: usize) -> Option<RgbImage> {
    let (row, rows) = (2 * width as usize, height as usize);
    // The last row need not be padded.
    let needed = stride.checked_mul(rows.checked_sub(1)?)?.checked_add(row)?;
    if width % 2 != 0 || stride < row || row == 0 || bytes.len() < needed {
        return None;
    }
    let mut image = RgbImage::new(width, height);
    for (from, to) in bytes.chunks(stride).zip(image.as_mut().chunks_exact_mut(3 * width as usize)) {
        for (pair, out) in from[..row].chunks_exact(4).zip(to.chunks_exact_mut(6)) {
            let &[y0, u, y1, v] = pair else { return None };
            out[..3].copy_from_slice(&rgb(y0, u, v));
            out[3..].copy_from_slice(&rgb(y1, u, v));
        }
    }
    Some(image)
}

/// In 8.8 fixed point, rounded.
fn rgb(y: u8, u: u8, v: u8) -> [u8; 3] {
    let (y, u, v) = (298 * (i32::from(y) - 16), i32::from(u) - 128, i32::from(v) - 128);
    [y + 409 * v, y - 100 * u - 208 * v, y + 516 * u].map(|c| ((c + 128) >> 8).clamp(0, 255) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_colours_of_a_test_card_come_back() {
        // BT.601's bars at full amplitude, as y, u, v.
        let bars = [
            ([16, 128, 128], [0, 0, 0]),
            ([235, 128, 128], [255, 255, 255]),
            ([82, 90, 240], [255, 0, 0]),
            ([145, 54, 34], [0, 255, 0]),
            ([41, 240, 110], [0, 0, 255]),
            ([126, 128, 128], [128, 128, 128]),
        ];
        for ([y, u, v], colour) in bars {
            let got = rgb(y, u, v);
            assert!(got.iter().zip(colour).all(|(&a, b)| a.abs_diff(b) <= 2), "{got:?} for {colour:?}");
        }
        assert_eq!((rgb(0, 128, 128), rgb(255, 128, 128)), ([0; 3], [255; 3]), "beyond the range");
    }

    #[test]
    fn two_pixels_share_their_colour_and_padded_rows_are_cut() {
        let stride = 10;
        let mut bytes = vec![77; 2 * stride];
        bytes[..8].copy_from_slice(&[16, 128, 235, 128, 82, 90, 82, 240]);
        bytes[stride..stride + 8].copy_from_slice(&[235, 128, 16, 128, 41, 240, 41, 110]);
        let image = to_rgb(&bytes, (4, 2), stride).expect("whole");
        assert_eq!((image.get_pixel(0, 0).0, image.get_pixel(1, 0).0), ([0; 3], [255; 3]));
        assert_eq!((image.get_pixel(0, 1).0, image.get_pixel(1, 1).0), ([255; 3], [0; 3]));
        assert_eq!(image.get_pixel(2, 0), image.get_pixel(3, 0));
        assert!(image.get_pixel(2, 0).0[0] > 250 && image.get_pixel(2, 1).0[2] > 250);
        assert_eq!(to_rgb(&bytes[..18], (4, 2), stride), Some(image), "the last row needs no padding");
    }

    #[test]
    fn too_few_bytes_and_impossible_rows_give_no_picture() {
        let bytes = [128; 64];
        assert!(to_rgb(&bytes[..15], (4, 2), 8).is_none());
        assert!(to_rgb(&bytes, (4, 2), 7).is_none());
        assert!(to_rgb(&bytes, (3, 2), 8).is_none());
        assert!(to_rgb(&bytes, (4, 0), 8).is_none());
        assert!(to_rgb(&bytes, (0, 2), 8).is_none());
        assert!(to_rgb(&bytes, (4, u32::MAX), usize::MAX).is_none());
    }
}

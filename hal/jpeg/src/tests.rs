#![allow(clippy::expect_used, reason = "a test fails by panicking")]

use std::io::Cursor;

use image::codecs::jpeg::JpegEncoder;
use image::{DynamicImage, ImageFormat, Rgb, RgbImage};

use super::*;

fn picture(width: u32, height: u32) -> DynamicImage {
    let noise = |x: u32, y: u32, k: u32| ((x * (7 + k)) ^ (y * (11 + 3 * k)) ^ (x * y * k)) as u8;
    DynamicImage::ImageRgb8(RgbImage::from_fn(width, height, |x, y| Rgb([0, 1, 2].map(|k| noise(x, y, k)))))
}

fn encoded(picture: &DynamicImage, quality: u8) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, quality)).expect("encoded");
    bytes.into_inner()
}

#[test]
fn pictures_of_any_size_quality_and_colour_are_whole() {
    for (width, height) in [(1, 1), (8, 8), (17, 9), (160, 120), (333, 111)] {
        for quality in [1, 50, 90, 100] {
            let color = picture(width, height);
            for picture in [color.clone(), DynamicImage::ImageLuma8(color.into_luma8())] {
                let jpeg = encoded(&picture, quality);
                assert_eq!(flaw(&jpeg), None, "{width} x {height}, {quality}");
                // What a camera writes behind the end, and fill before it.
                assert_eq!(flaw(&[&jpeg[..], &[0; 4096], b"notes"].concat()), None);
                assert_eq!(flaw(&[&jpeg[..jpeg.len() - 2], &[0xFF; 9], &[0xD9]].concat()), None);
            }
        }
    }
}

#[test]
fn a_picture_cut_anywhere_is_found_out_whatever_ends_it() {
    let jpeg = encoded(&picture(160, 120), 90);
    let scan = jpeg.windows(2).position(|w| w == [0xFF, 0xDA]).expect("a scan");
    for keep in (2..jpeg.len() - 64).step_by(97) {
        assert!(flaw(&jpeg[..keep]).is_some(), "{keep}");
        if keep > scan + 14 && jpeg[keep - 1] != 0xFF {
            let ended = [&jpeg[..keep], &[0xFF, 0xD9]].concat();
            assert!(matches!(flaw(&ended), Some(CUT | DAMAGED)), "{keep}: {:?}", flaw(&ended));
            // As a decoder has it, which notices nothing.
            let decoded = image::load_from_memory_with_format(&ended, ImageFormat::Jpeg);
            assert!(decoded.is_ok_and(|d| d.width() == 160), "{keep}");
        }
    }
}

/// 61 x 45 pixels in ten scans, colours at half the size, by libjpeg-turbo.
const PROGRESSIVE: &[u8] = include_bytes!("../data/progressive.jpg");

#[test]
fn a_progressive_picture_cut_anywhere_is_found_out_whatever_ends_it() {
    assert_eq!(flaw(PROGRESSIVE), None);
    let scans: Vec<usize> = (0..PROGRESSIVE.len()).filter(|at| PROGRESSIVE[*at..].starts_with(&[0xFF, 0xDA])).collect();
    assert_eq!(scans.len(), 10);
    for keep in scans[0] + 14..PROGRESSIVE.len() - 32 {
        let ended = [&PROGRESSIVE[..keep], &[0xFF, 0xD9]].concat();
        // Within a header the end marker is none.
        if PROGRESSIVE[keep - 1] != 0xFF {
            assert!(flaw(&ended).is_some(), "{keep}");
        }
    }
    // Between two scans everything is whole that is there.
    for scan in &scans[1..] {
        assert_eq!(flaw(&[&PROGRESSIVE[..*scan], &[0xFF, 0xD9]].concat()), Some(CUT), "{scan}");
    }
    let decoded = image::load_from_memory(&[&PROGRESSIVE[..scans[1]], &[0xFF, 0xD9]].concat());
    assert!(decoded.is_ok_and(|d| d.width() == 61), "a decoder notices nothing");
}

/// Each could take the time of a whole picture.
#[test]
fn a_picture_of_more_scans_than_encoders_write_is_refused() {
    let at = |from: usize| from + PROGRESSIVE[from..].windows(2).position(|w| w == [0xFF, 0xDA]).expect("a scan");
    let first = at(0);
    let second = at(first + 2);
    let repeated = |times: usize| {
        let all = vec![&PROGRESSIVE[first..second]; times].concat();
        [&PROGRESSIVE[..first], &all, &PROGRESSIVE[second..]].concat()
    };
    assert_eq!((flaw(&repeated(100)), flaw(&repeated(300))), (None, Some(DAMAGED)));
}

/// A header alone could claim a picture of any size.
#[test]
fn a_band_of_a_progressive_picture_before_its_means_is_refused() {
    let at =
        |marker: u8, from: usize| from + PROGRESSIVE[from..].windows(2).position(|w| w == [0xFF, marker]).expect("it");
    // The first scan is of the means of all components; behind it the tables of the next one begin.
    let first = at(0xDA, 0);
    let bands = [&PROGRESSIVE[..first], &PROGRESSIVE[at(0xC4, first)..]].concat();
    assert_eq!(flaw(&bands), Some(DAMAGED));
}

#[test]
fn a_hole_in_a_scan_is_found_out() {
    let jpeg = encoded(&picture(320, 240), 90);
    let (from, to) = (jpeg.len() / 2, 3 * jpeg.len() / 4);
    assert!(flaw(&[&jpeg[..from], &jpeg[to..]].concat()).is_some());
    // As a disk leaves it that lost a part: zeros are short codes, so that the picture is complete before its scan is.
    let zeros = vec![0; to - from];
    assert_eq!(flaw(&[&jpeg[..from], &zeros, &jpeg[to..]].concat()), Some(DAMAGED));
}

#[test]
fn tables_and_headers_that_are_none_end_in_time_and_find_no_fault_of_their_own() {
    for jpeg in [encoded(&picture(64, 48), 90), PROGRESSIVE.to_vec()] {
        for at in 2..jpeg.len() {
            for value in [0, 1, 0x7F, 0xFF] {
                let mut other = jpeg.clone();
                other[at] = value;
                // Whatever it says, it says it.
                let _ = flaw(&other);
            }
        }
    }
    assert_eq!((flaw(&[]), flaw(&[0xFF, 0xD8])), (Some(NO_END), Some(NO_END)));
}

/// As the pictures of a film are stored.
#[test]
fn a_picture_without_tables_is_not_looked_into() {
    let mut bare = encoded(&picture(160, 120), 90);
    while let Some(at) = bare.windows(2).position(|w| w == [0xFF, 0xC4]) {
        let length = usize::from(u16::from_be_bytes([bare[at + 2], bare[at + 3]]));
        bare.drain(at..at + 2 + length);
    }
    assert_eq!(flaw(&bare), None);
    assert_eq!(flaw(&bare[..bare.len() / 2]), Some(NO_END));
}

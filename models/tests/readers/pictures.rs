//! Pictures of forms that no other crate's readers meet: WebP, lossy and lossless, with what is written beside its pixels.

use models::picture::{self, webp};

use crate::driver::{Read, Reader, line, survive};

/// 16 × 12 pixels of lossy WebP with an EXIF of one tag and an XMP packet.
const LOSSY: &str = "524946468400000057454250565038580a0000000c0000000f00000b00005650382038000000f001009d012a10000c0004006825b002740110fe\
                     1dbad11000fef1840f359c0565e49d0da5f6b377b6e67ea4e7900f9dc407efaf4e820000455849461a0000004d4d002a000000080001011000\
                     02000000024100000000000000584d5020040000003c782f3e";
/// A picture that fades out.
const FADING: &str = "524946467400000057454250565038580a000000100000000f00000b0000414c50481f000000015f40266d1b12b0776944c49e889ecb88fe\
                      070402490afb2b0f101101d01600565038202e000000d001009d012a10000c0007409625b002747f0017f46eb800feda5ead3788a62af852ed3e\
                      83c9764bef301b800000";

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len() / 2).map(|i| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16).expect("two digits")).collect()
}

fn lossless() -> Vec<u8> {
    let pixels: Vec<u8> = (0..16 * 12).flat_map(|i| [16 * (i % 16) as u8, 20 * (i / 16) as u8, 90]).collect();
    let mut file = Vec::new();
    let encoder = image_webp::WebPEncoder::new(&mut file);
    encoder.encode(&pixels, 16, 12, image_webp::ColorType::Rgb8).expect("encoded");
    file
}

#[test]
fn pictures_of_webp() {
    survive(&Reader {
        name: "webp",
        seeds: vec![bytes(LOSSY), bytes(FADING), lossless()],
        text: false,
        shell: None,
        // A few bytes can declare the largest picture there may be.
        memory: ((2 << 20) + 12 * (models::camera::MAX_EDGE as usize).pow(2), 256),
        read: Read::File("a.webp", &|path| {
            let head = webp::head(path);
            let read =
                line(picture::decode(path), |image| image.width().max(image.height()) <= models::camera::MAX_EDGE);
            read.and_then(|usable| line(head, |_| usable))
        }),
    });
}

#[test]
fn a_webp_that_claims_to_be_wider_or_higher_than_a_picture_may_be_is_refused_before_it_gets_memory() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.webp");
    // Three bytes each: width and height of the canvas, less one.
    for (at, claimed) in [(24, [0x00, 0x00, 0xC0]), (27, [0xFF, 0xFF, 0x00]), (24, [0x00, 0x40, 0x00])] {
        let mut file = bytes(LOSSY);
        file[at..at + 3].copy_from_slice(&claimed);
        std::fs::write(&path, &file).expect("written");
        let (said, held) = crate::driver::memory::peak(|| picture::decode(&path).expect_err("refused").to_string());
        assert!(said.contains("a.webp: has ") && said.contains("at most 16384"), "{said}");
        assert!(held < 1 << 20, "{held} bytes for {claimed:?}");
    }
    std::fs::write(&path, bytes(LOSSY)).expect("written");
    assert_eq!(picture::decode(&path).expect("a picture").dimensions(), (16, 12));
}

//! What a TIFF declares, against what it can hold: decoders allocate for a tag before they read it, 32 bytes for each of its
//! numbers, so that a file of some hundred bytes could take hundreds of MiB.

use std::io::{BufReader, Read, Result, Seek, SeekFrom};
use std::path::Path;

/// Directories read; the first is the picture, others are previews and pyramids.
const DIRECTORIES: usize = 16;

/// Whether every tag of the file fits into it; true for what is no TIFF.
///
/// # Errors
/// The file cannot be read, or ends within a directory.
pub fn fits_its_tags(path: &Path) -> Result<bool> {
    let mut file = BufReader::new(disk::regular::open(path)?);
    let mut head = [0; 8];
    if file.read_exact(&mut head).is_err() {
        return Ok(true);
    }
    let little = match &head[..4] {
        b"II*\0" => true,
        b"MM\0*" => false,
        _ => return Ok(true),
    };
    let u16_of = |b: [u8; 2]| if little { u16::from_le_bytes(b) } else { u16::from_be_bytes(b) };
    let u32_of = |b: [u8; 4]| if little { u32::from_le_bytes(b) } else { u32::from_be_bytes(b) };
    let length = file.get_ref().metadata()?.len();
    let mut directory = u32_of([head[4], head[5], head[6], head[7]]);
    for _ in 0..DIRECTORIES {
        if directory == 0 {
            break;
        }
        file.seek(SeekFrom::Start(directory.into()))?;
        let mut entries = [0; 2];
        file.read_exact(&mut entries)?;
        for _ in 0..u16_of(entries) {
            let mut entry = [0; 12];
            file.read_exact(&mut entry)?;
            // TIFF 6.0, section 2: bytes of the types 1 to 12; 13 is an offset to another directory, 16 to 18 are BigTIFF's, which
            // decoders take here, too.
            let size = match u16_of([entry[2], entry[3]]) {
                3 | 8 => 2,
                4 | 9 | 11 | 13 => 4,
                5 | 10 | 12 | 16..=18 => 8,
                _ => 1,
            };
            if size * u64::from(u32_of([entry[4], entry[5], entry[6], entry[7]])) > length {
                return Ok(false);
            }
        }
        let mut next = [0; 4];
        file.read_exact(&mut next)?;
        directory = u32_of(next);
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tag_larger_than_its_file_is_found_in_either_byte_order_and_other_files_are_let_be() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        let fits = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            fits_its_tags(&path).ok()
        };
        let tiff = |count: u32| {
            let (entry, next) = ([0x11, 1, 4, 0], [0; 4]);
            [&b"II*\0"[..], &8u32.to_le_bytes(), &[1, 0], &entry, &count.to_le_bytes(), &[0; 4], &next].concat()
        };
        assert_eq!(
            (fits(&tiff(1)), fits(&tiff(100_000)), fits(&tiff(u32::MAX))),
            (Some(true), Some(false), Some(false))
        );
        let mut long = tiff(100);
        long[12] = 16;
        assert_eq!(fits(&long), Some(false), "eight bytes for each of a hundred");
        let big = [&b"MM\0*"[..], &[0, 0, 0, 8, 0, 1, 1, 0x11, 0, 4, 0, 9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]].concat();
        assert_eq!(fits(&big), Some(false));
        assert_eq!((fits(b"\xff\xd8\xff\xe0 a JPEG"), fits(b""), fits(&tiff(1)[..20])), (Some(true), Some(true), None));
        image::RgbImage::new(9, 7).save(&path).unwrap();
        assert!(fits_its_tags(&path).unwrap());
    }
}

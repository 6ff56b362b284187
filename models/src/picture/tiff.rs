//! What a TIFF declares, against what it can hold, and whether the JPEGs in it are whole. Decoders allocate for a tag before they read it,
//! 32 bytes for each of its numbers, so that a file of some hundred bytes could take hundreds of MiB.

use std::io::{BufReader, Read, Result, Seek, SeekFrom};
use std::path::Path;

use tiff::decoder::Decoder;
use tiff::tags::{CompressionMethod, Tag};

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

/// Bytes of the tables that all of its JPEGs have in common: eight of codes and four of steps take 3 kB.
const MOST_TABLES: usize = 1 << 14;

const BEYOND: &str = "its strips are larger than the file";
const NO_TABLES: &str = "its tables are larger than any";

/// What is missing of the JPEGs that a TIFF's picture is stored in (its supplement of 2002), of which decoders make grey; `None` where they
/// are whole, and for other files. What cannot be read here is refused when it is decoded.
///
/// # Errors
/// The file cannot be read.
pub fn flaw(path: &Path) -> Result<Option<&'static str>> {
    let mut file = disk::regular::open(path)?;
    let length = file.metadata()?.len();
    let Ok(mut tags) = Decoder::new(BufReader::new(file.try_clone()?)) else { return Ok(None) };
    let compression = tags.find_tag_unsigned(Tag::Compression).ok().flatten();
    if compression != Some(CompressionMethod::ModernJPEG.to_u16()) {
        return Ok(None);
    }
    let tables = tags.find_tag(Tag::JPEGTables).ok().flatten().and_then(|value| value.into_u8_vec().ok());
    let tables = tables.unwrap_or_default();
    if tables.len() > MOST_TABLES {
        return Ok(Some(NO_TABLES));
    }
    let tables = tables.strip_suffix(&[0xFF, 0xD9]).unwrap_or(&tables);
    let mut numbers = |tag: Tag| tags.find_tag_unsigned_vec::<u64>(tag).ok().flatten().unwrap_or_default();
    let strips = numbers(Tag::StripOffsets).into_iter().zip(numbers(Tag::StripByteCounts));
    let tiles = numbers(Tag::TileOffsets).into_iter().zip(numbers(Tag::TileByteCounts));
    let mut left = length;
    for (offset, count) in strips.chain(tiles) {
        // None of them is read twice, however many there are.
        let Some(rest) = left.checked_sub(count).filter(|_| offset <= length - count) else {
            return Ok(Some(BEYOND));
        };
        left = rest;
        let mut jpeg = vec![0; count as usize];
        file.seek(SeekFrom::Start(offset))?;
        file.read_exact(&mut jpeg)?;
        if !tables.is_empty() {
            jpeg = [tables, jpeg.get(2..).unwrap_or_default()].concat();
        }
        if let Some(flaw) = jpeg::flaw(&jpeg) {
            return Ok(Some(flaw));
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A TIFF whose picture is one JPEG, with its tables in a tag of their own or not.
    fn tiff_of(jpeg: &[u8], (width, height): (u16, u16), apart: bool) -> Vec<u8> {
        let is_table = |marker: u8| matches!(marker, 0xC4 | 0xDB);
        let (mut at, mut tables, mut strip) = (2, vec![0xFF, 0xD8], vec![0xFF, 0xD8]);
        while jpeg[at + 1] != 0xDA {
            let end = at + 2 + usize::from(u16::from_be_bytes([jpeg[at + 2], jpeg[at + 3]]));
            if apart && is_table(jpeg[at + 1]) { &mut tables } else { &mut strip }.extend(&jpeg[at..end]);
            at = end;
        }
        strip.extend(&jpeg[at..]);
        tables.extend([0xFF, 0xD9]);
        let tables_at = 8 + strip.len() as u32;
        let mut entries = vec![
            (256u16, 3u16, 1, u32::from(width)),
            (257, 3, 1, height.into()),
            (258, 3, 1, 8),
            (259, 3, 1, 7),
            (262, 3, 1, 1),
            (273, 4, 1, 8),
            (277, 3, 1, 1),
            (278, 3, 1, height.into()),
            (279, 4, 1, strip.len() as u32),
        ];
        if apart {
            entries.push((347, 7, tables.len() as u32, tables_at));
        }
        let mut file = [&b"II*\0"[..], &(tables_at + tables.len() as u32).to_le_bytes(), &strip, &tables].concat();
        file.extend((entries.len() as u16).to_le_bytes());
        for (tag, kind, count, value) in entries {
            let count: u32 = count;
            file.extend(
                [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), &value.to_le_bytes()].concat(),
            );
        }
        file.extend([0; 4]);
        file
    }

    #[test]
    fn a_jpeg_that_is_cut_within_a_tiff_is_found_out_in_its_strip() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        let noise = image::GrayImage::from_fn(96, 64, |x, y| image::Luma([(x * y * 7 + 31 * x) as u8]));
        let mut jpeg = std::io::Cursor::new(Vec::new());
        noise.write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        let jpeg = jpeg.into_inner();
        let cut = [&jpeg[..2 * jpeg.len() / 3], &[0xFF, 0xD9]].concat();
        for apart in [false, true] {
            let write = |jpeg: &[u8]| std::fs::write(&path, tiff_of(jpeg, (96, 64), apart)).unwrap();
            write(&jpeg);
            assert_eq!(flaw(&path).unwrap(), None, "{apart}");
            assert_eq!(crate::picture::decode(&path).unwrap().dimensions(), (96, 64), "{apart}");
            write(&cut);
            assert!(flaw(&path).unwrap().is_some_and(|flaw| flaw.contains("scan")), "{apart}");
            assert!(image::open(&path).is_ok(), "a decoder notices nothing: {apart}");
            for refused in [crate::picture::decode(&path).map(drop), crate::mask::Mask::read(&path).map(drop)] {
                assert!(refused.is_err_and(|e| e.to_string().contains("is cut off or damaged")), "{apart}");
            }
        }
        // What lies behind the end of the file is not read.
        let mut many = tiff_of(&jpeg, (96, 64), false);
        let at = many.len() - 4 - 12;
        many[at + 8..at + 12].copy_from_slice(&u32::MAX.to_le_bytes());
        std::fs::write(&path, &many).unwrap();
        assert_eq!(flaw(&path).unwrap(), Some(BEYOND));
    }

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

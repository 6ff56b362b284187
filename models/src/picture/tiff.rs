//! What a TIFF declares, against what it can hold, and whether the JPEGs in it are whole. Decoders allocate for a tag before they read it, 32 bytes for each of its
//! numbers, so that a file of some hundred bytes could take hundreds of MiB.

use std::fs::File;
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
            if size_of(u16_of([entry[2], entry[3]]).into())
                * u64::from(u32_of([entry[4], entry[5], entry[6], entry[7]]))
                > length
            {
                return Ok(false);
            }
        }
        let mut next = [0; 4];
        file.read_exact(&mut next)?;
        directory = u32_of(next);
    }
    Ok(true)
}

/// Tags of the picture (TIFF 6.0, and its supplement of 2002 on JPEG).
const COMPRESSION: u64 = 259;
const STRIPS: [u64; 2] = [273, 279];
const TILES: [u64; 2] = [324, 325];
const TABLES: u64 = 347;
/// The compression that is JPEG.
const JPEG: [u64; 1] = [7];

/// Bytes of the tables that all of its JPEGs have in common: eight of codes and four of steps take 3 kB.
const MOST_TABLES: usize = 1 << 14;

const BEYOND: &str = "its strips are larger than the file";
const NO_TABLES: &str = "its tables are larger than any";

/// What is missing of the JPEGs that a TIFF's picture is stored in, of which decoders make grey; `None` where they are whole, and for other
/// files.
///
/// # Errors
/// The file cannot be read, or ends within its directory.
pub fn flaw(path: &Path) -> Result<Option<&'static str>> {
    let mut file = BufReader::new(disk::regular::open(path)?);
    let length = file.get_ref().metadata()?.len();
    let Some(directory) = Directory::first(&mut file, length)? else { return Ok(None) };
    if directory.numbers(&mut file, COMPRESSION)? != JPEG {
        return Ok(None);
    }
    let tables = directory.bytes(&mut file, TABLES)?;
    if tables.len() > MOST_TABLES {
        return Ok(Some(NO_TABLES));
    }
    let tables = tables.strip_suffix(&[0xFF, 0xD9]).unwrap_or(&tables);
    let mut left = length;
    for [offsets, counts] in [STRIPS, TILES] {
        let (offsets, counts) = (directory.numbers(&mut file, offsets)?, directory.numbers(&mut file, counts)?);
        for (offset, count) in offsets.into_iter().zip(counts) {
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
    }
    Ok(None)
}

/// The tags of a picture. BigTIFF is no picture to the decoders in use.
struct Directory {
    little: bool,
    /// Tag, type, count, and the value or where it lies.
    entries: Vec<(u64, u64, u64, [u8; 4])>,
    length: u64,
}

impl Directory {
    /// The first one; `None` for what is no TIFF.
    fn first(file: &mut BufReader<File>, length: u64) -> Result<Option<Self>> {
        let mut head = [0; 8];
        if file.read_exact(&mut head).is_err() {
            return Ok(None);
        }
        let little = match &head[..4] {
            b"II*\0" => true,
            b"MM\0*" => false,
            _ => return Ok(None),
        };
        file.seek(SeekFrom::Start(number(little, &head[4..])))?;
        let mut count = [0; 2];
        file.read_exact(&mut count)?;
        let mut entries = Vec::new();
        for _ in 0..number(little, &count) {
            let mut entry = [0; 12];
            file.read_exact(&mut entry)?;
            let of = |from: usize, to: usize| number(little, &entry[from..to]);
            entries.push((of(0, 2), of(2, 4), of(4, 8), [entry[8], entry[9], entry[10], entry[11]]));
        }
        Ok(Some(Self { little, entries, length }))
    }

    /// The bytes of a tag's values; none where there is no such tag, or where it is larger than the file.
    fn bytes(&self, file: &mut BufReader<File>, tag: u64) -> Result<Vec<u8>> {
        let Some((_, kind, count, value)) = self.entries.iter().find(|e| e.0 == tag) else { return Ok(Vec::new()) };
        let Some(bytes) = count.checked_mul(size_of(*kind)).filter(|b| *b <= self.length) else {
            return Ok(Vec::new());
        };
        if bytes <= value.len() as u64 {
            return Ok(value[..bytes as usize].to_vec());
        }
        file.seek(SeekFrom::Start(number(self.little, value)))?;
        let mut there = vec![0; bytes as usize];
        file.read_exact(&mut there)?;
        Ok(there)
    }

    fn numbers(&self, file: &mut BufReader<File>, tag: u64) -> Result<Vec<u64>> {
        let kind = self.entries.iter().find(|e| e.0 == tag).map_or(1, |e| e.1);
        let bytes = self.bytes(file, tag)?;
        Ok(bytes.chunks_exact(size_of(kind) as usize).map(|one| number(self.little, one)).collect())
    }
}

fn number(little: bool, bytes: &[u8]) -> u64 {
    let join = |all: u64, byte: &u8| all << 8 | u64::from(*byte);
    if little { bytes.iter().rev().fold(0, join) } else { bytes.iter().fold(0, join) }
}

/// Bytes of the types 1 to 12 of TIFF 6.0, section 2; 13 is an offset to another directory, 16 to 18 are BigTIFF's, which decoders take in
/// others, too.
fn size_of(kind: u64) -> u64 {
    match kind {
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        5 | 10 | 12 | 16..=18 => 8,
        _ => 1,
    }
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

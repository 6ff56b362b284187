//! The head of a picture file: size, EXIF and XMP, without its pixels. JPEG segments are walked here, because EXIF readers
//! pass over XMP; everything in them is left to the crates that know it.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use exif::{Context, Exif, In, Reader, Tag, Value};
use image::ImageReader;

use models::formats::one_line;
use models::picture::values::Kind;
use models::picture::{tiff, webp};

/// Bytes read of segments before the pixels; makers put a few hundred KiB of previews there.
const MAX_HEAD: u64 = 32 << 20;
/// A JPEG that ends properly has its end marker in the last bytes; some cameras pad or append a little.
const TAIL: u64 = 64 << 10;
/// Largest TIFF whose tags are read: 16,384² pixels of four bytes.
const MAX_TIFF: u64 = 1 << 30;
/// XMP in a TIFF's own tag (Adobe, XMP specification part 3).
const TIFF_XMP: Tag = Tag(Context::Tiff, 700);
/// PNG keeps XMP in a text chunk with this keyword.
const PNG_XMP: &[u8] = b"XML:com.adobe.xmp";

/// What stands before the pixels.
pub(super) struct Head {
    /// Width and height as stored, before the orientation tag.
    pub size: (u32, u32),
    /// EXIF, when there is any that can be read.
    pub exif: Option<Exif>,
    /// The XMP packet.
    pub xmp: Option<String>,
    /// One value a pixel.
    pub is_grey: bool,
}

/// Reads the head of the picture at `path`.
///
/// # Errors
/// Why it is no picture that can be used, in a few words; the same words for the same reason.
pub(super) fn read(path: &Path) -> Result<Head, String> {
    let mut file = disk::regular::open(path).map_err(|e| format!("cannot be opened ({e})"))?;
    let len = file.metadata().map_err(|e| format!("cannot be read ({e})"))?.len();
    let mut magic = [0; 8];
    let read = file.read(&mut magic).map_err(|e| format!("cannot be read ({e})"))?;
    file.seek(SeekFrom::Start(0)).map_err(|e| format!("cannot be read ({e})"))?;
    match &magic[..read] {
        [] => Err("is empty".to_owned()),
        [0xFF, 0xD8, 0xFF, ..] => jpeg(file, len),
        [0x89, b'P', b'N', b'G', ..] | [b'I', b'I', 42, 0, ..] | [b'M', b'M', 0, 42, ..] => other(path, file),
        [b'R', b'I', b'F', b'F', ..] => webp(path),
        _ => Err("is no JPEG, PNG, TIFF or WebP whatever its name says".to_owned()),
    }
}

fn jpeg(mut file: File, len: u64) -> Result<Head, String> {
    const CUT: &str = "is cut off (copy it again)";
    let io = |e: std::io::Error| match e.kind() {
        std::io::ErrorKind::UnexpectedEof => CUT.to_owned(),
        _ => format!("cannot be read ({e})"),
    };
    let mut tail = vec![0; len.min(TAIL) as usize];
    file.seek(SeekFrom::Start(len - tail.len() as u64)).map_err(io)?;
    file.read_exact(&mut tail).map_err(io)?;
    let ends = tail.windows(2).any(|w| w == [0xFF, 0xD9]);
    file.seek(SeekFrom::Start(2)).map_err(io)?;
    let mut reader = BufReader::new(file);
    let (mut size, mut exif, mut xmp, mut at) = (None, None, None, 2u64);
    let mut is_grey = false;
    loop {
        let mut marker = [0; 2];
        reader.read_exact(&mut marker).map_err(io)?;
        // Fill bytes may stand before a marker.
        while marker == [0xFF, 0xFF] {
            reader.read_exact(&mut marker[1..]).map_err(io)?;
        }
        let [0xFF, kind] = marker else {
            return Err("is a damaged JPEG (a segment does not begin where it should)".into());
        };
        if kind == 0xDA || kind == 0xD9 {
            break;
        }
        if matches!(kind, 0x01 | 0xD0..=0xD7) {
            continue;
        }
        let mut length = [0; 2];
        reader.read_exact(&mut length).map_err(io)?;
        let length = u64::from(u16::from_be_bytes(length));
        at += 2 + length;
        if length < 2 || at > MAX_HEAD {
            return Err("is a damaged JPEG (a segment has an impossible length)".into());
        }
        let wanted = matches!(kind, 0xE1) || is_frame(kind);
        if !wanted {
            reader.seek_relative(length as i64 - 2).map_err(io)?;
            continue;
        }
        let mut body = vec![0; length as usize - 2];
        reader.read_exact(&mut body).map_err(io)?;
        if is_frame(kind) {
            let [bits, h0, h1, w0, w1, ..] = body[..] else {
                return Err("is a damaged JPEG (its frame header)".into());
            };
            if bits != 8 {
                return Err(format!("is a JPEG of {bits} bits, of which 8 are supported"));
            }
            size = Some((u32::from(u16::from_be_bytes([w0, w1])), u32::from(u16::from_be_bytes([h0, h1]))));
            is_grey = body.get(5) == Some(&1);
        } else if let Some(tiff) = body.strip_prefix(b"Exif\0\0") {
            exif = exif.or_else(|| parse(tiff.to_vec()));
        } else if let Some(packet) = body.strip_prefix(b"http://ns.adobe.com/xap/1.0/\0") {
            xmp = xmp.or_else(|| Some(String::from_utf8_lossy(packet).into_owned()));
        }
    }
    match size {
        Some((w, h)) if w > 0 && h > 0 => {
            // Panoramas, depth maps and films of a second stand behind the end in some cameras' files.
            if !ends && !ends_somewhere(&mut reader).map_err(io)? {
                return Err(CUT.to_owned());
            }
            Ok(Head { size: (w, h), exif, xmp, is_grey })
        }
        _ => Err("is a damaged JPEG (it has no size)".into()),
    }
}

/// Whether an end marker stands anywhere in the rest: in the pixels' own bytes 0xFF is followed by 0 or a restart.
fn ends_somewhere(reader: &mut impl Read) -> std::io::Result<bool> {
    let (mut block, mut last) = (vec![0; 1 << 16], 0u8);
    loop {
        let read = reader.read(&mut block)?;
        if read == 0 {
            return Ok(false);
        }
        let of = &block[..read];
        if (last == 0xFF && of[0] == 0xD9) || of.windows(2).any(|w| w == [0xFF, 0xD9]) {
            return Ok(true);
        }
        last = of[read - 1];
    }
}

/// Start of frame: 0xC0…0xCF without the tables that share the range.
fn is_frame(kind: u8) -> bool {
    matches!(kind, 0xC0..=0xCF) && !matches!(kind, 0xC4 | 0xC8 | 0xCC)
}

fn parse(mut tiff: Vec<u8>) -> Option<Exif> {
    long_pointers(&mut tiff);
    let mut reader = Reader::new();
    // One bad field must not cost the position.
    reader.continue_on_error(true);
    reader.read_raw(tiff).or_else(|e| e.distill_partial_result(|_| ())).ok()
}

/// Gives the pointers to the tables of EXIF and GPS the type LONG: TIFF's own type for them (13, "IFD", which Parrot writes) is not
/// known to the reader, and the same four bytes.
fn long_pointers(tiff: &mut [u8]) {
    const POINTERS: [u16; 3] = [0x8769, 0x8825, 0xA005];
    let little = tiff.starts_with(b"II");
    let at = |tiff: &[u8], from: usize| -> Option<[u8; 4]> { tiff.get(from..from.checked_add(4)?)?.try_into().ok() };
    let short = |tiff: &[u8], from: usize| -> Option<u16> {
        let pair = tiff.get(from..from.checked_add(2)?)?.try_into().ok()?;
        Some(if little { u16::from_le_bytes(pair) } else { u16::from_be_bytes(pair) })
    };
    let Some(offset) = at(tiff, 4) else { return };
    let table = if little { u32::from_le_bytes(offset) } else { u32::from_be_bytes(offset) } as usize;
    for entry in 0..usize::from(short(tiff, table).unwrap_or(0)) {
        let entry = table.saturating_add(2 + 12 * entry);
        let is_pointer = short(tiff, entry).is_some_and(|tag| POINTERS.contains(&tag));
        if is_pointer && short(tiff, entry.saturating_add(2)) == Some(13) {
            let long = if little { [4, 0] } else { [0, 4] };
            if let Some(kind) = tiff.get_mut(entry + 2..entry + 4) {
                kind.copy_from_slice(&long);
            }
        }
    }
}

fn other(path: &Path, file: File) -> Result<Head, String> {
    let bad = |e: &dyn std::fmt::Display| format!("cannot be read as a picture ({})", one_line(e));
    if !tiff::fits_its_tags(path).map_err(|e| bad(&e))? {
        return Err("is a damaged TIFF (a tag is larger than the file)".into());
    }
    let size = disk::regular::open(path)
        .and_then(|file| ImageReader::new(BufReader::new(file)).with_guessed_format())
        .map_err(|e| bad(&e))?
        .into_dimensions()
        .map_err(|e| bad(&e))?;
    let mut reader = BufReader::new(file);
    let mut container = Reader::new();
    container.continue_on_error(true);
    let exif = match magic(path) {
        // As the reader itself does, whole, yet with pointers that it knows.
        Some([b'I', b'I', ..] | [b'M', b'M', ..]) => {
            let mut bytes = Vec::new();
            let read = reader.take(MAX_TIFF).read_to_end(&mut bytes);
            read.ok().and_then(|_| parse(bytes))
        }
        _ => container.read_from_container(&mut reader).or_else(|e| e.distill_partial_result(|_| ())).ok(),
    };
    let tagged = exif.as_ref().and_then(|e| match &e.get_field(TIFF_XMP, In::PRIMARY)?.value {
        Value::Byte(bytes) | Value::Undefined(bytes, _) => Some(String::from_utf8_lossy(bytes).into_owned()),
        _ => None,
    });
    let xmp = tagged.or_else(|| png_text(path));
    let is_grey = Kind::of(path).is_ok_and(|kind| kind.is_grey);
    Ok(Head { size, exif, xmp, is_grey })
}

fn webp(path: &Path) -> Result<Head, String> {
    let head = webp::head(path).map_err(|e| e.what)?.ok_or("is no WebP whatever its name says")?;
    // Some writers put JPEG's own header before it.
    let exif = head.exif.and_then(|bytes| parse(bytes.strip_prefix(b"Exif\0\0").unwrap_or(&bytes).to_vec()));
    let xmp = head.xmp.map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    Ok(Head { size: head.size, exif, xmp, is_grey: false })
}

fn magic(path: &Path) -> Option<[u8; 4]> {
    let mut magic = [0; 4];
    disk::regular::open(path).ok()?.read_exact(&mut magic).ok()?;
    Some(magic)
}

/// The XMP of a PNG: an uncompressed `iTXt` chunk before the pixels.
fn png_text(path: &Path) -> Option<String> {
    let mut reader = BufReader::new(disk::regular::open(path).ok()?);
    let mut head = [0; 8];
    reader.read_exact(&mut head).ok()?;
    if !head.starts_with(&[0x89, b'P', b'N', b'G']) {
        return None;
    }
    loop {
        reader.read_exact(&mut head).ok()?;
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]);
        match &head[4..] {
            b"iTXt" if length < (1 << 20) => {
                let mut body = vec![0; length as usize];
                reader.read_exact(&mut body).ok()?;
                // Keyword, 0, compression flag and method, language, 0, translated keyword, 0, text.
                if let Some(rest) = body.strip_prefix(PNG_XMP) {
                    let text = rest.get(3..)?.splitn(3, |b| *b == 0).nth(2)?;
                    return Some(String::from_utf8_lossy(text).into_owned());
                }
                reader.seek_relative(4).ok()?;
            }
            b"IDAT" | b"IEND" => return None,
            _ => reader.seek_relative(i64::from(length) + 4).ok()?,
        }
    }
}

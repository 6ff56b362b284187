//! Where a JPEG ends: needed to know that a file is complete, and to cut a stream of them (MJPEG) into pictures. Walks the
//! segments instead of searching for end markers, because EXIF thumbnails contain some.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use disk::regular;

/// Largest picture of a stream; more without an end is garbage.
const MAX_PICTURE: usize = 32 << 20;

/// True when the file at `path` holds a JPEG or PNG to its end. Half-written files do not; what a camera writes behind the
/// end is not read.
///
/// # Errors
/// It cannot be read, or is no regular file.
pub fn is_complete(path: &Path) -> std::io::Result<bool> {
    let mut file = regular::open(path)?;
    let len = file.seek(SeekFrom::End(0))?;
    let mut head = [0; 2];
    file.seek(SeekFrom::Start(0))?;
    if len < 64 {
        return Ok(false);
    }
    file.read_exact(&mut head)?;
    let mut tail = [0; 32];
    file.seek(SeekFrom::Start(len - 32))?;
    file.read_exact(&mut tail)?;
    Ok(match head {
        // Some cameras pad after the end marker, some write a preview or notes there.
        [0xFF, 0xD8] => {
            let end = tail.iter().rposition(|b| *b != 0).unwrap_or(0);
            tail[..=end].ends_with(&[0xFF, 0xD9]) || has_end(file)?
        }
        [0x89, b'P'] => tail[20..].starts_with(&[0, 0, 0, 0]) && tail[24..28] == *b"IEND",
        _ => false,
    })
}

/// Walks the segments and scans of a JPEG; true when its end marker is met.
fn has_end(mut file: File) -> std::io::Result<bool> {
    file.seek(SeekFrom::Start(2))?;
    let mut file = BufReader::with_capacity(1 << 13, file);
    match walk(&mut file) {
        Err(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => Ok(false),
        walked => walked,
    }
}

/// As [`has_end`], from behind the start marker; a file that ends before is an error.
fn walk(file: &mut BufReader<File>) -> std::io::Result<bool> {
    let byte = |file: &mut BufReader<File>| {
        let mut one = [0];
        file.read_exact(&mut one).map(|()| one[0])
    };
    let mut in_scan = false;
    loop {
        if in_scan {
            // What was skipped is no marker: markers begin with FF.
            file.skip_until(0xFF)?;
        } else if byte(file)? != 0xFF {
            return Ok(false);
        }
        let mut marker = byte(file)?;
        while marker == 0xFF {
            marker = byte(file)?;
        }
        match marker {
            0xD9 => return Ok(true),
            0 | 0xD0..=0xD7 if in_scan => {}
            0x01 => {}
            0 | 0xD0..=0xD8 => return Ok(false),
            _ => {
                let length = i64::from(u16::from_be_bytes([byte(file)?, byte(file)?]));
                if length < 2 {
                    return Ok(false);
                }
                file.seek_relative(length - 2)?;
                in_scan = marker == 0xDA;
            }
        }
    }
}

/// Gives a picture the marker of motion JPEG. Many cameras leave the Huffman tables out of the pictures of a stream,
/// because they are always the standard's (ITU-T T.81, annex K.3); a decoder that sees the marker puts them where they are
/// missing. What is not a JPEG is returned as it is.
pub(super) fn marked_as_mjpeg(jpeg: &[u8]) -> Vec<u8> {
    const MARKER: &[u8] = b"\xFF\xE0\x00\x08AVI1\0\0";
    match jpeg.split_first_chunk::<2>() {
        Some((start @ [0xFF, 0xD8], rest)) => [start, MARKER, rest].concat(),
        _ => jpeg.to_vec(),
    }
}

/// What the splitter expects next.
#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    /// Before a picture.
    Between,
    /// At a marker, inside a picture.
    Marker,
    /// Entropy-coded data up to the next marker.
    Scan,
}

/// Cuts a byte stream into JPEGs.
pub struct JpegSplitter {
    buffer: Vec<u8>,
    position: usize,
    state: State,
    skipped: u64,
}

impl Default for JpegSplitter {
    fn default() -> Self {
        Self { buffer: Vec::new(), position: 0, state: State::Between, skipped: 0 }
    }
}

impl JpegSplitter {
    /// Adds bytes of the stream.
    pub fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    /// Bytes that belonged to no picture.
    pub fn skipped(&self) -> u64 {
        self.skipped
    }

    /// The next complete picture.
    pub fn next_jpeg(&mut self) -> Option<Vec<u8>> {
        loop {
            let rest = &self.buffer[self.position..];
            match self.state {
                State::Between => {
                    let start = rest.windows(3).position(|w| w == [0xFF, 0xD8, 0xFF]);
                    let drop = start.unwrap_or(rest.len().saturating_sub(2));
                    self.skip(drop);
                    start?;
                    self.position = 2;
                    self.state = State::Marker;
                }
                State::Marker => match *rest {
                    [0xFF, 0xFF, ..] => self.position += 1,
                    [0xFF, 0xD9, ..] => {
                        let tail = self.buffer.split_off(self.position + 2);
                        self.position = 0;
                        self.state = State::Between;
                        return Some(std::mem::replace(&mut self.buffer, tail));
                    }
                    [0xFF, 0xD8, ..] => self.give_up(), // a start inside: the first one was none
                    [0xFF, 0x01 | 0xD0..=0xD7, ..] => self.position += 2,
                    [0xFF, marker, high, low, ..] if u16::from_be_bytes([high, low]) >= 2 => {
                        let len = 2 + usize::from(u16::from_be_bytes([high, low]));
                        if rest.len() < len {
                            return self.wait();
                        }
                        self.position += len;
                        self.state = if marker == 0xDA { State::Scan } else { State::Marker };
                    }
                    [0xFF, _, _, _, ..] => self.give_up(),
                    [0xFF, ..] | [] => return self.wait(),
                    _ => self.give_up(),
                },
                State::Scan => match rest.windows(2).position(|w| w[0] == 0xFF && !matches!(w[1], 0 | 0xD0..=0xD7)) {
                    Some(marker) => {
                        self.position += marker;
                        self.state = State::Marker;
                    }
                    None => {
                        self.position += rest.len().saturating_sub(1);
                        return self.wait();
                    }
                },
            }
        }
    }

    /// Waits for more bytes, unless the picture is already larger than any can be.
    fn wait(&mut self) -> Option<Vec<u8>> {
        if self.buffer.len() > MAX_PICTURE {
            self.skip(self.buffer.len());
        }
        None
    }

    /// Not a JPEG after all: look for the next start after this one.
    fn give_up(&mut self) {
        self.skip(2);
    }

    fn skip(&mut self, bytes: usize) {
        self.buffer.drain(..bytes);
        self.skipped += bytes as u64;
        self.position = 0;
        self.state = State::Between;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn jpeg(shade: u8) -> Vec<u8> {
        let image = image::RgbImage::from_fn(40, 30, |x, y| image::Rgb([shade, (x * 6) as u8, (y * 8) as u8]));
        let mut bytes = std::io::Cursor::new(Vec::new());
        image.write_to(&mut bytes, image::ImageFormat::Jpeg).expect("encodes");
        bytes.into_inner()
    }

    #[test]
    fn a_stream_with_garbage_between_is_cut_into_its_pictures() {
        let pictures = [jpeg(10), jpeg(200), jpeg(90)];
        let mut stream = b"garbage\xFF\xD8".to_vec();
        for picture in &pictures {
            stream.extend_from_slice(picture);
            stream.extend_from_slice(b"--boundary\r\n");
        }
        let mut splitter = JpegSplitter::default();
        let mut found = Vec::new();
        for chunk in stream.chunks(7) {
            splitter.push(chunk);
            found.extend(std::iter::from_fn(|| splitter.next_jpeg()));
        }
        assert!(found == pictures, "{} pictures", found.len());
        assert!(splitter.skipped() > 20);
    }

    #[test]
    fn a_thumbnail_inside_does_not_end_the_picture() {
        let (outer, thumbnail) = (jpeg(1), jpeg(2));
        let mut picture = outer[..2].to_vec();
        picture.extend_from_slice(&[0xFF, 0xE1]);
        picture.extend_from_slice(&u16::try_from(thumbnail.len() + 2).expect("small").to_be_bytes());
        picture.extend_from_slice(&thumbnail);
        picture.extend_from_slice(&outer[2..]);
        let mut splitter = JpegSplitter::default();
        splitter.push(&picture);
        assert_eq!(splitter.next_jpeg(), Some(picture));
    }

    #[test]
    fn half_a_file_is_not_complete_at_any_length() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.jpg");
        let whole = jpeg(5);
        for len in (0..=whole.len()).step_by(13).chain([whole.len()]) {
            std::fs::write(&path, &whole[..len]).expect("written");
            assert_eq!(is_complete(&path).expect("read"), len == whole.len(), "{len}");
        }
    }

    #[test]
    fn what_a_camera_writes_behind_the_end_does_not_hide_a_picture() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.jpg");
        let (whole, notes) = (jpeg(5), [b"SEFT notes ".as_slice(); 9].concat());
        std::fs::write(&path, [whole.as_slice(), &notes].concat()).expect("written");
        assert!(is_complete(&path).expect("read"));
        for len in (0..whole.len()).step_by(7) {
            std::fs::write(&path, [&whole[..len], &[b'.'; 64]].concat()).expect("written");
            assert!(!is_complete(&path).expect("read"), "{len}");
        }
    }

    #[test]
    fn a_picture_of_a_stream_without_huffman_tables_is_decoded() {
        let photo = image::RgbImage::from_fn(16, 8, |x, y| image::Rgb([(x * 15) as u8, (y * 30) as u8, 90]));
        let mut jpeg = std::io::Cursor::new(Vec::new());
        photo.write_to(&mut jpeg, image::ImageFormat::Jpeg).expect("JPEG");
        let jpeg = jpeg.into_inner();
        let (mut bare, mut at) = (jpeg[..2].to_vec(), 2);
        while jpeg[at + 1] != 0xDA {
            let end = at + 2 + usize::from(u16::from_be_bytes([jpeg[at + 2], jpeg[at + 3]]));
            if jpeg[at + 1] != 0xC4 {
                bare.extend_from_slice(&jpeg[at..end]);
            }
            at = end;
        }
        bare.extend_from_slice(&jpeg[at..]);
        assert!(bare.len() + 300 < jpeg.len(), "the tables were there");
        let decode = |bytes: &[u8]| image::load_from_memory(&marked_as_mjpeg(bytes)).expect("decodes").into_rgb8();
        assert_eq!(decode(&bare), image::load_from_memory(&jpeg).expect("decodes").into_rgb8());
        assert_eq!(decode(&bare), decode(&jpeg));
    }
}

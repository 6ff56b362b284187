//! Whether a JPEG is whole (ITU-T T.81). Decoders fill what is missing of a picture with grey and say nothing.

mod scan;
mod table;

use scan::Frame;
use table::Table;

/// The marker is missing that ends a picture.
const NO_END: &str = "its end marker is missing";
/// The picture goes on where its data do not.
const CUT: &str = "its scan ends before the picture does";
const DAMAGED: &str = "its scan holds what no picture has";

/// What is missing or wrong: the end marker, or blocks of the picture. The scans of pictures with arithmetic coding are not checked,
/// which the decoders in use refuse, nor those of progressive pictures of more than 16,384 pixels a side. What lies behind the end marker
/// does not matter, nor do end markers of previews within a segment.
pub fn flaw(jpeg: &[u8]) -> Option<&'static str> {
    Walk::default().through(jpeg).err()
}

/// What the segments have said so far.
#[derive(Default)]
struct Walk {
    /// `None` before its header, and where its scans are not looked into.
    frame: Option<Frame>,
    dc: [Option<Table>; 4],
    ac: [Option<Table>; 4],
    /// Units between two restart markers; 0 without.
    restart: usize,
}

impl Walk {
    fn through(mut self, jpeg: &[u8]) -> Result<(), &'static str> {
        let mut at = 2;
        loop {
            // Fill bytes may stand before a marker.
            if jpeg.get(at) != Some(&0xFF) {
                return Err(NO_END);
            }
            let fill = jpeg[at..].iter().position(|b| *b != 0xFF).ok_or(NO_END)?;
            let marker = jpeg[at + fill];
            at += fill + 1;
            match marker {
                0xD9 => return if self.frame.is_none_or(|f| f.is_seen()) { Ok(()) } else { Err(CUT) },
                0x01 => continue,
                0 | 0xD0..=0xD8 => return Err(NO_END),
                _ => {}
            }
            let Some(&[high, low]) = jpeg.get(at..at + 2) else { return Err(NO_END) };
            let length = usize::from(u16::from_be_bytes([high, low]));
            let content = jpeg.get(at + 2..at + length).unwrap_or_default();
            at += length;
            match marker {
                0xC0..=0xC2 => self.frame = Frame::read(content, marker == 0xC2),
                0xC4 => self.tables(content),
                0xDD => self.restart = content.first_chunk().map_or(0, |n| u16::from_be_bytes(*n).into()),
                0xDA => at = self.scan(content, jpeg, at)?,
                _ => {}
            }
        }
    }

    fn tables(&mut self, mut content: &[u8]) {
        while let Some((table, kind, rest)) = Table::read(content) {
            let of = if kind >> 4 == 0 { &mut self.dc } else { &mut self.ac };
            if let Some(place) = of.get_mut(usize::from(kind & 15)) {
                *place = Some(table);
            }
            content = rest;
        }
    }

    /// Where the next marker is behind a scan.
    fn scan(&mut self, header: &[u8], jpeg: &[u8], from: usize) -> Result<usize, &'static str> {
        let data = jpeg.get(from..).ok_or(NO_END)?;
        let frame = self.frame.as_mut();
        let walked = frame.map_or(Ok(None), |f| f.walk(header, &self.dc, &self.ac, self.restart, data))?;
        if walked.is_none() {
            // Its tables are known to the decoder alone, as those of a film's pictures.
            self.frame = None;
        }
        let walked = walked.unwrap_or(0);
        let end = scan::end(&data[walked..]).ok_or(NO_END)?;
        if walked > 0 && scan::is_damaged(&data[walked..walked + end], walked) {
            return Err(DAMAGED);
        }
        Ok(from + walked + end)
    }
}

#[cfg(test)]
mod tests;

//! The camera definition file, by which QGroundControl and MAVSDK know what to show of the camera: made of the table of
//! parameters. Its version follows from its text, because QGroundControl keeps a file by maker, model and version.

use core::fmt::Write;

use heapless::Vec;

use super::parameters::{Kind, TABLE};

/// Room for the text; a test says how much of it is used.
const CAPACITY: usize = 4096;
/// Where the version stands until it is known.
const UNKNOWN: &str = "00000";
/// Maker and model, here and in CAMERA_INFORMATION.
pub(super) const VENDOR: &str = "dgtr";
pub(super) const MODEL: &str = "companion";

/// The file.
pub(super) struct Definition {
    text: Vec<u8, CAPACITY>,
    version: u16,
}

impl Definition {
    pub(super) fn new() -> Self {
        let mut text = Vec::new();
        // The text is always the same, and a test has seen it fit.
        let _ = write_text(&mut text);
        let crc = crc32(&text);
        // 0 would mean that the version is not known.
        let version = ((crc ^ (crc >> 16)) as u16).max(1);
        let mut digits = version;
        if let Some(at) = text.windows(UNKNOWN.len()).position(|bytes| bytes == UNKNOWN.as_bytes()) {
            for place in text[at..at + UNKNOWN.len()].iter_mut().rev() {
                *place = b'0' + (digits % 10) as u8;
                digits /= 10;
            }
        }
        Self { text, version }
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.text
    }

    pub(super) fn version(&self) -> u16 {
        self.version
    }
}

fn write_text(out: &mut Vec<u8, CAPACITY>) -> core::fmt::Result {
    writeln!(out, "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<mavlinkcamera>")?;
    writeln!(out, "<definition version=\"{UNKNOWN}\"><model>{MODEL}</model><vendor>{VENDOR}</vendor></definition>")?;
    writeln!(out, "<parameters>")?;
    for row in &TABLE {
        write!(out, "<parameter name=\"{}\"", row.name)?;
        match row.kind {
            // No step: QGroundControl would draw a slider over the whole range.
            Kind::Set(least, most, default) => {
                write!(out, " type=\"float\" default=\"{default}\" min=\"{least}\" max=\"{most}\" decimalPlaces=\"1\"")?
            }
            Kind::Count(most) => {
                write!(out, " type=\"uint32\" default=\"0\" min=\"0\" max=\"{most}\" readonly=\"1\"")?;
            }
            Kind::Word(_) => write!(out, " type=\"uint32\" default=\"0\" readonly=\"1\"")?,
        }
        if !row.unit.is_empty() {
            write!(out, " unit=\"{}\"", row.unit)?;
        }
        write!(out, "><description>{}</description>", row.label)?;
        if let Kind::Word(words) = row.kind {
            write!(out, "<options>")?;
            for (value, word) in words.iter().enumerate() {
                write!(out, "<option name=\"{word}\" value=\"{value}\"/>")?;
            }
            write!(out, "</options>")?;
        }
        writeln!(out, "</parameter>")?;
    }
    writeln!(out, "</parameters>\n</mavlinkcamera>")
}

/// CRC-32 as MAVLink FTP has it: the usual polynomial from 0, without the last inversion (PX4's `crc32part`).
pub(super) fn crc32(bytes: &[u8]) -> u32 {
    bytes.iter().fold(0, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_definition_fits_its_room_and_carries_its_version() {
        let definition = Definition::new();
        let text = core::str::from_utf8(definition.bytes()).expect("UTF-8");
        assert!(text.ends_with("</mavlinkcamera>\n"), "cut short at {} bytes: {text}", text.len());
        let version = std::format!("version=\"{:05}\"", definition.version());
        assert!(definition.version() > 0 && text.contains(&version), "{text}");
        assert_eq!(text.matches("<parameter ").count(), TABLE.len());
    }

    #[test]
    fn whole_numbers_fit_the_int_that_clients_read_them_into() {
        let definition = Definition::new();
        let text = core::str::from_utf8(definition.bytes()).expect("UTF-8");
        let whole: std::vec::Vec<&str> = text
            .split("<parameter ")
            .filter(|parameter| parameter.contains("type=\"uint32\""))
            .flat_map(|parameter| parameter.split('"'))
            .filter(|value| value.parse::<f64>().is_ok())
            .collect();
        assert!(whole.len() > 20 && whole.iter().all(|value| value.parse::<i32>().is_ok()), "{whole:?}");
    }

    #[test]
    fn the_checksum_is_px4s() {
        // Of "123456789" from 0 and without inversion; the inverted one from all ones is 0xCBF43926.
        assert_eq!(crc32(b"123456789"), 0x2DFD_2D88);
    }
}

//! Writes into a JPEG what a camera writes: EXIF and XMP. For simulated cards and for tests.

use std::io::Cursor;

use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};
use geometry::geodesy::Geodetic;

/// Largest payload of a JPEG segment.
const SEGMENT: usize = 65_533;

/// What a picture is to say; everything may be left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tags {
    /// `Make` and `Model`.
    pub camera: Option<(String, String)>,
    /// `DateTimeOriginal` with `SubSecTimeOriginal` in milliseconds, nanoseconds since 1970.
    pub time_ns: Option<u64>,
    /// GPS position; altitudes below zero get their reference.
    pub position: Option<Geodetic>,
    /// `GPSDOP`.
    pub dop: Option<f64>,
    /// `GPSTrack`, degrees.
    pub track_deg: Option<f64>,
    /// `Orientation`.
    pub orientation: Option<u16>,
    /// `FocalLengthIn35mmFilm`.
    pub focal_35mm: Option<u16>,
    /// XMP attributes: namespace, name, value.
    pub xmp: Vec<(String, String, String)>,
}

/// DJI's XMP namespace.
pub const DJI: &str = "http://www.dji.com/drone-dji/1.0/";
/// Pix4D's.
pub const PIX4D: &str = "http://pix4d.com/camera/1.0/";

impl Tags {
    /// Adds gimbal angles (yaw, pitch, roll) and the height above take-off as DJI writes them.
    pub fn with_dji(mut self, ypr_deg: [f64; 3], relative_alt_m: f64) -> Self {
        let [y, p, r] = ypr_deg.map(|a| format!("{a:+.2}"));
        let named = [("GimbalYawDegree", y), ("GimbalPitchDegree", p), ("GimbalRollDegree", r)];
        self.xmp.extend(named.map(|(name, value)| (DJI.to_owned(), name.to_owned(), value)));
        self.xmp.push((DJI.to_owned(), "RelativeAltitude".to_owned(), format!("{relative_alt_m:+.2}")));
        self
    }

    /// EXIF as it stands in a file: a TIFF directory.
    ///
    /// # Errors
    /// A value cannot be written.
    pub fn exif(&self) -> Result<Vec<u8>, exif::Error> {
        let mut fields: Vec<Field> = Vec::new();
        let mut put = |tag, value| fields.push(Field { tag, ifd_num: In::PRIMARY, value });
        let ascii = |s: &str| Value::Ascii(vec![s.as_bytes().to_vec()]);
        let rational = |v: f64, denom: u32| Rational { num: (v.abs() * f64::from(denom)).round() as u32, denom };
        let one = |v: f64, denom| Value::Rational(vec![rational(v, denom)]);
        let degrees = |v: f64| {
            let (minutes, v) = ((v.abs() % 1.0) * 60.0, v.abs());
            let seconds = (minutes % 1.0) * 60.0;
            Value::Rational(vec![rational(v.floor(), 1), rational(minutes.floor(), 1), rational(seconds, 1_000_000)])
        };
        if let Some((make, model)) = &self.camera {
            put(Tag::Make, ascii(make));
            put(Tag::Model, ascii(model));
        }
        if let Some(time) = self.time_ns {
            put(Tag::DateTimeOriginal, ascii(&date_time(time / 1_000_000_000)));
            put(Tag::SubSecTimeOriginal, ascii(&format!("{:03}", time / 1_000_000 % 1000)));
        }
        if let Some(tag) = self.orientation {
            put(Tag::Orientation, Value::Short(vec![tag]));
        }
        if let Some(mm) = self.focal_35mm {
            put(Tag::FocalLengthIn35mmFilm, Value::Short(vec![mm]));
        }
        if let Some(p) = self.position {
            put(Tag::GPSLatitudeRef, ascii(if p.lat_deg < 0.0 { "S" } else { "N" }));
            put(Tag::GPSLatitude, degrees(p.lat_deg));
            put(Tag::GPSLongitudeRef, ascii(if p.lon_deg < 0.0 { "W" } else { "E" }));
            put(Tag::GPSLongitude, degrees(p.lon_deg));
            put(Tag::GPSAltitudeRef, Value::Byte(vec![u8::from(p.alt_m < 0.0)]));
            put(Tag::GPSAltitude, one(p.alt_m, 1000));
        }
        if let Some(dop) = self.dop {
            put(Tag::GPSDOP, one(dop, 100));
        }
        if let Some(track) = self.track_deg {
            put(Tag::GPSTrackRef, ascii("T"));
            put(Tag::GPSTrack, one(track.rem_euclid(360.0), 100));
        }
        let mut writer = Writer::new();
        fields.iter().for_each(|f| writer.push_field(f));
        let mut bytes = Cursor::new(Vec::new());
        writer.write(&mut bytes, true)?;
        Ok(bytes.into_inner())
    }

    /// The XMP packet.
    pub fn packet(&self) -> String {
        let mut namespaces: Vec<&str> = self.xmp.iter().map(|a| a.0.as_str()).collect();
        namespaces.dedup();
        let declared: String = namespaces.iter().enumerate().map(|(i, n)| format!(" xmlns:n{i}=\"{n}\"")).collect();
        let attributes: String = self
            .xmp
            .iter()
            .map(|(namespace, name, value)| {
                let i = namespaces.iter().position(|n| n == namespace).unwrap_or(0);
                format!(" n{i}:{name}=\"{value}\"")
            })
            .collect();
        format!(
            "<x:xmpmeta xmlns:x=\"adobe:ns:meta/\"><rdf:RDF xmlns:rdf=\"http://www.w3.org/1999/02/22-rdf-syntax-ns#\">\
             <rdf:Description rdf:about=\"\"{declared}{attributes}/></rdf:RDF></x:xmpmeta>"
        )
    }

    /// Returns this JPEG with these tags.
    ///
    /// # Errors
    /// A value cannot be written, or `jpeg` is no JPEG.
    pub fn into_jpeg(&self, jpeg: &[u8]) -> Result<Vec<u8>, exif::Error> {
        let Some(rest) = jpeg.strip_prefix(&[0xFF, 0xD8]) else { return Err(exif::Error::InvalidFormat("no JPEG")) };
        let mut out = Vec::with_capacity(jpeg.len() + 4096);
        out.extend_from_slice(&[0xFF, 0xD8]);
        let mut segment = |name: &[u8], body: &[u8]| -> Result<(), exif::Error> {
            let len = name.len() + body.len();
            if len > SEGMENT {
                return Err(exif::Error::TooBig("tags do not fit a JPEG segment"));
            }
            out.extend_from_slice(&[0xFF, 0xE1]);
            out.extend_from_slice(&(len as u16 + 2).to_be_bytes());
            out.extend_from_slice(name);
            out.extend_from_slice(body);
            Ok(())
        };
        segment(b"Exif\0\0", &self.exif()?)?;
        if !self.xmp.is_empty() {
            segment(b"http://ns.adobe.com/xap/1.0/\0", self.packet().as_bytes())?;
        }
        out.extend_from_slice(rest);
        Ok(out)
    }
}

/// EXIF's `YYYY:MM:DD hh:mm:ss` of seconds since 1970 (Howard Hinnant's civil calendar).
fn date_time(seconds: u64) -> String {
    let (days, time) = (seconds / 86_400 + 719_468, seconds % 86_400);
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let (d, m) = (day - (153 * month + 2) / 5 + 1, if month < 10 { month + 3 } else { month - 9 });
    let y = year + era * 400 + u64::from(m <= 2);
    format!("{y:04}:{m:02}:{d:02} {:02}:{:02}:{:02}", time / 3600, time / 60 % 60, time % 60)
}

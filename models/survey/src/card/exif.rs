//! The EXIF fields that say something about where a picture was taken and through which lens.

use exif::{Context, DateTime, Exif, In, Tag, Value};
use geometry::geodesy::Geodetic;

use models::picture::Orientation;

/// EXIF 2.31's horizontal error, which the crate has no name for in older versions.
const H_POSITIONING_ERROR: Tag = Tag(Context::Gps, 31);

/// Fields as numbers, `None` where missing or senseless.
pub(super) struct Fields<'e>(pub(super) &'e Exif);

impl Fields<'_> {
    fn value(&self, tag: Tag) -> Option<&Value> {
        self.0.get_field(tag, In::PRIMARY).map(|f| &f.value)
    }

    /// A finite number.
    pub(super) fn number(&self, tag: Tag) -> Option<f64> {
        let value = match self.value(tag)? {
            Value::Rational(v) => v.first()?.to_f64(),
            Value::SRational(v) => v.first()?.to_f64(),
            Value::Float(v) => f64::from(*v.first()?),
            Value::Double(v) => *v.first()?,
            other => f64::from(other.get_uint(0)?),
        };
        value.is_finite().then_some(value)
    }

    /// A number above zero.
    pub(super) fn positive(&self, tag: Tag) -> Option<f64> {
        self.number(tag).filter(|v| *v > 0.0)
    }

    /// The first line of a text, trimmed.
    pub(super) fn text(&self, tag: Tag) -> Option<String> {
        match self.value(tag)? {
            Value::Ascii(lines) => {
                let text = String::from_utf8_lossy(lines.first()?).trim_matches(['\0', ' ']).to_owned();
                (!text.is_empty()).then_some(text)
            }
            _ => None,
        }
    }

    /// The maker's own bytes.
    pub(super) fn maker_note(&self) -> Option<&[u8]> {
        match self.value(Tag::MakerNote)? {
            Value::Undefined(bytes, _) => Some(bytes),
            _ => None,
        }
    }

    fn degrees(&self, tag: Tag, reference: Tag, negative: char) -> Option<f64> {
        let parts: Vec<f64> = match self.value(tag)? {
            Value::Rational(v) => v.iter().map(exif::Rational::to_f64).collect(),
            // Some firmware writes the signed type, and with it the sign.
            Value::SRational(v) => v.iter().map(exif::SRational::to_f64).collect(),
            Value::Float(v) => v.iter().map(|v| f64::from(*v)).collect(),
            Value::Double(v) => v.clone(),
            _ => return None,
        };
        // Degrees alone, or with minutes, or with seconds.
        let part = |i: usize| parts.get(i).map_or(0.0, |v| v.abs());
        let degrees = part(0) + part(1) / 60.0 + part(2) / 3600.0;
        let below = parts.first()?.is_sign_negative() || parts.iter().any(|v| *v < 0.0);
        let negative = below || self.text(reference).is_some_and(|r| r.to_uppercase().starts_with(negative));
        degrees.is_finite().then_some(if negative { -degrees } else { degrees })
    }

    /// Latitude and longitude; 0/0 is what a receiver without a fix writes, and is none.
    pub(super) fn place(&self) -> Option<[f64; 2]> {
        let lat_deg = self.degrees(Tag::GPSLatitude, Tag::GPSLatitudeRef, 'S')?;
        let lon_deg = self.degrees(Tag::GPSLongitude, Tag::GPSLongitudeRef, 'W')?;
        let valid = Geodetic { lat_deg, lon_deg, alt_m: 0.0 }.is_valid() && (lat_deg, lon_deg) != (0.0, 0.0);
        valid.then_some([lat_deg, lon_deg])
    }

    /// Altitude.
    pub(super) fn altitude(&self) -> Option<f64> {
        let below = self.value(Tag::GPSAltitudeRef).and_then(|v| match v {
            Value::Byte(b) => b.first().copied(),
            other => other.get_uint(0).map(|n| n as u8),
        });
        let alt_m = self.number(Tag::GPSAltitude)?;
        // Some makers write a signed altitude as well as the reference.
        Some(if matches!(below, Some(1 | 3)) { -alt_m.abs() } else { alt_m })
    }

    /// Horizontal standard deviation, metres: the stated error, else 1.5 m per unit of dilution of precision.
    pub(super) fn horizontal_sigma_m(&self) -> Option<f64> {
        self.positive(H_POSITIONING_ERROR).or_else(|| Some(1.5 * self.positive(Tag::GPSDOP)?.clamp(1.0, 20.0)))
    }

    /// Course over ground, degrees clockwise from north.
    pub(super) fn track_deg(&self) -> Option<f64> {
        let moving = self.number(Tag::GPSSpeed).is_none_or(|v| v > 0.0);
        self.number(Tag::GPSTrack).filter(|_| moving)
    }

    /// Direction in which the camera looked, degrees clockwise from north.
    pub(super) fn image_direction_deg(&self) -> Option<f64> {
        self.number(Tag::GPSImgDirection)
    }

    /// The camera's clock at the exposure, nanoseconds since 1970 were it UTC, and its resolution.
    pub(super) fn time_ns(&self) -> Option<(u64, u64)> {
        let text = self.text(Tag::DateTimeOriginal).or_else(|| self.text(Tag::DateTime))?;
        let mut time = DateTime::from_ascii(text.as_bytes()).ok()?;
        let seconds = models::formats::telemetry::exif_time_ns(&text)?;
        let sub = self.text(Tag::SubSecTimeOriginal).or_else(|| self.text(Tag::SubSecTime));
        let digits = sub.as_ref().filter(|s| time.parse_subsec(s.as_bytes()).is_ok()).map(|s| s.len().min(9) as u32);
        Some((seconds + u64::from(time.nanosecond.unwrap_or(0)), 10u64.pow(9 - digits.unwrap_or(0))))
    }

    /// EXIF orientation.
    pub(super) fn orientation(&self) -> Orientation {
        self.value(Tag::Orientation).and_then(|v| v.get_uint(0)).map_or(Orientation::default(), Orientation::from_exif)
    }
}

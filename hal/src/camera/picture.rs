//! A picture as a camera hands it out: a file, a JPEG in memory or pixels; decoded only after a look at its header.

use std::io::{BufRead, BufReader, Cursor, Read, Seek};
use std::path::{Path, PathBuf};

use config::mission::CameraSettings;
use image::{ImageFormat, ImageReader, RgbImage};

use super::jpeg::marked_as_mjpeg;
use super::undistort::undistort;
use crate::error::HalError;
use disk::regular;

/// Pixels or where they are.
#[derive(Clone, Debug, PartialEq)]
pub enum Picture {
    /// A complete file.
    Path(PathBuf),
    /// A whole JPEG in memory, decoded when it is needed.
    Jpeg(Vec<u8>),
    /// Decoded pixels.
    Rgb(RgbImage),
}

impl Picture {
    /// The undistorted pixels of a picture taken with `lens`.
    ///
    /// # Errors
    /// As [`Picture::decode`].
    pub fn load(&self, lens: &CameraSettings) -> Result<RgbImage, HalError> {
        Ok(undistort(self.decode(lens)?, lens))
    }

    /// The pixels of a picture taken with `lens`, as they left the camera.
    ///
    /// # Errors
    /// [`HalError::Picture`] when it cannot be decoded or is not of the lens's size (checked before anything is
    /// allocated).
    pub fn decode(&self, lens: &CameraSettings) -> Result<RgbImage, HalError> {
        let image = match self {
            Self::Path(path) => {
                let wrong = |e| HalError::Picture { path: path.clone(), why: disk::told(&e).to_string() };
                decode(BufReader::new(regular::open(path).map_err(wrong)?), path, lens)?
            }
            Self::Jpeg(bytes) => decode(Cursor::new(marked_as_mjpeg(bytes)), &self.name(), lens)?,
            Self::Rgb(image) => image.clone(),
        };
        if image.dimensions() != (lens.width, lens.height) {
            return Err(wrong_size(&self.name(), image.dimensions(), lens));
        }
        Ok(image)
    }

    /// The camera's own file, as it is kept: bytes that [`Picture::decode`] reads again to the same pixels. Pixels that never
    /// were a file become a PNG.
    ///
    /// # Errors
    /// [`HalError::Picture`] when it is gone, unreadable or longer than `limit` bytes.
    pub fn to_file(&self, limit: u64) -> Result<Vec<u8>, HalError> {
        let wrong = |why: String| HalError::Picture { path: self.name(), why };
        let mut bytes = Vec::new();
        match self {
            Self::Path(path) => {
                let file = regular::open(path).map_err(|e| wrong(disk::told(&e).to_string()))?;
                file.take(limit.saturating_add(1))
                    .read_to_end(&mut bytes)
                    .map_err(|e| wrong(disk::told(&e).to_string()))?;
            }
            Self::Jpeg(jpeg) => bytes = marked_as_mjpeg(jpeg),
            Self::Rgb(image) => image
                .write_to(&mut Cursor::new(&mut bytes), image::ImageFormat::Png)
                .map_err(|e| wrong(e.to_string()))?,
        }
        match bytes.len() as u64 <= limit {
            true => Ok(bytes),
            false => Err(wrong(format!("more than {limit} bytes, what an uncompressed picture of the camera takes"))),
        }
    }

    /// The file name that [`Picture::to_file`] is kept under: the camera's own, or the trigger's number.
    pub fn file_name(&self, sequence: u32) -> String {
        match (self, self.name().file_name().and_then(|n| n.to_str())) {
            (Self::Path(path), Some(name)) if path.extension().is_some() => name.to_owned(),
            (Self::Rgb(_), _) => format!("frame_{sequence:06}.png"),
            _ => format!("frame_{sequence:06}.jpg"),
        }
    }

    /// File name, or a word for pixels without one.
    pub fn name(&self) -> PathBuf {
        match self {
            Self::Path(path) => path.clone(),
            Self::Jpeg(_) | Self::Rgb(_) => "of the camera program".into(),
        }
    }
}

fn wrong_size(path: &Path, (w, h): (u32, u32), lens: &CameraSettings) -> HalError {
    let why = format!("{w}×{h} pixels, the mission's camera has {}×{}", lens.width, lens.height);
    HalError::Picture { path: path.into(), why }
}

/// Bytes that a JPEG may have for each pixel, and beside them: metadata, previews, a film.
const PIXEL: u64 = 8;
const BESIDE: u64 = 64 << 20;

/// Decodes after a look at the header: a picture of another size is refused before it is allocated.
fn decode(mut from: impl BufRead + Seek, path: &Path, lens: &CameraSettings) -> Result<RgbImage, HalError> {
    // The decoders' messages may span lines.
    let wrong = |why: String| {
        let why = why.split_whitespace().collect::<Vec<_>>().join(" ");
        HalError::Picture { path: path.into(), why }
    };
    let header = ImageReader::new(&mut from).with_guessed_format().map_err(|e| wrong(e.to_string()))?;
    let size = header.into_dimensions().map_err(|e| wrong(e.to_string()))?;
    if size != (lens.width, lens.height) {
        return Err(wrong_size(path, size, lens));
    }
    from.rewind().map_err(|e| wrong(e.to_string()))?;
    let reader = ImageReader::new(from).with_guessed_format().map_err(|e| wrong(e.to_string()))?;
    let decoded = match reader.format() {
        // The decoder would make grey of what is missing.
        Some(ImageFormat::Jpeg) => {
            let limit = PIXEL * u64::from(size.0) * u64::from(size.1) + BESIDE;
            let mut bytes = Vec::new();
            let read = reader.into_inner().take(limit + 1).read_to_end(&mut bytes);
            if read.map_err(|e| wrong(e.to_string()))? as u64 > limit {
                return Err(wrong(format!("has more than the {limit} bytes that such a picture can have")));
            }
            if let Some(flaw) = jpeg::flaw(&bytes) {
                return Err(wrong(format!("is cut off or damaged ({flaw})")));
            }
            ImageReader::with_format(Cursor::new(bytes), ImageFormat::Jpeg).decode()
        }
        _ => reader.decode(),
    };
    Ok(decoded.map_err(|e| wrong(e.to_string()))?.into_rgb8())
}

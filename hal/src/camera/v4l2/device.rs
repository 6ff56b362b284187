//! The device itself: opened, set to a format of ours, and streamed from buffers that the driver shares with us.

use std::io;
use std::path::Path;
use std::time::Duration;

use moq_v4l::buffer::{Flags, Type};
use moq_v4l::io::mmap;
use moq_v4l::io::traits::CaptureStream;
use moq_v4l::video::Capture;
use moq_v4l::{Device, Format, FourCC};
use rustix::io::Errno;

use super::stream::{Stamp, Stream, video};
use super::yuyv;
use crate::camera::picture::Picture;
use crate::error::{ErrorKind, HalError};

/// Buffers the driver fills in turn.
const BUFFERS: u32 = 4;
/// A camera that gives nothing for this long is opened again.
const SILENCE: Duration = Duration::from_secs(5);

/// What is asked for, in this order: compressed pictures leave room on the bus for a higher rate.
const FORMATS: [&[u8; 4]; 2] = [b"MJPG", b"YUYV"];

struct Streaming {
    stream: mmap::Stream<'static>,
    format: Format,
}

/// Most bytes of a compressed picture that are believed: no photograph of this size is larger as a JPEG.
fn most_bytes((width, height): (u32, u32)) -> usize {
    width as usize * height as usize * 3 + (1 << 16)
}

/// A stream of pictures of `size`.
pub(super) fn open(path: &Path, size: (u32, u32)) -> Result<Box<dyn Stream>, HalError> {
    let device = Device::with_path(path).map_err(|e| on_opening(path, &e))?;
    let format = negotiate(path, &device, size)?;
    check_size(path, &format, size)?;
    let mut stream =
        mmap::Stream::with_buffers(&device, Type::VideoCapture, BUFFERS).map_err(|e| on_opening(path, &e))?;
    stream.set_timeout(SILENCE);
    Ok(Box::new(Streaming { stream, format }))
}

fn negotiate(path: &Path, device: &Device, (width, height): (u32, u32)) -> Result<Format, HalError> {
    let mut offered = Vec::new();
    for fourcc in FORMATS {
        // Drivers answer with what comes nearest to what they were asked for.
        let wanted = Format::new(width, height, FourCC::new(fourcc));
        let got = device.set_format(&wanted).map_err(|e| on_opening(path, &e))?;
        if got.fourcc == wanted.fourcc && (got.width, got.height) == (width, height) {
            return Ok(got);
        }
        offered.push(format!("{}×{} {}", got.width, got.height, got.fourcc));
    }
    let why = format!("gives {}, not {width}×{height} MJPG or YUYV as the mission's camera", offered.join(" or "));
    Err(video(path, ErrorKind::Invalid, why))
}

/// Before any buffer is asked for.
fn check_size(path: &Path, format: &Format, size: (u32, u32)) -> Result<(), HalError> {
    let most = 2 * most_bytes(size);
    if format.size as usize > most {
        let why = format!("its driver wants {} bytes for a picture, more than the {most} believed", format.size);
        return Err(video(path, ErrorKind::Invalid, why));
    }
    Ok(())
}

/// A failure before there was a picture.
fn on_opening(path: &Path, error: &io::Error) -> HalError {
    let (kind, why) = match Errno::from_io_error(error) {
        Some(Errno::NOENT | Errno::NODEV | Errno::NXIO | Errno::NOTDIR) => {
            (ErrorKind::Invalid, "no such device; `ls /dev/video*` shows those there are".into())
        }
        Some(Errno::BUSY) => (ErrorKind::Busy, "is used by another program".into()),
        Some(Errno::ACCESS | Errno::PERM) => {
            (ErrorKind::Invalid, "may not be opened; add the user to the group video".into())
        }
        Some(Errno::NOTTY | Errno::INVAL | Errno::ISDIR) => {
            (ErrorKind::Invalid, "is not a video device that captures".into())
        }
        _ => (ErrorKind::Device, error.to_string()),
    };
    video(path, kind, why)
}

impl Stream for Streaming {
    fn next(&mut self) -> io::Result<(&[u8], Stamp)> {
        let most = most_bytes((self.format.width, self.format.height));
        let (buffer, about) = CaptureStream::next(&mut self.stream)?;
        let used = (about.bytesused as usize).min(buffer.len()).min(most);
        let monotonic = about.flags & Flags::TIMESTAMP_MASK == Flags::TIMESTAMP_MONOTONIC;
        let time = (u64::try_from(about.timestamp.sec).ok(), u32::try_from(about.timestamp.usec).ok());
        let taken = match time {
            (Some(s), Some(us @ 0..1_000_000)) if monotonic => Some(Duration::new(s, us * 1000)),
            _ => None,
        };
        let damaged = about.flags.contains(Flags::ERROR) || used < about.bytesused as usize;
        Ok((&buffer[..used], Stamp { number: about.sequence, taken, damaged }))
    }

    fn picture(&self, bytes: &[u8]) -> Option<Picture> {
        if self.format.fourcc == FourCC::new(b"YUYV") {
            let size = (self.format.width, self.format.height);
            return yuyv::to_rgb(bytes, size, self.format.stride as usize).map(Picture::Rgb);
        }
        // Whether it is whole shows when it is decoded, and only few of a stream are.
        bytes.starts_with(&[0xFF, 0xD8]).then(|| Picture::Jpeg(bytes.to_vec()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;

    #[test]
    fn failures_of_opening_say_what_to_do() {
        let path = Path::new("/dev/video9");
        let told = |errno: Errno| {
            let e = on_opening(path, &io::Error::from(errno));
            (e.kind(), e.to_string())
        };
        for (errno, kind, part) in [
            (Errno::NOENT, ErrorKind::Invalid, "no such device"),
            (Errno::NODEV, ErrorKind::Invalid, "no such device"),
            (Errno::BUSY, ErrorKind::Busy, "used by another"),
            (Errno::ACCESS, ErrorKind::Invalid, "group video"),
            (Errno::NOTTY, ErrorKind::Invalid, "not a video device"),
            (Errno::NOMEM, ErrorKind::Device, "memory"),
        ] {
            let (got, text) = told(errno);
            assert_eq!(got, kind, "{text}");
            assert!(text.starts_with("camera /dev/video9: ") && text.contains(part), "{text}");
        }
    }

    #[test]
    fn a_driver_that_wants_huge_buffers_is_refused_before_they_are_asked_for() {
        let format = |size| Format { size, ..Format::new(640, 480, FourCC::new(b"MJPG")) };
        assert!(check_size(Path::new("/dev/video0"), &format(640 * 480 * 3), (640, 480)).is_ok());
        let e = check_size(Path::new("/dev/video0"), &format(u32::MAX), (640, 480)).expect_err("huge");
        assert_eq!(e.kind(), ErrorKind::Invalid);
        assert!(e.to_string().contains("4294967295"), "{e}");
    }
}

//! Pictures: a watched folder, a child process that writes video to a pipe, a video device of the kernel, and what is done to
//! a picture on ingest.

mod exif;
mod folder;
mod jpeg;
mod picture;
mod pipe;
mod restart;
mod undistort;
#[cfg(feature = "v4l2")]
mod v4l2;

use std::time::SystemTime;

use config::mission::{CameraSettings, CameraSource};

pub use exif::{ExifPose, exif_pose};
pub use folder::FolderCamera;
pub use jpeg::{JpegSplitter, is_complete};
pub use picture::Picture;
pub use pipe::PipeCamera;
pub use undistort::undistort;
#[cfg(feature = "v4l2")]
pub use v4l2::V4l2Camera;

#[cfg(not(feature = "v4l2"))]
use crate::error::ErrorKind;
use crate::error::HalError;
use crate::traits::{Camera, PictureClues};

/// Any of the cameras, or none.
pub enum AnyCamera {
    /// Pictures come as files.
    Folder(FolderCamera),
    /// Pictures come from a program.
    Pipe(PipeCamera),
    /// Pictures come from a video device.
    #[cfg(feature = "v4l2")]
    V4l2(V4l2Camera),
    /// No pictures: poses and triggers only.
    None,
}

impl AnyCamera {
    /// Opens the mission's source of pictures; those of a folder that were written after `since` count as new.
    ///
    /// # Errors
    /// [`HalError::Camera`] when the folder cannot be read or the program cannot be started; [`HalError::Video`] when the device
    /// is missing, busy or no camera of the lens's size, or when video devices were not built in.
    pub fn open(source: &CameraSource, lens: &CameraSettings, since: Option<SystemTime>) -> Result<Self, HalError> {
        Ok(match source {
            CameraSource::Folder(path) => Self::Folder(FolderCamera::open_since(path, since)?),
            CameraSource::Command(command) => Self::Pipe(PipeCamera::start(command, (lens.width, lens.height))?),
            #[cfg(feature = "v4l2")]
            CameraSource::V4l2(device) => Self::V4l2(V4l2Camera::open(device, (lens.width, lens.height))?),
            #[cfg(not(feature = "v4l2"))]
            CameraSource::V4l2(device) => {
                let why =
                    "built without v4l2; build with --features v4l2, or give camera = { command = [\"ffmpeg\", …] }";
                return Err(HalError::Video { device: device.clone(), kind: ErrorKind::Invalid, why: why.into() });
            }
        })
    }
}

impl Camera for AnyCamera {
    type Picture = Picture;
    type Error = HalError;

    fn next_picture(&mut self, now_ns: u64) -> Result<Option<(PictureClues, Picture)>, HalError> {
        match self {
            Self::Folder(camera) => camera.next_picture(now_ns),
            Self::Pipe(camera) => camera.next_picture(now_ns),
            #[cfg(feature = "v4l2")]
            Self::V4l2(camera) => camera.next_picture(now_ns),
            Self::None => Ok(None),
        }
    }

    fn is_continuous(&self) -> bool {
        match self {
            Self::Folder(_) | Self::None => false,
            Self::Pipe(camera) => camera.is_continuous(),
            #[cfg(feature = "v4l2")]
            Self::V4l2(camera) => camera.is_continuous(),
        }
    }

    fn is_missing(&self) -> bool {
        matches!(self, Self::Folder(camera) if camera.is_missing())
    }

    fn lost_pictures(&self) -> u64 {
        match self {
            Self::Folder(_) | Self::Pipe(_) | Self::None => 0,
            #[cfg(feature = "v4l2")]
            Self::V4l2(camera) => camera.lost_pictures(),
        }
    }
}

#[cfg(all(test, not(feature = "v4l2")))]
mod tests {
    use super::*;
    use crate::error::Error;

    #[test]
    fn a_video_device_is_refused_by_a_build_without_them_with_the_remedy() {
        let lens = CameraSettings::pinhole(4, 2, 4.0);
        let error = AnyCamera::open(&CameraSource::V4l2("/dev/video0".into()), &lens, None).err().expect("refused");
        assert!(error.to_string().starts_with("camera /dev/video0: built without v4l2"), "{error}");
        assert_eq!(error.kind(), ErrorKind::Invalid);
    }
}

//! Where pictures come from: an aircraft in flight, a folder. The engine asks for the next one; what it needs of a picture it
//! keeps, but for the detail that training pictures are too small to show: that it has cut out of an earlier one.

use std::time::Duration;

use image::RgbImage;
use models::camera::PosedImage;
use models::mask::Mask;
use survey::dataset::{Dataset, PoseSource};

use crate::error::EngineError;

/// Gives posed pictures one by one, in the order of capture.
pub trait PictureSource {
    /// The next picture if there is one within `patience`: undistorted, with its pose as captured.
    ///
    /// # Errors
    /// It cannot be read, or not be kept.
    fn next(&mut self, patience: Duration) -> Result<Option<PosedImage>, EngineError>;

    /// Pictures that could be taken without waiting.
    fn waiting(&self) -> usize;

    /// Whether pictures may come that are not waiting yet.
    fn is_open(&self) -> bool;

    /// Width and height of an earlier picture as the camera took it, where it is still there.
    fn size_of(&self, name: &str) -> Option<(u32, u32)>;

    /// An earlier picture decoded again, at `scale` of the camera's size, and its mask; `None` where it is not there any more.
    ///
    /// # Errors
    /// It is there and cannot be read.
    fn whole(&mut self, name: &str, scale: f64) -> Result<Option<(RgbImage, Option<Mask>)>, EngineError>;
}

/// The pictures of a data set, each decoded once.
pub struct Folder<'a> {
    set: &'a Dataset,
    /// Indices of those to come, the next one last.
    frames: Vec<usize>,
    scale: f64,
    poses: PoseSource,
    decoded: u64,
}

impl<'a> Folder<'a> {
    /// `frames` of `set` at `scale`.
    pub fn new(set: &'a Dataset, mut frames: Vec<usize>, scale: f64, poses: PoseSource) -> Self {
        frames.reverse();
        Self { set, frames, scale, poses, decoded: 0 }
    }

    fn index_of(&self, name: &str) -> Option<usize> {
        self.set.frames.iter().position(|frame| frame.name == name)
    }

    /// Pictures decoded so far.
    pub fn decoded(&self) -> u64 {
        self.decoded
    }
}

impl PictureSource for Folder<'_> {
    fn next(&mut self, _patience: Duration) -> Result<Option<PosedImage>, EngineError> {
        let Some(i) = self.frames.pop() else { return Ok(None) };
        self.decoded += 1;
        Ok(Some(self.set.load_posed(i, self.scale, self.poses)?))
    }

    fn waiting(&self) -> usize {
        self.frames.len()
    }

    fn is_open(&self) -> bool {
        false
    }

    fn size_of(&self, name: &str) -> Option<(u32, u32)> {
        let lens = &self.set.frames[self.index_of(name)?].view.intrinsics;
        Some((lens.width, lens.height))
    }

    fn whole(&mut self, name: &str, scale: f64) -> Result<Option<(RgbImage, Option<Mask>)>, EngineError> {
        let Some(i) = self.index_of(name) else { return Ok(None) };
        let PosedImage { image, mask, .. } = self.set.load_posed(i, scale, self.poses)?;
        Ok(Some((image, mask)))
    }
}

//! One key frame while it waits for, and after it got, its depth. Everything is kept at the network's size, u8 and
//! strided, so that memory is known from the number of pictures alone, and on long flights in a file.

use std::borrow::Cow;
use std::io;
use std::sync::Arc;

use image::RgbImage;

use crate::camera::{Projector, Unprojector, View};
use crate::frame_file::{AsBytes, FrameFile, Kept};
use crate::mask::Mask;

use super::stereo::Depths;

/// Depth of one picture on a grid of every `stride`-th pixel.
#[derive(Clone, Debug)]
pub struct DepthGrid {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pixels between samples.
    pub stride: usize,
    /// Along the optical axis, metres.
    pub depth: Vec<f32>,
    /// 0…1; 0 = no depth.
    pub confidence: Vec<f32>,
}

impl DepthGrid {
    /// Takes every `stride`-th pixel of full maps (centre of each block). Depths that are not positive and finite get
    /// confidence 0; returns how many had claimed more.
    pub fn sampled(width: usize, height: usize, stride: usize, depth: &[f32], confidence: &[f32]) -> (Self, usize) {
        let (w, h) = ((width / stride).max(1), (height / stride).max(1));
        let mut grid = Self {
            width: w,
            height: h,
            stride,
            depth: Vec::with_capacity(w * h),
            confidence: Vec::with_capacity(w * h),
        };
        let mut non_finite = 0;
        for j in 0..h {
            for i in 0..w {
                let at = (j * stride + stride / 2).min(height - 1) * width + (i * stride + stride / 2).min(width - 1);
                let (d, c) = (depth[at], confidence[at]);
                let usable = d.is_finite() && d > 0.0 && c.is_finite();
                non_finite += usize::from(!usable && c != 0.0);
                grid.depth.push(if usable { d } else { 0.0 });
                grid.confidence.push(if usable { c.clamp(0.0, 1.0) } else { 0.0 });
            }
        }
        (grid, non_finite)
    }

    /// Takes the depth of the cell that holds the centre of each block of `stride` pixels.
    pub fn of_cells((width, height): (usize, usize), stride: usize, cells: &Depths<'_>) -> Self {
        let (w, h) = ((width / stride).max(1), (height / stride).max(1));
        let rows = cells.depth.len() / cells.width.max(1);
        let at = |i: usize, j: usize| {
            let cell = |k: usize, most: usize| ((k * stride + stride / 2) / cells.cell).min(most - 1);
            cell(j, rows) * cells.width + cell(i, cells.width)
        };
        let places = || (0..h).flat_map(|j| (0..w).map(move |i| at(i, j)));
        let depth = places().map(|at| cells.depth[at]).collect();
        let confidence = places().map(|at| cells.confidence[at]).collect();
        Self { width: w, height: h, stride, depth, confidence }
    }

    /// Pixel position (of the network's picture) of a sample.
    pub fn pixel(&self, i: usize, j: usize) -> (f32, f32) {
        let half = (self.stride / 2) as f32 + 0.5;
        ((i * self.stride) as f32 + half, (j * self.stride) as f32 + half)
    }

    /// The sample whose block holds a pixel position.
    pub fn index_at(&self, x: f32, y: f32) -> Option<usize> {
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        // Whole numbers divide several times slower.
        let stride = self.stride as f32;
        let (i, j) = ((x / stride) as usize, (y / stride) as usize);
        (i < self.width && j < self.height).then(|| j * self.width + i)
    }
}

impl AsBytes for RgbImage {
    type Shape = (u32, u32);

    fn shape(&self) -> (u32, u32) {
        self.dimensions()
    }

    fn to_bytes(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(self.as_raw())
    }

    fn byte_count((width, height): (u32, u32)) -> usize {
        3 * width as usize * height as usize
    }

    fn from_bytes((width, height): (u32, u32), bytes: Vec<u8>) -> Self {
        Self::from_raw(width, height, bytes).unwrap_or_default()
    }
}

impl AsBytes for DepthGrid {
    /// Columns, rows, stride.
    type Shape = [usize; 3];

    fn shape(&self) -> [usize; 3] {
        [self.width, self.height, self.stride]
    }

    fn to_bytes(&self) -> Cow<'_, [u8]> {
        let [depth, confidence] = [&self.depth, &self.confidence].map(|v| bytemuck::cast_slice::<f32, u8>(v));
        Cow::Owned([depth, confidence].concat())
    }

    fn byte_count([width, height, _]: [usize; 3]) -> usize {
        8 * width * height
    }

    fn from_bytes([width, height, stride]: [usize; 3], bytes: Vec<u8>) -> Self {
        let [depth, confidence]: [Vec<f32>; 2] = {
            let (depth, confidence) = bytes.split_at(bytes.len() / 2);
            [depth, confidence].map(bytemuck::pod_collect_to_vec)
        };
        Self { width, height, stride, depth, confidence }
    }
}

/// One key frame.
#[derive(Debug)]
pub struct DepthFrame {
    /// Name of the picture.
    pub name: String,
    /// Its camera, intrinsics at the network's size.
    pub view: View,
    /// The source views that the depth was made from, as they were then.
    pub made_with: Vec<(usize, View)>,
    /// The reference view that the depth was made from.
    pub made_as: Option<View>,
    image: Kept<RgbImage>,
    /// Which of its pixels count, at the network's size.
    mask: Option<Mask>,
    /// The last depth, which is known no more when `has_depth` is false: a new one takes its place in the file.
    depth: Option<Kept<DepthGrid>>,
    has_depth: bool,
    file: Option<Arc<FrameFile>>,
}

impl DepthFrame {
    /// A picture at the network's size with its camera, without depth yet, kept in `file` where there is one.
    ///
    /// # Errors
    /// Writing to the file fails.
    pub fn new(name: String, image: RgbImage, view: View, file: Option<&Arc<FrameFile>>) -> io::Result<Self> {
        let image = Kept::new(image, file)?;
        Ok(Self {
            name,
            view,
            made_with: Vec::new(),
            made_as: None,
            image,
            mask: None,
            depth: None,
            has_depth: false,
            file: file.cloned(),
        })
    }

    /// With a mask at the network's size: what it leaves out has no depth.
    pub fn masked(self, mask: Option<Mask>) -> Self {
        Self { mask, ..self }
    }

    /// Which pixels count; `None`: all.
    pub fn mask(&self) -> Option<&Mask> {
        self.mask.as_ref()
    }

    /// Takes the confidence from the depths that the mask leaves out.
    pub fn leave_out(&self, depth: &mut DepthGrid) {
        let Some(mask) = &self.mask else { return };
        for at in 0..depth.confidence.len() {
            let (x, y) = depth.pixel(at % depth.width, at / depth.width);
            // The sample has the colour of its whole block.
            if !mask.keeps_around([f64::from(x), f64::from(y)], 0.5 * depth.stride as f64) {
                depth.confidence[at] = 0.0;
            }
        }
    }

    /// The picture at the network's size.
    ///
    /// # Errors
    /// Reading the file fails.
    pub fn image(&self) -> io::Result<Cow<'_, RgbImage>> {
        self.image.get()
    }

    /// Whether its depth is known.
    pub fn has_depth(&self) -> bool {
        self.has_depth
    }

    /// Its depth, once known.
    ///
    /// # Errors
    /// Reading the file fails.
    pub fn depth(&self) -> io::Result<Option<Cow<'_, DepthGrid>>> {
        self.depth.as_ref().filter(|_| self.has_depth).map(Kept::get).transpose()
    }

    /// Takes a new depth, or forgets the one there was.
    ///
    /// # Errors
    /// Writing to the file fails.
    pub fn set_depth(&mut self, depth: Option<DepthGrid>) -> io::Result<()> {
        self.has_depth = false;
        let Some(mut depth) = depth else { return Ok(()) };
        self.leave_out(&mut depth);
        match &mut self.depth {
            Some(old) => old.replace(depth)?,
            none => *none = Some(Kept::new(depth, self.file.as_ref())?),
        }
        self.has_depth = true;
        Ok(())
    }
}

/// Largest shift, in pixels, of the reference's corners and centre in the source between two pairs of poses.
pub fn shift(reference: &View, source: &View, old_reference: &View, old_source: &View, depth: f32) -> f32 {
    let (w, h) = (reference.intrinsics.width as f32, reference.intrinsics.height as f32);
    let (new, old) = (Projector::new(source), Projector::new(old_source));
    let (here, before) = (Unprojector::new(reference), Unprojector::new(old_reference));
    [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h), (w / 2.0, h / 2.0)]
        .into_iter()
        .map(|(x, y)| {
            let a = new.project(here.at(x, y, depth));
            let b = old.project(before.at(x, y, depth));
            match (a, b) {
                (Some(a), Some(b)) => (a.0 - b.0).hypot(a.1 - b.1),
                _ => f32::INFINITY,
            }
        })
        .fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};

    #[test]
    fn a_depth_that_is_forgotten_and_made_again_takes_no_more_of_the_file() {
        let file = tempfile::tempfile().unwrap();
        let intrinsics = Intrinsics { width: 8, height: 4, fx: 8.0, fy: 8.0, cx: 4.0, cy: 2.0 };
        let view = View { intrinsics, pose: Pose { rotation: glam::DQuat::IDENTITY, center: glam::DVec3::ZERO } };
        let image = RgbImage::from_fn(8, 4, |x, y| image::Rgb([x as u8, y as u8, 7]));
        let kept = FrameFile::new(file.try_clone().unwrap());
        let mut frame = DepthFrame::new("a".into(), image.clone(), view, Some(&kept)).unwrap();
        for depth in [1.0f32, 2.0, 3.0] {
            let grid = DepthGrid { width: 4, height: 2, stride: 2, depth: vec![depth; 8], confidence: vec![0.5; 8] };
            frame.set_depth(Some(grid)).unwrap();
            assert_eq!(frame.depth().unwrap().unwrap().depth, [depth; 8]);
            frame.set_depth(None).unwrap();
            assert!(!frame.has_depth() && frame.depth().unwrap().is_none());
        }
        assert_eq!(frame.image().unwrap().as_ref(), &image);
        assert_eq!(file.metadata().unwrap().len(), 3 * 32 + 8 * 8);
    }
}

//! Monocular depth by a network of contract `depth`, as the D_est of the depth loss. Pearson's correlation does not see
//! scale and offset, so relative depth is enough; inverse depth is given with its sign turned, its linear part.

use std::path::Path;
use std::sync::Arc;

use image::RgbImage;

use super::OnnxError;
use super::manifest::Contract;
use super::network::{LazySession, Network};
use super::picture::push_planes;
use crate::camera::DepthPrior;

/// An opened depth network.
#[derive(Debug)]
pub struct DepthNetwork {
    session: LazySession,
    max_side: u32,
    planes: Vec<f32>,
}

impl DepthNetwork {
    /// Reads the manifest and checks the network against it for pictures of `size`, whose longer side a network of any
    /// size is shown at `max_side` pixels at most.
    ///
    /// # Errors
    /// As [`LazySession::check`]; a file is missing or damaged, or the network follows another contract.
    pub fn open(path: &Path, size: (u32, u32), max_side: u32, threads: usize) -> Result<Self, OnnxError> {
        let network = Network::read_as(path, Contract::Depth)?;
        let mut session = LazySession::new(Arc::new(network), threads);
        session.check(fit(size, max_side))?;
        Ok(Self { session, max_side, planes: Vec::new() })
    }

    /// Name for reports.
    pub fn name(&self) -> &str {
        &self.session.manifest().name
    }

    /// Depth up to a positive factor and an offset, at the network's size. A picture of another shape is squeezed, as
    /// such networks' own preprocessing does; numbers that are not finite have confidence 0, all others 1.
    ///
    /// # Errors
    /// ONNX Runtime fails, or the output has another size than the input.
    pub fn estimate(&mut self, image: &RgbImage) -> Result<DepthPrior, OnnxError> {
        let fitted = fit(image.dimensions(), self.max_side);
        let manifest = self.session.manifest();
        let (width, height) = manifest.input_size(fitted.0, fitted.1);
        let sign = if manifest.depth.as_ref().is_some_and(|d| d.inverse) { -1.0 } else { 1.0 };
        self.planes.clear();
        push_planes(image, width, height, &manifest.input, &mut self.planes);
        let mut out = self.session.run((width, height), &[&self.planes])?;
        let out = out.swap_remove(0);
        let confidence = out.data.iter().map(|d| if d.is_finite() { 1.0 } else { 0.0 }).collect();
        let depth = out.data.iter().map(|d| sign * d).collect();
        Ok(DepthPrior { width, height, depth, confidence })
    }

    /// Gives the session's memory back; the next picture opens it again.
    pub fn close(&mut self) {
        self.session.close();
    }
}

fn fit((width, height): (u32, u32), max_side: u32) -> (u32, u32) {
    let shrink = (f64::from(max_side) / f64::from(width.max(height).max(1))).min(1.0);
    let side = |s: u32| ((f64::from(s) * shrink).round() as u32).max(1);
    (side(width), side(height))
}

//! A perceptual distance between a photograph and a rendering, by a network of contract `metric` (ST-LPIPS, LPIPS, …).
//! It is reported under the name in its manifest: distances of different networks cannot be compared.

use std::path::Path;
use std::sync::Arc;

use image::RgbImage;

use super::OnnxError;
use super::manifest::Contract;
use super::network::{LazySession, Network};
use super::picture::push_planes;

/// An opened metric.
#[derive(Debug)]
pub struct PerceptualMetric {
    session: LazySession,
    planes: [Vec<f32>; 2],
}

impl PerceptualMetric {
    /// Reads the manifest and checks the network against it for pictures of `size`.
    ///
    /// # Errors
    /// As [`LazySession::check`]; a file is missing or damaged, or the network follows another contract.
    pub fn open(path: &Path, size: (u32, u32), threads: usize) -> Result<Self, OnnxError> {
        let mut session = LazySession::new(Arc::new(Network::read_as(path, Contract::Metric)?), threads);
        session.check(size)?;
        Ok(Self { session, planes: [Vec::new(), Vec::new()] })
    }

    /// Name under which its distances are reported.
    pub fn name(&self) -> &str {
        &self.session.manifest().name
    }

    /// Distance of two pictures of one size, in the network's own unit; pictures of another size than the network's are
    /// resampled to it, both alike.
    ///
    /// # Errors
    /// ONNX Runtime fails, or what comes out is not one finite number.
    pub fn distance(&mut self, truth: &RgbImage, rendering: &RgbImage) -> Result<f64, OnnxError> {
        let (w, h) = self.session.manifest().input_size(truth.width(), truth.height());
        for (planes, image) in self.planes.iter_mut().zip([truth, rendering]) {
            planes.clear();
            push_planes(image, w, h, &self.session.manifest().input, planes);
        }
        let out = self.session.run((w, h), &[&self.planes[0], &self.planes[1]])?;
        let distance = f64::from(out[0].data[0]);
        if !distance.is_finite() {
            return Err(OnnxError::Contract {
                network: self.name().to_owned(),
                contract: Contract::Metric.name(),
                tensor: "output `distance`".to_owned(),
                expected: "one finite number".into(),
                found: distance.to_string().into(),
            });
        }
        Ok(distance)
    }
}

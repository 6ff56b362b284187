//! A perceptual distance between a photograph and a rendering, by a network of contract `metric` (ST-LPIPS, LPIPS, …).
//! It is reported under the name in its manifest: distances of different networks cannot be compared.

use std::path::Path;

use image::RgbImage;

use super::OnnxError;
use super::manifest::Contract;
use super::named::NamedNetwork;
use super::picture::push_planes;

/// An opened metric.
#[derive(Debug)]
pub struct PerceptualMetric {
    network: NamedNetwork,
    planes: [Vec<f32>; 2],
}

impl PerceptualMetric {
    /// Reads the manifest and compares the network with it for pictures of `size`.
    ///
    /// # Errors
    /// A file is missing or damaged, or the network does not follow contract `metric`.
    pub fn open(path: &Path, size: (u32, u32), threads: usize) -> Result<Self, OnnxError> {
        let network = NamedNetwork::open(path, Contract::Metric, size, threads)?;
        Ok(Self { network, planes: [Vec::new(), Vec::new()] })
    }

    /// Name under which its distances are reported.
    pub fn name(&self) -> &str {
        &self.network.manifest().name
    }

    /// Distance of two pictures of one size, in the network's own unit; pictures of another size than the network's are
    /// resampled to it, both alike.
    ///
    /// # Errors
    /// ONNX Runtime fails, or what comes out is not one finite number.
    pub fn distance(&mut self, truth: &RgbImage, rendering: &RgbImage) -> Result<f64, OnnxError> {
        let (w, h) = self.network.manifest().input_size(truth.width(), truth.height());
        for (planes, image) in self.planes.iter_mut().zip([truth, rendering]) {
            planes.clear();
            push_planes(image, w, h, &self.network.manifest().input, planes);
        }
        let shape = [1, 3, h as usize, w as usize];
        let inputs = [("image0", &shape[..], &self.planes[0][..]), ("image1", &shape[..], &self.planes[1][..])];
        let out = self.network.at((w, h))?.run(&inputs, &["distance"])?;
        match out.first().map(|t| t.data.as_slice()) {
            Some([d]) if d.is_finite() => Ok(f64::from(*d)),
            other => Err(self.network.broken(
                "distance",
                "one finite number".to_owned(),
                other.map_or("missing".to_owned(), |d| match d {
                    [d] => d.to_string(),
                    many => format!("{} numbers", many.len()),
                }),
            )),
        }
    }
}

//! XFeat features: keypoints at local maxima of the heat map, descriptors sampled bilinearly from the ⅛ map, score =
//! heat × reliability (as XFeat's own detector). The network ships inside the binary (Apache-2.0).

use std::path::Path;
use std::sync::Arc;

use image::RgbImage;

use super::OnnxError;
use super::manifest::Contract;
pub use super::network::DESCRIPTOR;
use super::network::{LazySession, Network};
use super::picture::push_planes;
use super::session::{Tensor, check_library};

/// Heat below this is no keypoint (XFeat's default).
const MIN_HEAT: f32 = 0.05;
/// Half of the window in which a keypoint is the only one (XFeat: 5×5).
const NMS_RADIUS: usize = 2;

const EMBEDDED: &[u8] = include_bytes!("../../networks/xfeat.onnx");
const EMBEDDED_MANIFEST: &str = include_str!("../../networks/xfeat.toml");

/// Features of one picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Features {
    /// x, y in pixels of the picture given, centre of the top-left pixel at (0.5, 0.5); best first.
    pub keypoints: Vec<[f32; 2]>,
    /// [`DESCRIPTOR`] floats of unit length each.
    pub descriptors: Vec<f32>,
    /// Heat × reliability, 0…1.
    pub scores: Vec<f32>,
}

impl Features {
    /// Forgets the key points for which `keeps` says no.
    pub fn retain(&mut self, keeps: impl Fn([f32; 2]) -> bool) {
        let mut kept = 0;
        for i in 0..self.keypoints.len() {
            if keeps(self.keypoints[i]) {
                self.keypoints.swap(kept, i);
                self.descriptors.copy_within(i * DESCRIPTOR..(i + 1) * DESCRIPTOR, kept * DESCRIPTOR);
                if i < self.scores.len() {
                    self.scores.swap(kept, i);
                }
                kept += 1;
            }
        }
        self.keypoints.truncate(kept);
        self.descriptors.truncate(kept * DESCRIPTOR);
        self.scores.truncate(kept);
    }

    /// Descriptor of keypoint `i`.
    pub fn descriptor(&self, i: usize) -> &[f32] {
        &self.descriptors[i * DESCRIPTOR..(i + 1) * DESCRIPTOR]
    }
}

/// A features network; its session is opened again when the picture size changes, so keep to one size.
#[derive(Debug)]
pub struct FeatureNetwork {
    session: LazySession,
    planes: Vec<f32>,
}

impl FeatureNetwork {
    /// The embedded network, or the user's, which is [checked](Self::check).
    ///
    /// # Errors
    /// The manifest or its file is bad, or the network is not what the manifest says; ONNX Runtime is missing or cannot be
    /// used (found here, not at the first picture).
    pub fn open(manifest: Option<&Path>, threads: usize) -> Result<Self, OnnxError> {
        check_library()?;
        let network = match manifest {
            None => Network::embedded(EMBEDDED_MANIFEST, EMBEDDED)?,
            Some(path) => Network::read_as(path, Contract::Features)?,
        };
        let mut features = Self { session: LazySession::new(Arc::new(network), threads), planes: Vec::new() };
        if manifest.is_some() {
            features.check()?;
        }
        Ok(features)
    }

    /// Runs the network once on a blank picture of 640 × 480.
    ///
    /// # Errors
    /// As [`LazySession::check`].
    pub fn check(&mut self) -> Result<(), OnnxError> {
        self.session.check((640, 480))
    }

    /// Gives the session's memory back; the next picture opens it again.
    pub fn close(&mut self) {
        self.session.close();
        self.planes = Vec::new();
    }

    /// Finds at most `max` features, best first; none in a picture smaller than the network takes.
    ///
    /// # Errors
    /// ONNX Runtime failed, or the network's outputs are not XFeat's.
    pub fn extract(&mut self, image: &RgbImage, max: usize) -> Result<Features, OnnxError> {
        let input = &self.session.manifest().input;
        if input.width.is_none() && image.width().min(image.height()) < input.multiple {
            return Ok(Features::default());
        }
        let (w, h) = self.session.manifest().input_size(image.width(), image.height());
        self.planes.clear();
        push_planes(image, w, h, input, &mut self.planes);
        let out = self.session.run((w, h), &[&self.planes])?;
        let scale = [image.width() as f32 / w as f32, image.height() as f32 / h as f32];
        Ok(select(&out[0], &out[1], &out[2], max, scale))
    }
}

/// Keypoints, descriptors and scores out of the three maps.
fn select(feats: &Tensor, heat: &Tensor, rel: &Tensor, max: usize, scale: [f32; 2]) -> Features {
    let (h, w) = (heat.shape[2], heat.shape[3]);
    let map = Cells { w: w / 8, h: h / 8 };
    let mut found: Vec<(f32, usize, usize)> = Vec::new();
    for y in NMS_RADIUS..h - NMS_RADIUS {
        for x in NMS_RADIUS..w - NMS_RADIUS {
            let v = heat.data[y * w + x];
            // NaN compares false and is no keypoint.
            if v > MIN_HEAT && is_peak(&heat.data, w, x, y, v) {
                let reliability = map.sample(&rel.data, x as f32 + 0.5, y as f32 + 0.5);
                found.push((v * reliability, x, y));
            }
        }
    }
    // Ties are broken by position, so that the same picture gives the same features.
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.2, a.1).cmp(&(b.2, b.1))));
    found.truncate(max);
    let mut out = Features::default();
    for (score, x, y) in found {
        let (px, py) = centroid(&heat.data, w, x, y);
        let start = out.descriptors.len();
        for c in 0..DESCRIPTOR {
            let plane = &feats.data[c * map.w * map.h..(c + 1) * map.w * map.h];
            out.descriptors.push(map.sample(plane, px, py));
        }
        let norm = out.descriptors[start..].iter().map(|v| v * v).sum::<f32>().sqrt();
        if !(norm > 1e-6 && norm.is_finite()) {
            out.descriptors.truncate(start);
            continue;
        }
        out.descriptors[start..].iter_mut().for_each(|v| *v /= norm);
        out.keypoints.push([px * scale[0], py * scale[1]]);
        out.scores.push(score);
    }
    out
}

/// The largest value of its window; of equals the first in reading order.
fn is_peak(heat: &[f32], w: usize, x: usize, y: usize, v: f32) -> bool {
    for j in y - NMS_RADIUS..=y + NMS_RADIUS {
        for i in x - NMS_RADIUS..=x + NMS_RADIUS {
            let other = heat[j * w + i];
            if other > v || (other == v && (j, i) < (y, x)) {
                return false;
            }
        }
    }
    true
}

/// Sub-pixel position: centre of gravity of the 3×3 heat around the peak.
fn centroid(heat: &[f32], w: usize, x: usize, y: usize) -> (f32, f32) {
    let (mut sum, mut dx, mut dy) = (0.0f32, 0.0f32, 0.0f32);
    for j in 0..3 {
        for i in 0..3 {
            let v = heat[(y + j - 1) * w + x + i - 1].max(0.0);
            sum += v;
            dx += v * (i as f32 - 1.0);
            dy += v * (j as f32 - 1.0);
        }
    }
    (x as f32 + 0.5 + dx / sum, y as f32 + 0.5 + dy / sum)
}

/// A map at ⅛ of the picture's size.
struct Cells {
    w: usize,
    h: usize,
}

impl Cells {
    /// Bilinear value at a position in picture pixels, clamped at the border.
    fn sample(&self, plane: &[f32], px: f32, py: f32) -> f32 {
        let x = (px / 8.0 - 0.5).clamp(0.0, (self.w - 1) as f32);
        let y = (py / 8.0 - 0.5).clamp(0.0, (self.h - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(self.w - 1), (y0 + 1).min(self.h - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let top = plane[y0 * self.w + x0] * (1.0 - fx) + plane[y0 * self.w + x1] * fx;
        let bottom = plane[y1 * self.w + x0] * (1.0 - fx) + plane[y1 * self.w + x1] * fx;
        top * (1.0 - fy) + bottom * fy
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(dx: u32) -> RgbImage {
        // Blocks of pseudo-random grey, so that corners exist and a shift is a shift.
        RgbImage::from_fn(256, 192, |x, y| {
            let (i, j) = ((x + dx) / 12, y / 12);
            let v = (i.wrapping_mul(2_654_435_761) ^ j.wrapping_mul(40_503)).wrapping_mul(2_246_822_519) >> 24;
            image::Rgb([v as u8; 3])
        })
    }

    #[test]
    fn a_shifted_picture_gives_matches_at_the_shift() {
        if super::super::session::find_library().is_err() {
            needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
            return;
        }
        let mut network = FeatureNetwork::open(None, 1).unwrap();
        let a = network.extract(&texture(0), 300).unwrap();
        let b = network.extract(&texture(16), 300).unwrap();
        assert!(a.keypoints.len() > 40, "{}", a.keypoints.len());
        assert_eq!(a.descriptors.len(), a.keypoints.len() * DESCRIPTOR);
        assert!(a.scores.windows(2).all(|s| s[0] >= s[1]));
        let best = |from: &Features, i: usize, to: &Features| {
            let dot = |j: usize| from.descriptor(i).iter().zip(to.descriptor(j)).map(|(x, y)| x * y).sum::<f32>();
            (0..to.keypoints.len()).max_by(|&p, &q| dot(p).total_cmp(&dot(q))).unwrap()
        };
        let mut shifts = Vec::new();
        for i in 0..a.keypoints.len() {
            let j = best(&a, i, &b);
            if best(&b, j, &a) == i {
                shifts.push(a.keypoints[i][0] - b.keypoints[j][0]);
            }
        }
        shifts.sort_by(f32::total_cmp);
        assert!(shifts.len() > 20, "{} mutual matches", shifts.len());
        assert!((shifts[shifts.len() / 2] - 16.0).abs() < 0.3, "{}", shifts[shifts.len() / 2]);
    }

    #[test]
    fn a_picture_too_small_for_the_network_has_no_features() {
        if super::super::session::find_library().is_err() {
            needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
            return;
        }
        let mut network = FeatureNetwork::open(None, 1).unwrap();
        assert_eq!(network.extract(&RgbImage::new(17, 1), 10).unwrap(), Features::default());
    }
}

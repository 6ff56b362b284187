//! The manifest: a small TOML file beside an ONNX file that says which contract the network follows and every
//! convention that its numbers cannot tell (quaternion order, linear or logarithmic scales, frames, input range).
//!
//! A user's own network is one line in the mission file: the path of its manifest.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use config::keys::to_hex;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::OnnxError;
use crate::formats::{FormatError, one_line, read_bounded};

/// Networks larger than this are refused before they are read: nothing a companion computer can run is larger.
const MAX_NETWORK_BYTES: u64 = 4 << 30;
/// Manifests larger than this are refused before they are read.
const MAX_MANIFEST_BYTES: u64 = 1 << 16;

/// Which inputs and outputs a network promises.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Contract {
    /// Pictures → depth or pointmaps with confidence.
    Pair,
    /// Picture → relative depth or inverse depth.
    Depth,
    /// Picture → keypoints and descriptors.
    Features,
    /// Two pictures → perceptual distance.
    Metric,
}

impl Contract {
    /// As written in the manifest.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pair => "pair",
            Self::Depth => "depth",
            Self::Features => "features",
            Self::Metric => "metric",
        }
    }
}

/// How a picture becomes an input tensor.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct InputSettings {
    /// Fixed size, pixels; absent = the network takes any size.
    #[serde(default)]
    pub width: Option<u32>,
    /// Fixed size, pixels; absent = the network takes any size.
    #[serde(default)]
    pub height: Option<u32>,
    /// For networks of any size: width and height are rounded down to a multiple of this.
    #[serde(default = "one")]
    pub multiple: u32,
    /// What 0 and 255 become.
    pub range: [f32; 2],
    /// Subtracted after `range`, per channel.
    #[serde(default)]
    pub mean: [f32; 3],
    /// Divided by after `mean`, per channel.
    #[serde(default = "ones")]
    pub std: [f32; 3],
}

fn one() -> u32 {
    1
}

fn ones() -> [f32; 3] {
    [1.0; 3]
}

/// Whether a pair network is told the poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Poses {
    /// Inputs `images [1,V,3,H,W]`, `rel_proj [V-1,4,4]`, `depth_range [2]`, `k_ref [3,3]` (IterMVS); outputs
    /// `depth`, `conf` `[1,1,H,W]`.
    Given,
    /// Inputs `img1`, `img2` `[1,3,H,W]`; outputs pointmaps and Gaussian heads per view (Splatt3R).
    None,
}

/// Order of a quaternion's numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum QuaternionOrder {
    /// Imaginary part first (Splatt3R).
    Xyzw,
    /// Real part first (3DGS).
    Wxyz,
}

/// Whether scales are lengths or logarithms of lengths.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ScaleUnit {
    /// Lengths, in the unit of `pts3d`.
    Linear,
    /// Natural logarithms.
    Log,
}

/// Whether opacities are probabilities or logits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum OpacityUnit {
    /// 0…1.
    Linear,
    /// Before the sigmoid.
    Logit,
}

/// Conventions of a pair network. Everything after `views` describes unposed networks.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct PairSettings {
    /// Whether it takes poses.
    pub poses: Poses,
    /// Pictures per run: the reference and its sources. Unposed networks take 2.
    pub views: usize,
    /// Order of `rotations`.
    #[serde(default = "xyzw")]
    pub quaternion: QuaternionOrder,
    /// Unit of `scales`.
    #[serde(default = "linear_scale")]
    pub scales: ScaleUnit,
    /// Unit of `opacities`.
    #[serde(default = "linear_opacity")]
    pub opacity: OpacityUnit,
    /// Coefficients per channel in `sh` are (degree + 1)².
    #[serde(default)]
    pub sh_degree: u8,
    /// The DC coefficient is a residual: (rgb − 0.5)/C0 of the picture is added to it (Splatt3R).
    #[serde(default)]
    pub sh_residual: bool,
    /// Subtracted from `conf` to get a weight from 0 (DUSt3R's confidence is 1 + exp(x): offset 1).
    #[serde(default)]
    pub confidence_offset: f32,
    /// `pts3d` is in metres; false = every pair has its own scale. Its scale is estimated either way.
    #[serde(default)]
    pub metric: bool,
    /// Both views' pointmaps are in the first camera's frame (DUSt3R, Splatt3R); false = each in its
    /// own, which needs `metric`.
    #[serde(default = "yes")]
    pub first_camera_frame: bool,
}

fn xyzw() -> QuaternionOrder {
    QuaternionOrder::Xyzw
}
fn linear_scale() -> ScaleUnit {
    ScaleUnit::Linear
}
fn linear_opacity() -> OpacityUnit {
    OpacityUnit::Linear
}
fn yes() -> bool {
    true
}

/// Conventions of a depth network.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DepthSettings {
    /// The output grows with nearness (MiDaS, DPT, Depth Anything), not with distance.
    pub inverse: bool,
}

/// One network: its file and what it promises.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Short name for messages and reports.
    pub name: String,
    /// Which contract it follows.
    pub contract: Contract,
    /// The ONNX file, relative to the manifest.
    pub file: PathBuf,
    /// SPDX identifier or the licence's name.
    pub licence: String,
    /// Where it came from.
    #[serde(default)]
    pub source: String,
    /// BLAKE3 of the ONNX file, hexadecimal; checked when present.
    #[serde(default)]
    pub blake3: Option<String>,
    /// SHA-256 of the ONNX file, hexadecimal; checked when present.
    #[serde(default)]
    pub sha256: Option<String>,
    /// How pictures become inputs.
    pub input: InputSettings,
    /// What the file calls an input or output of the contract, where it calls it otherwise.
    #[serde(default)]
    pub names: BTreeMap<String, String>,
    /// For contract `pair`.
    #[serde(default)]
    pub pair: Option<PairSettings>,
    /// For contract `depth`.
    #[serde(default)]
    pub depth: Option<DepthSettings>,
}

impl Manifest {
    /// Reads and checks a manifest; `file` becomes a path that can be opened.
    ///
    /// # Errors
    /// The file is unreadable, no TOML, or contradicts itself.
    pub fn read(path: &Path) -> Result<Self, OnnxError> {
        let text = read_bounded(path, MAX_MANIFEST_BYTES)?;
        let text = String::from_utf8(text).map_err(|e| FormatError::invalid(path, format!("is not UTF-8: {e}")))?;
        let mut manifest = Self::parse(&text, &path.display().to_string())?;
        manifest.file = path.parent().unwrap_or(Path::new("")).join(&manifest.file);
        Ok(manifest)
    }

    /// Parses and checks a manifest's text; `origin` names it in errors.
    ///
    /// # Errors
    /// Not TOML, unknown fields, or contradictions.
    pub fn parse(text: &str, origin: &str) -> Result<Self, OnnxError> {
        let fail = |field, reason: String| OnnxError::Manifest { manifest: origin.to_owned(), field, reason };
        let m: Self = toml::from_str(text).map_err(|e| fail("syntax", one_line(e)))?;
        if m.contract == Contract::Pair {
            let Some(pair) = &m.pair else { return Err(fail("pair", "contract `pair` needs a [pair] table".into())) };
            let wanted = if pair.poses == Poses::None { 2..=2 } else { 2..=8 };
            if !wanted.contains(&pair.views) {
                return Err(fail("pair.views", format!("{} is not within {wanted:?}", pair.views)));
            }
            if !(pair.first_camera_frame || pair.metric) {
                let reason = "false needs `metric = true`: a pointmap in its own camera's frame and at a scale of its own \
                              cannot be moved into the first's; export `pts3d_in_other_view`";
                return Err(fail("pair.first_camera_frame", reason.into()));
            }
            if pair.sh_degree > 3 {
                return Err(fail("pair.sh_degree", format!("{} is above 3", pair.sh_degree)));
            }
        }
        if m.contract == Contract::Depth && m.depth.is_none() {
            return Err(fail("depth", "contract `depth` needs a [depth] table".into()));
        }
        let i = &m.input;
        if i.width.is_some() != i.height.is_some() {
            return Err(fail("input", "give both width and height, or neither".into()));
        }
        if i.width.is_some_and(|w| !(8..=16384).contains(&w)) || i.height.is_some_and(|h| !(8..=16384).contains(&h)) {
            return Err(fail("input", "width and height must be within 8…16384".into()));
        }
        if !(1..=256).contains(&i.multiple) {
            return Err(fail("input.multiple", "must be within 1…256".into()));
        }
        let finite = i.range.iter().chain(&i.mean).chain(&i.std).all(|v| v.is_finite());
        if !finite || i.range[0] == i.range[1] || i.std.contains(&0.0) {
            return Err(fail("input", "range must be two different finite numbers, std not zero".into()));
        }
        Ok(m)
    }

    /// Reads the ONNX file and checks its hash.
    ///
    /// # Errors
    /// The file is unreadable, too large, or its hash differs (the message holds the right one).
    pub fn read_network(&self) -> Result<Vec<u8>, OnnxError> {
        let bytes = read_bounded(&self.file, MAX_NETWORK_BYTES)?;
        self.check_hash(&bytes)?;
        if let Some(other) = super::external::file_of(&bytes) {
            let file = self.file.display();
            let reason = format!(
                "{file} keeps weights in another file ({}), which the manifest's hash does not cover; export it with its weights inside",
                crate::formats::one_line(other)
            );
            return Err(OnnxError::Manifest { manifest: self.name.clone(), field: "file", reason });
        }
        Ok(bytes)
    }

    /// Compares the hashes of the network's bytes with those that the manifest states.
    ///
    /// # Errors
    /// They differ.
    pub fn check_hash(&self, bytes: &[u8]) -> Result<(), OnnxError> {
        let blake3 = |bytes: &[u8]| blake3::hash(bytes).to_hex().to_string();
        let sha256 = |bytes: &[u8]| to_hex(&Sha256::digest(bytes).into());
        let hashes: [fn(&[u8]) -> String; 2] = [blake3, sha256];
        for ((field, expected), hash) in [("blake3", &self.blake3), ("sha256", &self.sha256)].into_iter().zip(hashes) {
            let Some(expected) = expected else { continue };
            let found = hash(bytes);
            if !expected.eq_ignore_ascii_case(&found) {
                let file = self.file.display();
                let reason = format!("{file} has {found}, the manifest says {expected}: another file, or damaged");
                return Err(OnnxError::Manifest { manifest: self.name.clone(), field, reason });
            }
        }
        Ok(())
    }

    /// The size at which a picture of `width` × `height` enters the network.
    pub fn input_size(&self, width: u32, height: u32) -> (u32, u32) {
        match (self.input.width, self.input.height) {
            (Some(w), Some(h)) => (w, h),
            _ => {
                let m = self.input.multiple.max(1);
                ((width / m * m).max(m), (height / m * m).max(m))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAIR: &str = "name='a'\ncontract='pair'\nfile='a.onnx'\nlicence='MIT'\n[input]\nwidth=640\nheight=352\nrange=[-1,1]\n[pair]\nposes='given'\nviews=3\n";

    #[test]
    fn contradictions_are_named_by_field() {
        let refused = |text: &str, field: &str| {
            let e = Manifest::parse(text, "m.toml").unwrap_err().to_string();
            assert!(e.contains(field) && !e.contains('\n'), "{e}");
        };
        assert!(Manifest::parse(PAIR, "m.toml").is_ok());
        refused(&PAIR.replace("views=3", "views=1"), "pair.views");
        refused(&PAIR.replace("poses='given'", "poses='none'"), "pair.views");
        refused(&PAIR.replace("height=352", ""), "both width and height");
        refused(&PAIR.replace("[-1,1]", "[1,1]"), "range");
        refused(&PAIR.replace("views=3", "views=3\nviewz=3"), "viewz");
        refused(PAIR.split("[pair]").next().unwrap(), "[pair]");
        refused("contract", "syntax");
        let unposed = PAIR.replace("poses='given'\nviews=3", "poses='none'\nviews=2\nfirst_camera_frame=false");
        refused(&unposed, "pair.first_camera_frame");
        assert!(Manifest::parse(&format!("{unposed}metric=true\n"), "m.toml").is_ok());
    }

    #[test]
    fn a_changed_file_is_refused_with_both_hashes() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a.onnx"), b"abc").unwrap();
        let text = format!("blake3='{}'\n{PAIR}", "0".repeat(64));
        std::fs::write(folder.path().join("a.toml"), text).unwrap();
        let manifest = Manifest::read(&folder.path().join("a.toml")).unwrap();
        let e = manifest.read_network().unwrap_err().to_string();
        assert!(e.contains("000000") && e.contains(blake3::hash(b"abc").to_hex().as_str()), "{e}");
        // FIPS 180-2, appendix B.1.
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        for (hash, fits) in [(abc.to_owned(), true), (abc.replace('b', "c"), false)] {
            std::fs::write(folder.path().join("a.toml"), format!("sha256='{hash}'\n{PAIR}")).unwrap();
            assert_eq!(Manifest::read(&folder.path().join("a.toml")).unwrap().read_network().is_ok(), fits);
        }
    }

    #[test]
    fn a_missing_file_is_one_line() {
        let e = Manifest::read(Path::new("/nowhere/net.toml")).unwrap_err().to_string();
        assert!(e.starts_with("/nowhere/net.toml: "), "{e}");
    }
}

//! A network from its manifest to its results. What it promises (names, shapes, types, hash) is compared when it is opened
//! and again with what comes out of every run, so that a wrong export is one clear line before a flight and no crash in it.
//! Its session lives only while it works.

use std::borrow::Cow;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use super::OnnxError;
use super::manifest::{Contract, Manifest, Poses};
use super::session::{Input, NetworkSession, Tensor, TensorSpec};

/// Floats of a descriptor of contract `features`.
pub const DESCRIPTOR: usize = 64;

/// A manifest and the bytes of its network, shared by all sessions on it.
#[derive(Debug)]
pub struct Network {
    manifest: Manifest,
    bytes: Cow<'static, [u8]>,
}

impl Network {
    /// One that is compiled in; `manifest` is the text of its manifest.
    ///
    /// # Errors
    /// [`OnnxError::Manifest`].
    pub fn embedded(manifest: &str, bytes: &'static [u8]) -> Result<Self, OnnxError> {
        Ok(Self { manifest: Manifest::parse(manifest, "embedded network")?, bytes: Cow::Borrowed(bytes) })
    }

    /// The user's: its manifest, and its file with the hash that the manifest states.
    ///
    /// # Errors
    /// A file is missing, too large or another than the manifest says, or the manifest contradicts itself.
    pub fn read(manifest: &Path) -> Result<Self, OnnxError> {
        let manifest = Manifest::read(manifest)?;
        let bytes = Cow::Owned(manifest.read_network()?);
        Ok(Self { manifest, bytes })
    }

    /// As [`Self::read`], for a place that needs `contract`.
    ///
    /// # Errors
    /// As [`Self::read`]; the network follows another contract.
    pub fn read_as(path: &Path, contract: Contract) -> Result<Self, OnnxError> {
        let network = Self::read(path)?;
        if network.manifest.contract != contract {
            return Err(OnnxError::Manifest {
                manifest: path.display().to_string(),
                field: "contract",
                reason: format!("is `{}`, needed is `{}`", network.manifest.contract.name(), contract.name()),
            });
        }
        Ok(network)
    }

    /// What it promises.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Size of the ONNX file.
    pub fn file_bytes(&self) -> u64 {
        self.bytes.len() as u64
    }
}

/// A network whose session is opened by the first run, replaced when the size changes, and closed when it rests.
#[derive(Debug)]
pub struct LazySession {
    network: Arc<Network>,
    threads: usize,
    open: Option<Open>,
    opening_ms: f64,
}

#[derive(Debug)]
struct Open {
    size: (u32, u32),
    session: NetworkSession,
    inputs: Vec<Promise>,
    outputs: Vec<Promise>,
}

impl LazySession {
    /// Opens nothing yet.
    pub fn new(network: Arc<Network>, threads: usize) -> Self {
        Self { network, threads, open: None, opening_ms: 0.0 }
    }

    /// What the network promises.
    pub fn manifest(&self) -> &Manifest {
        &self.network.manifest
    }

    /// Milliseconds spent opening sessions so far.
    pub fn opening_ms(&self) -> f64 {
        self.opening_ms
    }

    /// Compares the network with its manifest for pictures of `size`, runs it once on blank ones, and closes it: after this
    /// only the pictures can surprise.
    ///
    /// # Errors
    /// The library is missing or unusable, a tensor has another name, shape or type, or the run fails.
    pub fn check(&mut self, size: (u32, u32)) -> Result<(), OnnxError> {
        let (w, h) = self.manifest().input_size(size.0, size.1);
        let (inputs, _) = promises(self.manifest(), w as usize, h as usize);
        let blank: Vec<Vec<f32>> = inputs.iter().map(|p| p.blank(w as f32, h as f32)).collect();
        let blank: Vec<&[f32]> = blank.iter().map(Vec::as_slice).collect();
        let ran = self.run((w, h), &blank).map(drop);
        self.close();
        ran
    }

    /// Runs the network at its input `size`; `inputs` are row-major and in the contract's order, and so are the outputs,
    /// each of the shape that the contract promises.
    ///
    /// # Errors
    /// As [`Self::check`].
    pub fn run(&mut self, size: (u32, u32), inputs: &[&[f32]]) -> Result<Vec<Tensor>, OnnxError> {
        let open = match self.open.take().filter(|open| open.size == size) {
            Some(open) => open,
            None => {
                let started = Instant::now();
                let open = open(&self.network, size, self.threads)?;
                self.opening_ms += started.elapsed().as_secs_f64() * 1e3;
                open
            }
        };
        let open = self.open.insert(open);
        let inputs: Vec<Input<'_>> =
            open.inputs.iter().zip(inputs).map(|(p, data)| (p.name, p.shape.as_slice(), *data)).collect();
        let wanted: Vec<&str> = open.outputs.iter().map(|p| p.name).collect();
        let out = open.session.run(&inputs, &wanted)?;
        for (promise, tensor) in open.outputs.iter().zip(&out) {
            let found = || format!("f32 {}", shape_text(tensor.shape.iter().map(|&d| d as i64)));
            if !(promise.shape == tensor.shape || (promise.shape.is_empty() && tensor.data.len() == 1)) {
                let output = format!("output `{}`", promise.name);
                return Err(contract_error(&self.network.manifest, output, promise.text(), found()));
            }
        }
        Ok(out)
    }

    /// Gives the session's memory back; the next run opens it again.
    pub fn close(&mut self) {
        self.open = None;
    }
}

/// One tensor of a contract; no dimensions = one number of any shape.
#[derive(Debug)]
struct Promise {
    name: &'static str,
    shape: Vec<usize>,
}

impl Promise {
    fn text(&self) -> String {
        format!("f32 {}", shape_text(self.shape.iter().map(|&d| d as i64)))
    }

    /// Values for a first run at `w` × `h`: black pictures of two cameras in one place.
    fn blank(&self, w: f32, h: f32) -> Vec<f32> {
        match self.name {
            "rel_proj" => (0..self.shape.iter().product()).map(|i| f32::from(u8::from(i % 16 % 5 == 0))).collect(),
            "k_ref" => vec![w, 0.0, 0.5 * w, 0.0, w, 0.5 * h, 0.0, 0.0, 1.0],
            "depth_range" => vec![1.0, 2.0],
            _ => vec![0.0; self.shape.iter().product()],
        }
    }
}

fn promise(name: &'static str, shape: &[usize]) -> Promise {
    Promise { name, shape: shape.to_vec() }
}

/// A session at an input size whose declared tensors are those of the contract.
///
/// Symbolic dimensions called `h`, `w` are pinned to the size. Extra outputs are allowed, extra inputs are not.
fn open(network: &Network, size: (u32, u32), threads: usize) -> Result<Open, OnnxError> {
    let manifest = &network.manifest;
    let (w, h) = (size.0 as usize, size.1 as usize);
    let mut pinned = vec![("h", h), ("w", w)];
    if manifest.contract == Contract::Features {
        pinned.extend([("h8", h / 8), ("w8", w / 8)]);
    }
    let (inputs, outputs) = promises(manifest, w, h);
    if let Some(unknown) = manifest.names.keys().find(|n| inputs.iter().chain(&outputs).all(|p| p.name != **n)) {
        let there: Vec<&str> = inputs.iter().chain(&outputs).map(|p| p.name).collect();
        return Err(OnnxError::Manifest {
            manifest: manifest.name.clone(),
            field: "names",
            reason: format!(
                "contract `{}` has no `{unknown}` (it has: {})",
                manifest.contract.name(),
                there.join(", ")
            ),
        });
    }
    let session = NetworkSession::open(&manifest.name, &network.bytes, threads, &pinned, &manifest.names)?;
    compare(manifest, session.inputs(), &inputs, "input")?;
    compare(manifest, session.outputs(), &outputs, "output")?;
    if let Some(extra) = session.inputs().iter().find(|s| inputs.iter().all(|p| p.name != s.name)) {
        let input = format!("input `{}`", extra.name);
        return Err(contract_error(manifest, input, "no such input".into(), "there".into()));
    }
    Ok(Open { size, session, inputs, outputs })
}

fn promises(manifest: &Manifest, w: usize, h: usize) -> (Vec<Promise>, Vec<Promise>) {
    match (manifest.contract, &manifest.pair) {
        (Contract::Pair, Some(pair)) if pair.poses == Poses::Given => {
            let v = pair.views;
            (
                vec![
                    promise("images", &[1, v, 3, h, w]),
                    promise("rel_proj", &[v - 1, 4, 4]),
                    promise("depth_range", &[2]),
                    promise("k_ref", &[3, 3]),
                ],
                vec![promise("depth", &[1, 1, h, w]), promise("conf", &[1, 1, h, w])],
            )
        }
        (Contract::Pair, pair) => {
            let degree = pair.as_ref().map_or(0, |p| p.sh_degree as usize);
            let d = (degree + 1) * (degree + 1);
            let mut outputs = Vec::new();
            for names in [
                ["pts3d_1", "conf_1", "scales_1", "rotations_1", "sh_1", "opacities_1"],
                ["pts3d_2", "conf_2", "scales_2", "rotations_2", "sh_2", "opacities_2"],
            ] {
                outputs.extend([
                    promise(names[0], &[1, h, w, 3]),
                    promise(names[1], &[1, h, w]),
                    promise(names[2], &[1, h, w, 3]),
                    promise(names[3], &[1, h, w, 4]),
                    promise(names[4], &[1, h, w, 3, d]),
                    promise(names[5], &[1, h, w, 1]),
                ]);
            }
            (vec![promise("img1", &[1, 3, h, w]), promise("img2", &[1, 3, h, w])], outputs)
        }
        (Contract::Depth, _) => (vec![promise("image", &[1, 3, h, w])], vec![promise("depth", &[1, h, w])]),
        (Contract::Features, _) => (
            vec![promise("image", &[1, 3, h, w])],
            vec![
                promise("feats", &[1, DESCRIPTOR, h / 8, w / 8]),
                promise("heat", &[1, 1, h, w]),
                promise("rel", &[1, 1, h / 8, w / 8]),
            ],
        ),
        (Contract::Metric, _) => {
            (vec![promise("image0", &[1, 3, h, w]), promise("image1", &[1, 3, h, w])], vec![promise("distance", &[])])
        }
    }
}

fn compare(manifest: &Manifest, found: &[TensorSpec], wanted: &[Promise], kind: &str) -> Result<(), OnnxError> {
    for p in wanted {
        let tensor = format!("{kind} `{}`", p.name);
        let expected = p.text();
        let Some(s) = found.iter().find(|s| s.name == p.name) else {
            let names = found.iter().map(|s| s.name.as_str()).collect::<Vec<_>>().join(", ");
            return Err(contract_error(manifest, tensor, expected, format!("missing (there are: {names})")));
        };
        // A scalar promise takes any shape of one element.
        let fits = p.shape.is_empty()
            || (s.shape.len() == p.shape.len() && s.shape.iter().zip(&p.shape).all(|(&a, &b)| a < 0 || a == b as i64));
        if !s.is_f32 || !fits {
            let ty = if s.is_f32 { "f32" } else { "another type than f32:" };
            return Err(contract_error(
                manifest,
                tensor,
                expected,
                format!("{ty} {}", shape_text(s.shape.iter().copied())),
            ));
        }
    }
    Ok(())
}

fn contract_error(manifest: &Manifest, tensor: String, expected: String, found: String) -> OnnxError {
    let (expected, found) = (expected.into(), found.into());
    OnnxError::Contract { network: manifest.name.clone(), contract: manifest.contract.name(), tensor, expected, found }
}

fn shape_text(shape: impl Iterator<Item = i64>) -> String {
    let text: Vec<String> = shape.map(|d| if d <= 0 { "?".to_owned() } else { d.to_string() }).collect();
    format!("[{}]", text.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::onnx::session::find_library;

    const XFEAT: &[u8] = include_bytes!("../../networks/xfeat.onnx");

    fn manifest(contract: &str, more: &str) -> Manifest {
        let text = format!("name='n'\ncontract='{contract}'\nfile='n.onnx'\nlicence='x'\n[input]\nrange=[0,1]\n{more}");
        Manifest::parse(&text, "test").unwrap()
    }

    fn checked(manifest: Manifest, bytes: &'static [u8]) -> Result<(), OnnxError> {
        LazySession::new(Arc::new(Network { manifest, bytes: Cow::Borrowed(bytes) }), 1).check((64, 64))
    }

    #[test]
    fn a_network_under_the_wrong_contract_is_refused_before_it_runs() {
        if find_library().is_err() {
            needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
            return;
        }
        assert!(checked(manifest("features", ""), XFEAT).is_ok());
        let e = checked(manifest("depth", "[depth]\ninverse=true"), XFEAT).unwrap_err().to_string();
        assert!(e.contains("output `depth` is missing") && e.contains("contract `depth` wants f32 [1,64,64]"), "{e}");
        let pair = manifest("pair", "[pair]\nposes='given'\nviews=2");
        let e = checked(pair, XFEAT).unwrap_err().to_string();
        assert!(e.contains("input `images` is missing (there are: image)"), "{e}");
    }

    #[test]
    fn bytes_that_are_no_network_are_one_clear_line() {
        if find_library().is_err() {
            needs::missing(needs::Need::OnnxRuntime, "no ONNX Runtime");
            return;
        }
        for bytes in [&b""[..], b"not onnx at all", &XFEAT[..1000]] {
            let e = checked(manifest("features", ""), bytes).unwrap_err().to_string();
            assert!(e.starts_with("network n: ") && !e.contains('\n'), "{e}");
        }
    }
}

//! A manifest and its bytes become a session whose inputs and outputs have been compared with the contract before
//! the first run, so that a wrong export is one clear line and not a crash in flight.

use super::OnnxError;
use super::manifest::{Contract, Manifest, Poses};
use super::session::{NetworkSession, TensorSpec};

/// One tensor of a contract: its name and dimensions (0 = any).
struct Promise {
    name: &'static str,
    shape: Vec<usize>,
}

fn promise(name: &'static str, shape: &[usize]) -> Promise {
    Promise { name, shape: shape.to_vec() }
}

/// Opens a network at an input size and checks every tensor that its contract names.
///
/// Symbolic dimensions called `h`, `w` are pinned to the size. Extra outputs are allowed, extra inputs are not.
///
/// # Errors
/// As [`NetworkSession::open`]; [`OnnxError::Contract`] when a tensor is missing or of another shape or type.
pub fn open(manifest: &Manifest, bytes: &[u8], size: (u32, u32), threads: usize) -> Result<NetworkSession, OnnxError> {
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
    let session = NetworkSession::open(&manifest.name, bytes, threads, &pinned, &manifest.names)?;
    check(manifest, session.inputs(), &inputs, "input")?;
    check(manifest, session.outputs(), &outputs, "output")?;
    if let Some(extra) = session.inputs().iter().find(|s| inputs.iter().all(|p| p.name != s.name)) {
        return Err(contract_error(
            manifest,
            format!("input `{}`", extra.name),
            "no such input".into(),
            "there".into(),
        ));
    }
    Ok(session)
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
            // XFeat's export leaves its outputs' channel counts open; 64 and 1 are checked on the first result.
            vec![promise("feats", &[0, 0, 0, 0]), promise("heat", &[0, 1, 0, 0]), promise("rel", &[0, 1, 0, 0])],
        ),
        (Contract::Metric, _) => {
            (vec![promise("image0", &[1, 3, h, w]), promise("image1", &[1, 3, h, w])], vec![promise("distance", &[])])
        }
    }
}

fn check(manifest: &Manifest, found: &[TensorSpec], wanted: &[Promise], kind: &str) -> Result<(), OnnxError> {
    for p in wanted {
        let tensor = format!("{kind} `{}`", p.name);
        let expected = format!("f32 {}", shape_text(p.shape.iter().map(|&d| d as i64)));
        let Some(s) = found.iter().find(|s| s.name == p.name) else {
            let names = found.iter().map(|s| s.name.as_str()).collect::<Vec<_>>().join(", ");
            return Err(contract_error(manifest, tensor, expected, format!("missing (there are: {names})")));
        };
        // A scalar promise takes any shape of one element.
        let fits = p.shape.is_empty()
            || (s.shape.len() == p.shape.len()
                && s.shape.iter().zip(&p.shape).all(|(&a, &b)| a < 0 || b == 0 || a == b as i64));
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

    #[test]
    fn a_network_under_the_wrong_contract_is_refused_before_it_runs() {
        if find_library().is_err() {
            println!("skipped: no ONNX Runtime");
            return;
        }
        assert!(open(&manifest("features", ""), XFEAT, (64, 64), 1).is_ok());
        let e = open(&manifest("depth", "[depth]\ninverse=true"), XFEAT, (64, 64), 1).unwrap_err().to_string();
        assert!(e.contains("output `depth` is missing") && e.contains("contract `depth` wants f32 [1,64,64]"), "{e}");
        let pair = manifest("pair", "[pair]\nposes='given'\nviews=2");
        let e = open(&pair, XFEAT, (64, 64), 1).unwrap_err().to_string();
        assert!(e.contains("input `images` is missing (there are: image)"), "{e}");
    }

    #[test]
    fn bytes_that_are_no_network_are_one_clear_line() {
        if find_library().is_err() {
            println!("skipped: no ONNX Runtime");
            return;
        }
        for bytes in [&b""[..], b"not onnx at all", &XFEAT[..1000]] {
            let e = open(&manifest("features", ""), bytes, (64, 64), 1).unwrap_err().to_string();
            assert!(e.starts_with("network n: ") && !e.contains('\n'), "{e}");
        }
    }
}

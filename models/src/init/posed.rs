//! Running a posed pair network (IterMVS's signature, and the embedded plane sweep): pictures and relative
//! projections in, depth and confidence out.

use glam::{DMat3, DMat4, DVec3};

use crate::camera::{Intrinsics, View};
use crate::onnx::manifest::{Contract, Manifest, Poses};
use crate::onnx::picture::push_planes;
use crate::onnx::session::{NetworkSession, Tensor};
use crate::onnx::{OnnxError, network};

use super::frame::Frame;

/// A network's bytes: shipped inside the binary, or read from the user's file.
#[derive(Debug)]
pub enum NetworkBytes {
    /// Compiled in.
    Embedded(&'static [u8]),
    /// Read from disk.
    Read(Vec<u8>),
}

impl NetworkBytes {
    /// The bytes.
    pub fn get(&self) -> &[u8] {
        match self {
            Self::Embedded(b) => b,
            Self::Read(b) => b,
        }
    }
}

/// A posed network; the session lives from the first run until [`Self::close`].
#[derive(Debug)]
pub struct PosedNetwork {
    manifest: Manifest,
    bytes: NetworkBytes,
    threads: usize,
    views: usize,
    session: Option<((u32, u32), NetworkSession)>,
    planes: Vec<f32>,
}

/// K as 4×4, so that K·T·K⁻¹ is one product.
fn k4(k: &Intrinsics) -> DMat4 {
    // IterMVS's pixel centres are at integers, ours at +0.5.
    let k3 = DMat3::from_cols(
        DVec3::new(f64::from(k.fx), 0.0, 0.0),
        DVec3::new(0.0, f64::from(k.fy), 0.0),
        DVec3::new(f64::from(k.cx) - 0.5, f64::from(k.cy) - 0.5, 1.0),
    );
    DMat4::from_mat3(k3)
}

fn world_to_camera(view: &View) -> DMat4 {
    let r = view.pose.rotation.conjugate().normalize();
    DMat4::from_rotation_translation(r, -(r * view.pose.center))
}

/// K4·T_src·T_ref⁻¹·K4⁻¹, row-major.
fn relative_projection(reference: &View, source: &View) -> [f32; 16] {
    let m = k4(&source.intrinsics)
        * world_to_camera(source)
        * world_to_camera(reference).inverse()
        * k4(&reference.intrinsics).inverse();
    m.transpose().to_cols_array().map(|v| v as f32)
}

impl PosedNetwork {
    /// Takes a manifest of contract `pair` with `poses = "given"`.
    ///
    /// # Errors
    /// Another contract.
    pub fn new(manifest: Manifest, bytes: NetworkBytes, threads: usize) -> Result<Self, OnnxError> {
        match (&manifest.contract, &manifest.pair) {
            (Contract::Pair, Some(pair)) if pair.poses == Poses::Given => {
                let views = pair.views;
                Ok(Self { manifest, bytes, threads, views, session: None, planes: Vec::new() })
            }
            _ => Err(OnnxError::Manifest {
                manifest: manifest.name,
                field: "contract",
                reason: "initialisation needs `pair`".into(),
            }),
        }
    }

    /// Its manifest.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Source pictures per run.
    pub fn sources(&self) -> usize {
        self.views - 1
    }

    /// Depth and confidence of `reference`, both `[1,1,H,W]`, from at least one source; when the network wants more
    /// sources than there are, the best is given again.
    ///
    /// # Errors
    /// ONNX Runtime or the contract fails.
    pub fn run(
        &mut self,
        reference: &Frame,
        sources: &[&Frame],
        range: [f32; 2],
    ) -> Result<(Tensor, Tensor), OnnxError> {
        let (w, h) = reference.image.dimensions();
        let session = match &mut self.session {
            Some((size, session)) if *size == (w, h) => session,
            slot => {
                &mut slot.insert(((w, h), network::open(&self.manifest, self.bytes.get(), (w, h), self.threads)?)).1
            }
        };
        let k = &reference.view.intrinsics;
        self.planes.clear();
        push_planes(&reference.image, w, h, &self.manifest.input, &mut self.planes);
        let mut projections = Vec::with_capacity(16 * (self.views - 1));
        for i in 0..self.views - 1 {
            let source = sources.get(i).or(sources.first()).copied().unwrap_or(reference);
            push_planes(&source.image, w, h, &self.manifest.input, &mut self.planes);
            projections.extend(relative_projection(&reference.view, &source.view));
        }
        let k_ref = [k.fx, 0.0, k.cx - 0.5, 0.0, k.fy, k.cy - 0.5, 0.0, 0.0, 1.0];
        let (views, rows, columns) = (self.views, h as usize, w as usize);
        let mut out = session.run(
            &[
                ("images", &[1, views, 3, rows, columns], &self.planes),
                ("rel_proj", &[views - 1, 4, 4], &projections),
                ("depth_range", &[2], &range),
                ("k_ref", &[3, 3], &k_ref),
            ],
            &["depth", "conf"],
        )?;
        let conf = out.pop();
        match (out.pop(), conf) {
            (Some(depth), Some(conf)) if depth.shape == [1, 1, rows, columns] && conf.shape == depth.shape => {
                Ok((depth, conf))
            }
            _ => Err(OnnxError::Contract {
                network: self.manifest.name.clone(),
                contract: "pair",
                tensor: "outputs `depth`, `conf`".into(),
                expected: format!("[1,1,{rows},{columns}]"),
                found: "other shapes".into(),
            }),
        }
    }

    /// Gives the session's memory back; the next run opens it again.
    pub fn close(&mut self) {
        self.session = None;
        self.planes = Vec::new();
    }
}

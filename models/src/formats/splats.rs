//! A cloud of Gaussians in whatever form another program wrote it, told by its content, not by its name.

use std::io::Read;
use std::path::Path;

use geometry::geodesy::Geodetic;

use super::{FormatError, gltf, ply, sog, splat, spz};
use crate::cloud::GaussianCloud;

/// What a file held.
#[derive(Clone, Debug)]
pub struct Splats {
    /// The Gaussians.
    pub cloud: GaussianCloud,
    /// WGS-84 origin of their frame, when a `dgtr` wrote the file.
    pub origin: Option<Geodetic>,
    /// Rows left out because they hold no usable number.
    pub dropped: usize,
    /// Trained for a renderer that makes Gaussians fainter where it widens them to a pixel (Mip-Splatting).
    pub is_antialiased: bool,
    /// The form, as people call it.
    pub form: &'static str,
}

/// Reads a PLY (3DGS, 2DGS, PlayCanvas' compressed), SPZ with these axes, SOG, glTF with KHR_gaussian_splatting, or `.splat`.
///
/// # Errors
/// The file cannot be read or is none of them.
pub fn read(path: &Path, spz_axes: spz::Axes) -> Result<Splats, FormatError> {
    let mut start = [0; 4];
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let mut begun = Vec::new();
    file.take(4).read_to_end(&mut begun).map_err(|e| FormatError::io(path, "reading", e))?;
    start[..begun.len()].copy_from_slice(&begun);
    let of = |(cloud, dropped), form| Splats { cloud, origin: None, dropped, is_antialiased: false, form };
    Ok(match &start {
        b"ply\n" | b"ply\r" => {
            let ply::PlyModel { cloud, origin, dropped, is_antialiased } = ply::read(path)?;
            Splats { cloud, origin, dropped, is_antialiased, form: "PLY" }
        }
        [0x1F, 0x8B, ..] | b"NGSP" => {
            let spz::SpzModel { cloud, dropped, is_antialiased } = spz::read(path, spz_axes)?;
            Splats { is_antialiased, ..of((cloud, dropped), "SPZ") }
        }
        b"PK\x03\x04" => of(sog::read(path)?, "SOG"),
        b"glTF" => of(gltf::read(path)?, "glTF"),
        _ if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("splat")) => of(splat::read(path)?, ".splat"),
        _ => {
            let what = "is no cloud of Gaussians that can be read: neither PLY, SPZ, SOG, glTF (.glb) nor .splat";
            return Err(FormatError::invalid(path, what));
        }
    })
}

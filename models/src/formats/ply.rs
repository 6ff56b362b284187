//! The 3DGS point cloud PLY that every viewer reads: log scales, logit opacities, w x y z quaternions, and the SH
//! rest channel by channel (all red, all green, all blue), which is the transpose of [`GaussianCloud::sh`].

use std::io::{BufReader, Read};
use std::path::Path;

use geometry::geodesy::Geodetic;

use super::{FormatError, write_atomic};
use crate::cloud::{GaussianCloud, sh_coefficients};

mod compressed;
mod header;

use header::{Header, Kind, Rows};

const ORIGIN: &str = "dgtr enu_origin_wgs84";

/// What a PLY file held.
#[derive(Clone, Debug)]
pub struct PlyModel {
    /// The Gaussians.
    pub cloud: GaussianCloud,
    /// WGS-84 origin of their ENU frame, when a `dgtr` wrote the file.
    pub origin: Option<Geodetic>,
    /// Rows left out because they hold a number that is not finite or no rotation.
    pub dropped: usize,
    /// Trained for a renderer that makes Gaussians fainter where it widens them to a pixel (Mip-Splatting).
    pub is_antialiased: bool,
}

/// Writes `cloud`, atomically, with its georeference as a comment.
///
/// # Errors
/// The operating system's.
pub fn write(path: &Path, cloud: &GaussianCloud, origin: Option<Geodetic>) -> Result<(), FormatError> {
    let d = sh_coefficients(cloud.sh_degree);
    let mut names: Vec<String> =
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into();
    names.extend((0..3 * (d - 1)).map(|i| format!("f_rest_{i}")));
    names.extend(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(String::from));
    write_atomic(path, |out| {
        writeln!(out, "ply\nformat binary_little_endian 1.0")?;
        writeln!(out, "comment local east-north-up metres, z up")?;
        if let Some(o) = origin {
            writeln!(out, "comment {ORIGIN} {} {} {}", o.lat_deg, o.lon_deg, o.alt_m)?;
        }
        writeln!(out, "element vertex {}", cloud.len())?;
        for name in &names {
            writeln!(out, "property float {name}")?;
        }
        writeln!(out, "end_header")?;
        let mut row = Vec::with_capacity(4 * names.len());
        for i in 0..cloud.len() {
            let sh = &cloud.sh[i * 3 * d..(i + 1) * 3 * d];
            row.clear();
            let mut put = |v: f32| row.extend(v.to_le_bytes());
            cloud.means[i].iter().for_each(|&v| put(v));
            [0.0; 3].into_iter().for_each(&mut put);
            sh[..3].iter().for_each(|&v| put(v));
            for channel in 0..3 {
                (1..d).for_each(|k| put(sh[3 * k + channel]));
            }
            put(cloud.opacity_logits[i]);
            cloud.log_scales[i].iter().for_each(|&v| put(v));
            cloud.rotations[i].iter().for_each(|&v| put(v));
            out.write_all(&row)?;
        }
        Ok(())
    })
}

/// Reads a 3DGS PLY: binary of either order or text, properties in any order, unknown ones skipped, two scales (2DGS) as a flat
/// Gaussian, or PlayCanvas' compressed form.
///
/// # Errors
/// As [`FormatError`] says; what is allocated is bounded by the file's own size.
pub fn read(path: &Path) -> Result<PlyModel, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let size = file.metadata().map_err(|e| FormatError::io(path, "reading", e))?.len();
    let mut input = BufReader::with_capacity(1 << 16, file);
    let header = header::read(path, &mut input)?;
    header.check_size(path, size)?;
    let mut cloud = match compressed::is_compressed(&header) {
        true => compressed::read(path, &header, &mut input)?,
        false => plain(path, &header, &mut input)?,
    };
    cloud.bring_in_limits();
    let dropped = cloud.drop_invalid();
    // Brush's word for models that were trained with the filter of Mip-Splatting.
    let is_antialiased = header.comments.iter().any(|c| c.to_lowercase().replace(' ', "") == "splatrendermode:mip");
    Ok(PlyModel { cloud, origin: header.origin(ORIGIN), dropped, is_antialiased })
}

fn plain(path: &Path, header: &Header, input: &mut dyn Read) -> Result<GaussianCloud, FormatError> {
    let Some(vertices) = header.vertices() else {
        return Err(FormatError::invalid(path, "has no vertices; give a 3DGS .ply"));
    };
    let find = |name: &str| vertices.properties.iter().position(|p| p.name == name);
    let need = |name: &str| {
        let at = find(name).ok_or_else(|| {
            let hint = if name.starts_with("f_dc") { " (a plain point cloud is not a Gaussian model)" } else { "" };
            FormatError::invalid(path, format!("has no vertex property {name:?}{hint}; give a 3DGS .ply"))
        })?;
        match vertices.properties[at].kind {
            // A byte for each number would make the cloud four times the file.
            Kind::Whole(..) => {
                Err(FormatError::invalid(path, format!("vertex property {name:?} is no float or double")))
            }
            _ => Ok(at),
        }
    };
    let rest = vertices.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let Some(degree) = (0..=3u8).find(|&d| 3 * (sh_coefficients(d) - 1) == rest) else {
        return Err(FormatError::invalid(
            path,
            format!("has {rest} f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45"),
        ));
    };
    let d = sh_coefficients(degree);
    let is_flat = find("scale_2").is_none() && find("scale_1").is_some();
    let fixed = ["x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity"];
    let columns = fixed.iter().map(|n| if is_flat && *n == "scale_2" { Ok(usize::MAX) } else { need(n) });
    let mut columns: Vec<usize> = columns.collect::<Result<_, _>>()?;
    for k in 0..d {
        for channel in 0..3 {
            let name = if k == 0 { format!("f_dc_{channel}") } else { format!("f_rest_{}", channel * (d - 1) + k - 1) };
            columns.push(need(&name)?);
        }
    }
    let mut cloud = GaussianCloud::with_capacity(degree, vertices.count as usize);
    let mut values = vec![0.0; columns.len()];
    for element in &header.elements {
        let mut rows = Rows::new(path, header, element, input)?;
        let is_vertex = element.name == "vertex";
        while let Some(row) = rows.next()? {
            if !is_vertex {
                continue;
            }
            for (value, column) in values.iter_mut().zip(&columns) {
                *value = if *column == usize::MAX { f32::NEG_INFINITY } else { row.float(*column) };
            }
            let v = &values;
            cloud.push([v[0], v[1], v[2]], [v[3], v[4], v[5]], [v[6], v[7], v[8], v[9]], v[10], &v[11..]);
        }
        // What follows the vertices is left unread.
        if is_vertex {
            break;
        }
    }
    Ok(cloud)
}

/// Gives place and colour of every vertex of a plain point cloud to `take`; vertices without colours are grey.
///
/// # Errors
/// As [`read`]; the vertices have no x, y and z.
pub fn points(path: &Path, take: &mut dyn FnMut([f64; 3], [u8; 3])) -> Result<(), FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let size = file.metadata().map_err(|e| FormatError::io(path, "reading", e))?.len();
    let mut input = BufReader::with_capacity(1 << 16, file);
    let header = header::read(path, &mut input)?;
    header.check_size(path, size)?;
    for element in &header.elements {
        let find = |name: &str| element.properties.iter().position(|p| p.name == name);
        let place = ["x", "y", "z"].map(find);
        let color = ["red", "green", "blue"].map(find);
        let is_vertex = element.name == "vertex";
        let mut rows = Rows::new(path, &header, element, &mut input)?;
        while let Some(row) = rows.next()? {
            match (is_vertex, place) {
                (false, _) => {}
                (true, [Some(x), Some(y), Some(z)]) => {
                    take([x, y, z].map(|at| row.number(at)), color.map(|at| at.map_or(128, |at| row.word(at) as u8)));
                }
                (true, _) => return Err(FormatError::invalid(path, "its vertices have no x, y and z")),
            }
        }
        if is_vertex {
            return Ok(());
        }
    }
    Err(FormatError::invalid(path, "has no vertices"))
}

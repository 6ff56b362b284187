//! The 3DGS point cloud PLY that every viewer reads: log scales, logit opacities, w x y z quaternions, and the SH
//! rest channel by channel (all red, all green, all blue), which is the transpose of [`GaussianCloud::sh`].

use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use geometry::geodesy::Geodetic;

use super::{FormatError, write_atomic};
use crate::cloud::{GaussianCloud, sh_coefficients};

/// Longest header taken; a 3DGS one has 1.5 KiB.
const MAX_HEADER: u64 = 64 << 10;
/// Most properties of a vertex taken.
const MAX_PROPERTIES: usize = 256;
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

/// Reads a 3DGS PLY (binary, little-endian; properties in any order, unknown ones skipped).
///
/// # Errors
/// As [`FormatError`] says; what is allocated is bounded by the file's own size.
pub fn read(path: &Path) -> Result<PlyModel, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let size = file.metadata().map_err(|e| FormatError::io(path, "reading", e))?.len();
    let mut input = BufReader::with_capacity(1 << 16, file);
    let header = read_header(path, &mut input)?;
    let find = |name: &str| header.properties.iter().find(|p| p.name == name).cloned();
    let need = |name: &str| {
        let property = find(name).ok_or_else(|| {
            let hint = if name.starts_with("f_dc") { " (a plain point cloud is not a Gaussian model)" } else { "" };
            FormatError::invalid(path, format!("has no vertex property {name:?}{hint}; give a 3DGS .ply"))
        })?;
        match property.kind {
            // A byte for each number would make the cloud four times the file.
            Kind::Other(_) => {
                Err(FormatError::invalid(path, format!("vertex property {name:?} is no float or double")))
            }
            _ => Ok(property),
        }
    };
    let rest = header.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    let Some(degree) = (0..=3u8).find(|&d| 3 * (sh_coefficients(d) - 1) == rest) else {
        return Err(FormatError::invalid(
            path,
            format!("has {rest} f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45"),
        ));
    };
    let d = sh_coefficients(degree);
    let fixed = ["x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity"];
    let mut columns: Vec<Property> = fixed.iter().map(|n| need(n)).collect::<Result<_, _>>()?;
    for k in 0..d {
        for channel in 0..3 {
            let name = if k == 0 { format!("f_dc_{channel}") } else { format!("f_rest_{}", channel * (d - 1) + k - 1) };
            columns.push(need(&name)?);
        }
    }
    let stride = header.properties.last().map_or(0, |p| p.offset + p.kind.bytes()) as u64;
    let body = header.count.checked_mul(stride).and_then(|b| b.checked_add(header.bytes));
    if body.is_none_or(|b| b > size) {
        return Err(FormatError::Truncated { path: path.to_owned(), at: size, what: "its vertices" });
    }
    let mut cloud = GaussianCloud::with_capacity(degree, header.count as usize);
    let mut row = vec![0; stride as usize];
    let mut values = vec![0.0; columns.len()];
    for _ in 0..header.count {
        input.read_exact(&mut row).map_err(|e| FormatError::io(path, "reading", e))?;
        for (value, column) in values.iter_mut().zip(&columns) {
            *value = column.value(&row);
        }
        let v = &values;
        cloud.push([v[0], v[1], v[2]], [v[3], v[4], v[5]], [v[6], v[7], v[8], v[9]], v[10], &v[11..]);
    }
    let dropped = cloud.drop_invalid();
    Ok(PlyModel { cloud, origin: header.origin, dropped })
}

#[derive(Clone, Copy)]
enum Kind {
    F32,
    F64,
    /// Only skipped over.
    Other(usize),
}

impl Kind {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            "char" | "uchar" | "int8" | "uint8" => Self::Other(1),
            "short" | "ushort" | "int16" | "uint16" => Self::Other(2),
            "int" | "uint" | "int32" | "uint32" => Self::Other(4),
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F64 => 8,
            Self::Other(n) => n,
        }
    }
}

#[derive(Clone)]
struct Property {
    name: String,
    kind: Kind,
    offset: usize,
}

impl Property {
    fn value(&self, row: &[u8]) -> f32 {
        let bytes = &row[self.offset..];
        match self.kind {
            Kind::F32 => bytes.first_chunk().map_or(f32::NAN, |b| f32::from_le_bytes(*b)),
            Kind::F64 => bytes.first_chunk().map_or(f32::NAN, |b| f64::from_le_bytes(*b) as f32),
            Kind::Other(_) => f32::NAN,
        }
    }
}

struct Header {
    count: u64,
    properties: Vec<Property>,
    origin: Option<Geodetic>,
    bytes: u64,
}

fn read_header(path: &Path, input: &mut impl BufRead) -> Result<Header, FormatError> {
    let bad = |what: String| FormatError::invalid(path, what);
    let mut header = Header { count: 0, properties: Vec::new(), origin: None, bytes: 0 };
    let (mut elements, mut offset) = (0, 0);
    let mut line = Vec::new();
    for number in 1.. {
        line.clear();
        let left = MAX_HEADER - header.bytes;
        let n =
            input.by_ref().take(left).read_until(b'\n', &mut line).map_err(|e| FormatError::io(path, "reading", e))?;
        header.bytes += n as u64;
        if number == 1 && line.trim_ascii_end() != b"ply" {
            return Err(bad("is not a PLY file (its first line is not \"ply\")".into()));
        }
        if line.last() != Some(&b'\n') {
            return Err(if header.bytes >= MAX_HEADER {
                FormatError::TooLarge {
                    path: path.to_owned(),
                    what: "its header",
                    size: header.bytes,
                    limit: MAX_HEADER,
                }
            } else {
                FormatError::Truncated { path: path.to_owned(), at: header.bytes, what: "its header" }
            });
        }
        let text = String::from_utf8_lossy(&line);
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["end_header"] => break,
            ["format", "binary_little_endian", _] => {}
            ["format", other, ..] => {
                return Err(bad(format!("PLY format {other} is not supported; write binary_little_endian")));
            }
            ["element", "vertex", n] if elements == 0 => {
                elements = 1;
                header.count = n.parse().map_err(|_| bad(format!("line {number}: {n:?} is no number of vertices")))?;
            }
            // What follows the vertices is left unread.
            ["element", ..] if elements > 0 => elements += 1,
            ["element", other, ..] => {
                return Err(bad(format!("element {other} comes before the vertices; write the vertices first")));
            }
            ["property", kind, name] if elements == 1 => {
                let Some(kind) = Kind::parse(kind) else {
                    return Err(bad(format!("line {number}: property type {kind} is not supported")));
                };
                if header.properties.len() == MAX_PROPERTIES {
                    return Err(bad(format!("has more than {MAX_PROPERTIES} vertex properties")));
                }
                header.properties.push(Property { name: (*name).to_owned(), kind, offset });
                offset += kind.bytes();
            }
            ["property", ..] if elements == 1 => {
                return Err(bad(format!("line {number}: list properties are not supported")));
            }
            ["comment", "dgtr", "enu_origin_wgs84", lat, lon, alt] => header.origin = origin(lat, lon, alt),
            _ => {}
        }
    }
    Ok(header)
}

fn origin(lat: &str, lon: &str, alt: &str) -> Option<Geodetic> {
    let o = Geodetic { lat_deg: lat.parse().ok()?, lon_deg: lon.parse().ok()?, alt_m: alt.parse().ok()? };
    o.is_valid().then_some(o)
}

//! Binary glTF with KHR_gaussian_splatting (ratified by Khronos in 2026): every number exact to f32, for programs that take glTF.
//! A viewer without the extension shows coloured points.
//!
//! The vertices are the model's own (east, north, up); the node turns them into glTF's axes (y up, so north is −z). Scales are
//! metres, opacities 0…1, rotations x y z w of unit length, spherical harmonics as in the 3DGS PLY. Source: the extension's
//! README in KhronosGroup/glTF, and `splat-transform`'s writer.

use std::path::Path;

use glam::Quat;
use serde_json::{Map, Value, json};

use super::{FormatError, write_atomic};
use crate::cloud::{GaussianCloud, SH_C0};

const MAGIC: u32 = 0x4654_6C67; // "glTF"
const VERSION: u32 = 2;
const JSON_CHUNK: u32 = 0x4E4F_534A;
const BINARY_CHUNK: u32 = 0x004E_4942;
const FLOAT: u32 = 5126;
const UNSIGNED_BYTE: u32 = 5121;
const ARRAY_BUFFER: u32 = 34_962;
/// A primitive of points.
const POINTS: u32 = 0;
/// Quarter turn about east that lays north on −z and up on y; x y z w.
pub const TO_Y_UP: [f64; 4] = [-std::f64::consts::FRAC_1_SQRT_2, 0.0, 0.0, std::f64::consts::FRAC_1_SQRT_2];

/// Appends a Gaussian's part of a column.
type Put<'a> = dyn Fn(usize, &mut Vec<u8>) + 'a;

/// A column of the file: its glTF name, shape, kind of number, bytes of a Gaussian, and what writes those.
struct Column<'a> {
    name: String,
    kind: &'static str,
    component: u32,
    bytes: usize,
    put: Box<Put<'a>>,
}

/// Writes `cloud`, atomically.
///
/// # Errors
/// [`FormatError::Invalid`] for an empty cloud, numbers that are not finite, or more than the 4 GiB that a `.glb` can hold; else the
/// operating system's.
pub fn write(path: &Path, cloud: &GaussianCloud) -> Result<(), FormatError> {
    if cloud.is_empty() || !(0..cloud.len()).all(|i| cloud.is_valid(i)) {
        return Err(FormatError::invalid(
            path,
            "glTF needs Gaussians, with finite numbers only; train the model first",
        ));
    }
    let columns = columns(cloud);
    let binary: usize = columns.iter().map(|c| c.bytes * cloud.len()).sum();
    let mut json = serde_json::to_vec(&description(cloud, &columns, binary))
        .map_err(|e| FormatError::io(path, "describing", e.into()))?;
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + json.len() + 8 + binary;
    let words = [total, json.len(), binary].map(u32::try_from);
    let [Ok(total), Ok(json_bytes), Ok(binary_bytes)] = words else {
        return Err(FormatError::invalid(
            path,
            "is larger than the 4 GiB of a .glb; lower --sh-degree or export to ply",
        ));
    };
    write_atomic(path, |out| {
        for word in [MAGIC, VERSION, total, json_bytes, JSON_CHUNK] {
            out.write_all(&word.to_le_bytes())?;
        }
        out.write_all(&json)?;
        out.write_all(&binary_bytes.to_le_bytes())?;
        out.write_all(&BINARY_CHUNK.to_le_bytes())?;
        let mut row = Vec::new();
        for column in &columns {
            for i in 0..cloud.len() {
                row.clear();
                (column.put)(i, &mut row);
                out.write_all(&row)?;
            }
        }
        Ok(())
    })
}

fn columns(cloud: &GaussianCloud) -> Vec<Column<'_>> {
    let stride = cloud.sh_stride();
    let own = |name: &str| format!("KHR_gaussian_splatting:{name}");
    let mut columns = vec![
        floats("POSITION", "VEC3", 3, Box::new(|i, row| put(row, &cloud.means[i]))),
        Column {
            name: "COLOR_0".to_owned(),
            kind: "VEC4",
            component: UNSIGNED_BYTE,
            bytes: 4,
            put: Box::new(move |i, row| {
                let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
                row.extend((0..3).map(|c| byte(0.5 + SH_C0 * cloud.sh[i * stride + c])));
                row.push(byte(opacity(cloud, i)));
            }),
        },
        floats(
            &own("ROTATION"),
            "VEC4",
            4,
            Box::new(|i, row| {
                let [w, x, y, z] = cloud.rotations[i];
                put(row, &Quat::from_xyzw(x, y, z, w).normalize().to_array());
            }),
        ),
        floats(&own("SCALE"), "VEC3", 3, Box::new(|i, row| put(row, &cloud.log_scales[i].map(f32::exp)))),
        floats(&own("OPACITY"), "SCALAR", 1, Box::new(|i, row| put(row, &[opacity(cloud, i)]))),
    ];
    for degree in 0..=cloud.sh_degree {
        for n in 0..=2 * degree {
            let at = 3 * (usize::from(degree) * usize::from(degree) + usize::from(n));
            let put = move |i: usize, row: &mut Vec<u8>| put(row, &cloud.sh[i * stride + at..i * stride + at + 3]);
            columns.push(floats(&own(&format!("SH_DEGREE_{degree}_COEF_{n}")), "VEC3", 3, Box::new(put)));
        }
    }
    columns
}

fn floats<'a>(name: &str, kind: &'static str, n: usize, put: Box<Put<'a>>) -> Column<'a> {
    Column { name: name.to_owned(), kind, component: FLOAT, bytes: 4 * n, put }
}

fn opacity(cloud: &GaussianCloud, i: usize) -> f32 {
    1.0 / (1.0 + (-cloud.opacity_logits[i]).exp())
}

fn put(row: &mut Vec<u8>, values: &[f32]) {
    values.iter().for_each(|v| row.extend(v.to_le_bytes()));
}

fn description(cloud: &GaussianCloud, columns: &[Column<'_>], binary: usize) -> Value {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for m in &cloud.means {
        low = [0, 1, 2].map(|k| low[k].min(m[k]));
        high = [0, 1, 2].map(|k| high[k].max(m[k]));
    }
    let (mut views, mut accessors, mut attributes) = (Vec::new(), Vec::new(), Map::new());
    let mut at = 0;
    for (i, c) in columns.iter().enumerate() {
        let bytes = c.bytes * cloud.len();
        views.push(json!({ "buffer": 0, "byteOffset": at, "byteLength": bytes, "target": ARRAY_BUFFER }));
        let mut accessor =
            json!({ "bufferView": i, "componentType": c.component, "count": cloud.len(), "type": c.kind });
        if c.component == UNSIGNED_BYTE {
            accessor["normalized"] = json!(true);
        }
        if i == 0 {
            accessor["min"] = json!(low);
            accessor["max"] = json!(high);
        }
        accessors.push(accessor);
        attributes.insert(c.name.clone(), json!(i));
        at += bytes;
    }
    let splats = json!({
        "kernel": "ellipse",
        // Colours of pictures, not of light.
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    });
    json!({
        "asset": { "version": "2.0", "generator": concat!("dgtr ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "rotation": TO_Y_UP }],
        "meshes": [{ "primitives": [{
            "attributes": attributes,
            "mode": POINTS,
            "extensions": { "KHR_gaussian_splatting": splats },
        }] }],
        "buffers": [{ "byteLength": binary }],
        "bufferViews": views,
        "accessors": accessors,
    })
}

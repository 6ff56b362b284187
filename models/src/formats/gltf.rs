//! Binary glTF with KHR_gaussian_splatting (ratified by Khronos in 2026): every number exact to f32, for programs that take glTF.
//! A viewer without the extension shows coloured points.
//!
//! The vertices are the model's own (east, north, up); the node turns them into glTF's axes (y up, so north is −z). Scales are
//! metres, opacities 0…1, rotations x y z w of unit length, spherical harmonics as in the 3DGS PLY. Source: the extension's
//! README in KhronosGroup/glTF, and `splat-transform`'s writer.

use std::path::Path;

use glam::{DQuat, DVec3, Quat};
use serde_json::{Map, Value, json};

use super::{FormatError, read_bounded, write_atomic};
use crate::cloud::{GaussianCloud, SH_C0, ShTurn};

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

/// Numbers of a `.glb` at most: 4 GiB are all that its header counts.
const LIMIT: u64 = 1 << 32;
/// Its description at most; ours has 8 KiB.
const MAX_JSON: usize = 4 << 20;

/// Reads the Gaussians of the first mesh that has any, in the axes of this program (z up); how many rows were unusable.
///
/// # Errors
/// The file cannot be read, or holds no Gaussians as floats.
pub fn read(path: &Path) -> Result<(GaussianCloud, usize), FormatError> {
    let bad = |what: &str| FormatError::invalid(path, format!("is no glTF of Gaussians that can be read: {what}"));
    let bytes = read_bounded(path, LIMIT)?;
    let word = |at: usize| bytes.get(at..at + 4).and_then(|b| b.first_chunk()).map(|b| u32::from_le_bytes(*b));
    if word(0) != Some(MAGIC) || word(4) != Some(VERSION) || word(16) != Some(JSON_CHUNK) {
        return Err(bad("it is no binary glTF 2.0"));
    }
    let length = word(12).unwrap_or(0) as usize;
    let json = bytes.get(20..20 + length.min(MAX_JSON)).ok_or_else(|| bad("its description is cut off"))?;
    let json: Value = serde_json::from_slice(json).map_err(|e| bad(&e.to_string()))?;
    let binary = bytes.get(20 + length + 8..).unwrap_or_default();
    let mesh = |m: &Value| m["primitives"].as_array().and_then(|p| p.iter().find(|p| is_splats(p)).cloned());
    let meshes = json["meshes"].as_array().map(Vec::as_slice).unwrap_or_default();
    let found = meshes.iter().enumerate().find_map(|(i, m)| Some((i, mesh(m)?)));
    let (number, primitive) = found.ok_or_else(|| bad("no mesh has KHR_gaussian_splatting"))?;
    let attributes = &primitive["attributes"];
    let column = |name: &str, n: usize| -> Result<Vec<f32>, FormatError> {
        let own = format!("KHR_gaussian_splatting:{name}");
        let index = attributes.get(name).or_else(|| attributes.get(&own)).and_then(Value::as_u64);
        let index = index.ok_or_else(|| bad(&format!("it has no {name}")))?;
        floats_of(&json, binary, index, n).ok_or_else(|| bad(&format!("its {name} is not {n} floats a Gaussian")))
    };
    let means = column("POSITION", 3)?;
    let (rotations, scales) = (column("ROTATION", 4)?, column("SCALE", 3)?);
    let opacities = column("OPACITY", 1)?;
    let degree = (0..=3u8)
        .rev()
        .find(|d| attributes.get(format!("KHR_gaussian_splatting:SH_DEGREE_{d}_COEF_{}", 2 * d)).is_some())
        .ok_or_else(|| bad("it has no colours"))?;
    let mut harmonics = Vec::new();
    for d in 0..=degree {
        for n in 0..=2 * d {
            harmonics.push(column(&format!("SH_DEGREE_{d}_COEF_{n}"), 3)?);
        }
    }
    let count = means.len() / 3;
    let even = rotations.len() == 4 * count && scales.len() == 3 * count && opacities.len() == count;
    if !even || harmonics.iter().any(|h| h.len() != 3 * count) {
        return Err(bad("its columns differ in length"));
    }
    // The node's place, then glTF's y up to z up.
    let place =
        json["nodes"].as_array().and_then(|nodes| nodes.iter().find(|n| n["mesh"].as_u64() == Some(number as u64)));
    let numbers = |key: &str, usual: &[f64]| -> Vec<f64> {
        let given =
            place.and_then(|n| n[key].as_array()).map(|a| a.iter().filter_map(Value::as_f64).collect::<Vec<_>>());
        given.filter(|v| v.len() == usual.len() && v.iter().all(|v| v.is_finite())).unwrap_or_else(|| usual.to_vec())
    };
    if place.is_some_and(|n| n.get("matrix").is_some()) {
        return Err(bad("its node has a matrix; export it with rotation, translation and scale"));
    }
    let (q, t, s) =
        (numbers("rotation", &[0.0, 0.0, 0.0, 1.0]), numbers("translation", &[0.0; 3]), numbers("scale", &[1.0; 3]));
    if (s[0] - s[1]).abs() > 1e-6 * s[0].abs() || (s[0] - s[2]).abs() > 1e-6 * s[0].abs() || s[0] <= 0.0 {
        return Err(bad("its node scales the axes differently"));
    }
    let up = DQuat::from_array(TO_Y_UP).conjugate();
    let turn = (up * DQuat::from_xyzw(q[0], q[1], q[2], q[3]).normalize()).normalize();
    let shift = up * DVec3::new(t[0], t[1], t[2]);
    let is_turned = turn.angle_between(DQuat::IDENTITY) > 1e-6 && turn.angle_between(-DQuat::IDENTITY) > 1e-6;
    let harmonic_turn = is_turned.then(|| ShTurn::new(turn));
    let mut cloud = GaussianCloud::with_capacity(degree, count);
    let mut sh = vec![0.0; cloud.sh_stride()];
    for i in 0..count {
        let at = DVec3::new(means[3 * i].into(), means[3 * i + 1].into(), means[3 * i + 2].into()) * s[0];
        let at = if is_turned { turn * at } else { at } + shift;
        let [x, y, z, w] = [0, 1, 2, 3].map(|k| rotations[4 * i + k]);
        let own = Quat::from_xyzw(x, y, z, w);
        let own = if is_turned { turn.as_quat() * own } else { own };
        for (k, column) in harmonics.iter().enumerate() {
            sh[3 * k..3 * k + 3].copy_from_slice(&column[3 * i..3 * i + 3]);
        }
        if let Some(turn) = &harmonic_turn {
            turn.apply(degree, &mut sh);
        }
        let opacity = opacities[i].clamp(1e-7, 1.0 - 1e-7);
        let log_scale = [0, 1, 2].map(|k| (scales[3 * i + k] * s[0] as f32).ln());
        let mean = at.as_vec3().to_array();
        cloud.push(mean, log_scale, [own.w, own.x, own.y, own.z], (opacity / (1.0 - opacity)).ln(), &sh);
    }
    cloud.bring_in_limits();
    let dropped = cloud.drop_invalid();
    Ok((cloud, dropped))
}

fn is_splats(primitive: &Value) -> bool {
    primitive["extensions"].get("KHR_gaussian_splatting").is_some()
}

/// The numbers of an accessor of `n` floats a vertex, interleaved or not.
fn floats_of(json: &Value, binary: &[u8], accessor: u64, n: usize) -> Option<Vec<f32>> {
    let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"].get(n - 1)?;
    let accessor = json["accessors"].get(accessor as usize)?;
    if accessor["componentType"].as_u64()? != u64::from(FLOAT) || accessor["type"].as_str()? != *kind {
        return None;
    }
    let view = json["bufferViews"].get(accessor["bufferView"].as_u64()? as usize)?;
    let number = |v: &Value| v.as_u64().and_then(|v| usize::try_from(v).ok());
    let start = number(&view["byteOffset"]).unwrap_or(0).checked_add(number(&accessor["byteOffset"]).unwrap_or(0))?;
    let stride = number(&view["byteStride"]).unwrap_or(4 * n).max(4 * n);
    let count = number(&accessor["count"])?;
    // Checked before anything is allocated.
    let end = start.checked_add(count.checked_sub(1)?.checked_mul(stride)?)?.checked_add(4 * n)?;
    let bytes = binary.get(start..end)?;
    let rows = (0..count).flat_map(|i| (0..n).map(move |k| i * stride + 4 * k));
    rows.map(|at| Some(f32::from_le_bytes(*bytes.get(at..)?.first_chunk()?))).collect()
}

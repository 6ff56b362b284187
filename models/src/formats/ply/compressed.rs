//! PlayCanvas' compressed PLY: a word each for place, rotation, sizes and colour of a Gaussian, between the bounds of its chunk of 256.
//! Source: the engine's `gsplat-compressed-data.js`, compared with what `splat-transform` writes.

use std::io::Read;
use std::path::Path;

use super::header::{Element, Header};
use super::{FormatError, Rows};
use crate::cloud::{GaussianCloud, SH_C0, sh_coefficients};

const CHUNK: usize = 256;
/// Bounds of a chunk: places, sizes, and, in newer files, colours.
const BOUNDS: [&str; 18] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
    "min_r",
    "min_g",
    "min_b",
    "max_r",
    "max_g",
    "max_b",
];
const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];

/// Whether a header is that of a compressed file.
pub(super) fn is_compressed(header: &Header) -> bool {
    header.vertices().is_some_and(|v| v.find(WORDS[0]).is_some()) && header.element("chunk").is_some()
}

/// Reads the Gaussians of a compressed file.
///
/// # Errors
/// A property is missing, or the file ends early.
pub(super) fn read(path: &Path, header: &Header, input: &mut dyn Read) -> Result<GaussianCloud, FormatError> {
    let missing =
        |what: &str| FormatError::invalid(path, format!("is a compressed PLY without {what}; write it again"));
    let n = header.vertices().map_or(0, |v| v.count) as usize;
    let rest = header.element("sh").map_or(0, |sh| sh.properties.len());
    let Some(degree) = (0..=3u8).find(|&d| 3 * (sh_coefficients(d) - 1) == rest) else {
        return Err(FormatError::invalid(
            path,
            format!("has {rest} f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45"),
        ));
    };
    let d = sh_coefficients(degree);
    let (mut bounds, mut words, mut harmonics) = (Vec::new(), Vec::new(), Vec::new());
    for element in &header.elements {
        let mut rows = Rows::new(path, header, element, input)?;
        let find = |name: &str| element.find(name);
        match element.name.as_str() {
            "chunk" => {
                let columns: Vec<Option<usize>> = BOUNDS.iter().map(|name| find(name)).collect();
                if columns[..12].contains(&None) {
                    return Err(missing("bounds of its chunks"));
                }
                // Colours without bounds lie between black and white.
                let usual = |k: usize| if k >= 15 { 1.0 } else { 0.0 };
                while let Some(row) = rows.next()? {
                    let of = |k: usize| columns[k].map_or(usual(k), |at| row.float(at));
                    bounds.push(std::array::from_fn::<f32, 18, _>(of));
                }
            }
            "vertex" => {
                let columns = WORDS.map(find);
                let [Some(p), Some(r), Some(s), Some(c)] = columns else { return Err(missing("its packed words")) };
                while let Some(row) = rows.next()? {
                    words.push([p, r, s, c].map(|at| row.word(at)));
                }
            }
            "sh" => {
                let column = |i: usize| element.find(&format!("f_rest_{i}"));
                let columns: Option<Vec<usize>> = (0..rest).map(column).collect();
                let columns = columns.ok_or_else(|| missing("some of its f_rest"))?;
                while let Some(row) = rows.next()? {
                    harmonics.extend(columns.iter().map(|at| row.word(*at) as u8));
                }
            }
            _ => while rows.next()?.is_some() {},
        }
    }
    if bounds.len() < n.div_ceil(CHUNK) || words.len() != n || harmonics.len() != n * rest {
        return Err(missing("all of its chunks"));
    }
    let mut cloud = GaussianCloud::with_capacity(degree, n);
    let mut sh = vec![0.0; 3 * d];
    for (i, [position, rotation, scale, color]) in words.iter().enumerate() {
        let b = &bounds[i / CHUNK];
        let between =
            |from: usize, t: [f32; 3]| [0, 1, 2].map(|k| b[from + k] + (b[from + 3 + k] - b[from + k]) * t[k]);
        let mean = between(0, three(*position));
        let log_scale = between(6, three(*scale));
        let rgb = between(12, [24, 16, 8].map(|shift| unit(color >> shift, 8)));
        (0..3).for_each(|c| sh[c] = (rgb[c] - 0.5) / SH_C0);
        let opacity = unit(*color, 8).clamp(1e-6, 1.0 - 1e-6);
        for (k, c) in (1..d).flat_map(|k| (0..3).map(move |c| (k, c))) {
            // 255 levels between -4 and 4.
            sh[3 * k + c] = (f32::from(harmonics[i * rest + c * (d - 1) + k - 1]) / 255.0 - 0.5) * 8.0;
        }
        cloud.push(mean, log_scale, quaternion(*rotation), (opacity / (1.0 - opacity)).ln(), &sh);
    }
    Ok(cloud)
}

impl Element {
    fn find(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name)
    }
}

fn unit(word: u32, bits: u32) -> f32 {
    let most = (1 << bits) - 1;
    (word & most) as f32 / most as f32
}

/// 11, 10 and 11 bits.
fn three(word: u32) -> [f32; 3] {
    [unit(word >> 21, 11), unit(word >> 11, 10), unit(word, 11)]
}

/// Which component is the largest, and ten bits each of the others in the order w x y z.
fn quaternion(word: u32) -> [f32; 4] {
    let parts = [20, 10, 0].map(|shift| (unit(word >> shift, 10) - 0.5) * std::f32::consts::SQRT_2);
    let largest = (1.0 - parts.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    let mut others = parts.into_iter();
    std::array::from_fn(|i| if i == (word >> 30) as usize { largest } else { others.next().unwrap_or_default() })
}

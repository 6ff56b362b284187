//! The map as inline SVG: regions, camera positions, a scale bar; north is up.

use std::fmt::Write;

use super::ReportData;
use super::text::escape;

/// Width of the drawing, SVG units; the height follows the mission's shape within bounds.
const WIDTH: f64 = 900.0;
const HEIGHTS: std::ops::RangeInclusive<f64> = 260.0..=620.0;
const MARGIN: f64 = 36.0;

/// None when there is nothing to draw.
pub(super) fn svg(data: &ReportData) -> Option<String> {
    let points = || {
        data.map
            .iter()
            .flat_map(|r| r.corners.iter().chain(&r.cameras))
            .filter(|p| p[0].is_finite() && p[1].is_finite())
    };
    let range = |axis: usize| {
        points().map(|p| p[axis]).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
    };
    let (x, y) = (range(0), range(1));
    if x.0 > x.1 {
        return None;
    }
    let (w, h) = ((x.1 - x.0).max(1e-3), (y.1 - y.0).max(1e-3));
    let height = ((WIDTH - 2.0 * MARGIN) * h / w + 2.0 * MARGIN).clamp(*HEIGHTS.start(), *HEIGHTS.end());
    let scale = ((WIDTH - 2.0 * MARGIN) / w).min((height - 2.0 * MARGIN) / h);
    let place = |p: &[f64; 2]| {
        let u = WIDTH / 2.0 + (p[0] - 0.5 * (x.0 + x.1)) * scale;
        let v = height / 2.0 - (p[1] - 0.5 * (y.0 + y.1)) * scale;
        (u, v)
    };
    let mut out = format!(
        "<svg viewBox=\"0 0 {WIDTH} {height:.0}\" role=\"img\" aria-label=\"map of regions and camera positions\">"
    );
    let mut labels = String::new();
    for region in &data.map {
        let colour = data.colour(&region.name);
        let _ = write!(out, "<g class=\"k{colour}\">");
        if region.corners.len() >= 3 {
            out.push_str("<polygon points=\"");
            for (u, v) in region.corners.iter().map(&place) {
                let _ = write!(out, "{u:.1},{v:.1} ");
            }
            out.push_str("\"/>");
        }
        for (u, v) in region.cameras.iter().filter(|c| c[0].is_finite() && c[1].is_finite()).map(&place) {
            let _ = write!(out, "<circle cx=\"{u:.1}\" cy=\"{v:.1}\" r=\"3.5\"/>");
        }
        out.push_str("</g>");
        let of = if region.corners.is_empty() { &region.cameras } else { &region.corners };
        if let (Some(u), Some(v)) =
            (of.iter().map(|p| place(p).0).reduce(f64::min), of.iter().map(|p| place(p).1).reduce(f64::min))
        {
            // All labels follow all shapes, so that none is painted over.
            let _ = write!(labels, "<text x=\"{:.0}\" y=\"{:.0}\">{}</text>", u + 8.0, v + 20.0, escape(&region.name));
        }
    }
    out.push_str(&labels);
    let metres = round_length(150.0 / scale);
    let (left, base) = (MARGIN, height - 12.0);
    let right = left + metres * scale;
    let _ = write!(
        out,
        "<path d=\"M{left:.1} {:.1}V{base:.1}H{right:.1}V{:.1}\"/>\
         <text class=\"scale\" x=\"{:.1}\" y=\"{:.1}\">{} m, north is up</text></svg>",
        base - 5.0,
        base - 5.0,
        right + 8.0,
        base + 2.0,
        if metres >= 1.0 { format!("{metres:.0}") } else { format!("{metres}") },
    );
    Some(out)
}

/// 1, 2 or 5 times a power of ten, at most `wanted`.
fn round_length(wanted: f64) -> f64 {
    let power = 10f64.powf(wanted.log10().floor());
    [5.0, 2.0, 1.0].into_iter().map(|m| m * power).find(|l| *l <= wanted).unwrap_or(power)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scale_bars_have_round_lengths() {
        for (wanted, got) in [(1.0, 1.0), (199.0, 100.0), (200.0, 200.0), (70.0, 50.0), (0.03, 0.02)] {
            assert!((round_length(wanted) - got).abs() < 1e-12, "{wanted}");
        }
    }
}

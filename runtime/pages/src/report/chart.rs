//! A line chart as SVG, inside the page or as a file of its own: a logarithmic horizontal axis, because training time is
//! doubled, not increased, to see a difference.

use std::fmt::Write;

use super::text::escape;

const WIDTH: f64 = 900.0;
const HEIGHT: f64 = 460.0;
/// Left, top, right (the legend's place), bottom.
const MARGINS: [f64; 4] = [64.0, 40.0, 200.0, 56.0];
/// The page's own colours, spelled out so that the file also stands alone.
const COLOURS: [&str; 6] = ["#2a6fc9", "#d0622b", "#218a68", "#9150b8", "#b08a13", "#c8457a"];

/// Curves over a common pair of axes.
#[derive(Clone, Debug, Default)]
pub struct Chart {
    /// Heading.
    pub title: String,
    /// What the horizontal axis (logarithmic) shows, with its unit.
    pub x_label: String,
    /// What the vertical axis shows, with its unit.
    pub y_label: String,
    /// The curves.
    pub series: Vec<Series>,
}

/// One curve.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// Its points, from left to right.
    pub points: Vec<ChartPoint>,
    /// Drawn as a dashed line without marks.
    pub dashed: bool,
}

/// One point with the spread of what it is the mean of.
#[derive(Clone, Copy, Debug, Default)]
pub struct ChartPoint {
    /// Horizontal; not drawn unless positive.
    pub x: f64,
    /// Vertical.
    pub y: f64,
    /// Least.
    pub low: f64,
    /// Greatest.
    pub high: f64,
}

impl ChartPoint {
    fn is_drawn(&self) -> bool {
        self.x > 0.0 && [self.x, self.y, self.low, self.high].iter().all(|v| v.is_finite())
    }
}

/// Ticks 1, 2, 5 times powers of ten within a range.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    let from = low.log10().floor() as i32;
    let to = high.log10().ceil() as i32;
    let all = (from..=to).flat_map(|p| [1.0, 2.0, 5.0].map(|m| m * 10f64.powi(p)));
    all.filter(|v| (low * 0.999..=high * 1.001).contains(v)).collect()
}

/// Four to nine round ticks within a range.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let rough = (high - low) / 5.0;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= rough).unwrap_or(10.0 * power);
    let first = (low / step).ceil() as i64;
    (first..first + 12).map(|i| i as f64 * step).take_while(|v| *v <= high + 1e-9 * step).collect()
}

impl Chart {
    /// The chart as SVG; `None` when there is no point to draw. `alone`: as a file of its own, not inside a page.
    pub fn svg(&self, alone: bool) -> Option<String> {
        let drawn = || self.series.iter().flat_map(|s| s.points.iter()).filter(|p| p.is_drawn());
        let fold = |values: &mut dyn Iterator<Item = f64>| {
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
        };
        let x = fold(&mut drawn().map(|p| p.x));
        let y = fold(&mut drawn().flat_map(|p| [p.low, p.high, p.y]));
        if x.0 > x.1 {
            return None;
        }
        let (x, pad) = ((x.0 * 0.85, x.1 * 1.18), (0.06 * (y.1 - y.0)).max(0.05));
        let y = (y.0 - pad, y.1 + pad);
        let [left, top, right, bottom] = MARGINS;
        let u = |v: f64| left + (v / x.0).ln() / (x.1 / x.0).ln() * (WIDTH - left - right);
        let v = |q: f64| HEIGHT - bottom - (q - y.0) / (y.1 - y.0) * (HEIGHT - top - bottom);
        let namespace = if alone { " xmlns=\"http://www.w3.org/2000/svg\"" } else { "" };
        let title = escape(&self.title);
        let mut out = format!(
            "<svg{namespace} viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{title}\" \
             font-family=\"system-ui,DejaVu Sans,sans-serif\" font-size=\"13\" fill=\"#1d1f23\">\
             <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"#ffffff\"/>\
             <text x=\"{left}\" y=\"24\" font-size=\"16\" font-weight=\"600\">{title}</text>"
        );
        // Writing into a String cannot fail.
        let (base, end) = (HEIGHT - bottom, WIDTH - right);
        for t in log_ticks(x.0, x.1) {
            let _ = write!(
                out,
                "<path d=\"M{0:.1} {top}V{base}\" stroke=\"#e4e1db\"/><text x=\"{0:.1}\" y=\"{1}\" text-anchor=\"middle\">{t}</text>",
                u(t),
                base + 18.0
            );
        }
        for t in ticks(y.0, y.1) {
            let _ = write!(
                out,
                "<path d=\"M{left} {0:.1}H{end}\" stroke=\"#e4e1db\"/><text x=\"{1}\" y=\"{2:.1}\" text-anchor=\"end\">{3}</text>",
                v(t),
                left - 8.0,
                v(t) + 4.0,
                (t * 1e6).round() / 1e6
            );
        }
        let _ = write!(
            out,
            "<text x=\"{:.0}\" y=\"{}\" text-anchor=\"middle\">{}</text>\
             <text transform=\"translate(18 {:.0}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            0.5 * (left + end),
            HEIGHT - 14.0,
            escape(&self.x_label),
            0.5 * (top + base),
            escape(&self.y_label)
        );
        for (i, s) in self.series.iter().enumerate() {
            let colour = if s.dashed { "#7b818b" } else { COLOURS[i % COLOURS.len()] };
            let dash = if s.dashed { " stroke-dasharray=\"6 5\"" } else { "" };
            let points: Vec<&ChartPoint> = s.points.iter().filter(|p| p.is_drawn()).collect();
            let line: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", u(p.x), v(p.y))).collect();
            let _ = write!(
                out,
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"{dash}/>",
                line.join(" ")
            );
            for p in points.iter().filter(|_| !s.dashed) {
                let (cx, cy) = (u(p.x), v(p.y));
                let _ = write!(
                    out,
                    "<path d=\"M{cx:.1} {:.1}V{:.1}\" stroke=\"{colour}\"/><circle cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"4\" fill=\"{colour}\"/>",
                    v(p.low),
                    v(p.high)
                );
            }
            let at = top + 12.0 + 20.0 * i as f64;
            let _ = write!(
                out,
                "<path d=\"M{0} {at:.0}H{1}\" stroke=\"{colour}\" stroke-width=\"2\"{dash}/><text x=\"{2}\" y=\"{3:.0}\">{4}</text>",
                end + 12.0,
                end + 36.0,
                end + 44.0,
                at + 4.0,
                escape(&s.name)
            );
        }
        out.push_str("</svg>");
        Some(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_have_round_ticks_inside_their_range() {
        assert_eq!(log_ticks(18.0, 210.0), [20.0, 50.0, 100.0, 200.0]);
        assert_eq!(ticks(19.0, 23.1), [19.0, 20.0, 21.0, 22.0, 23.0]);
    }

    #[test]
    fn strange_points_are_left_out_and_nothing_is_no_chart() {
        let mut chart = Chart { title: "a < b".into(), ..Chart::default() };
        assert_eq!(chart.svg(false), None);
        let at = |x, y| ChartPoint { x, y, low: y, high: y };
        let points = vec![at(0.0, 1.0), at(10.0, 20.0), at(20.0, f64::NAN), at(40.0, 22.0)];
        chart.series.push(Series { name: "s".into(), points, dashed: false });
        let svg = chart.svg(true).unwrap();
        assert_eq!(svg.matches("<circle").count(), 2);
        assert!(svg.contains("a &lt; b") && svg.contains("xmlns") && !svg.contains("NaN"));
        assert!(!chart.svg(false).unwrap().contains("http"));
    }
}

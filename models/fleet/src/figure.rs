//! A figure of who flies where, as SVG.

use std::fmt::Write as _;
use std::io::{self, Write};

use glam::DVec2;

use crate::deal::Share;
use crate::ground::{Ground, Ring};
use crate::sortie::Craft;

/// Width of the figure and what is left around the area, pixels.
const WIDTH: f64 = 900.0;
const MARGIN: f64 = 30.0;
/// Colours that most people can tell apart (Okabe and Ito 2008), without black.
const COLORS: [&str; 7] = ["#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7"];

/// Places in pixels.
struct Paper {
    low: DVec2,
    high: DVec2,
    scale: f64,
}

impl Paper {
    fn at(&self, p: DVec2) -> String {
        let (x, y) = ((p.x - self.low.x) * self.scale + MARGIN, (self.high.y - p.y) * self.scale + MARGIN);
        format!("{x:.1} {y:.1}")
    }

    fn ring(&self, ring: &Ring) -> String {
        let corners: Vec<String> = ring.iter().map(|p| self.at(*p)).collect();
        format!("M{}Z", corners.join("L"))
    }

    fn ground(&self, ground: &Ground) -> String {
        ground.rings().map(|ring| self.ring(ring)).collect()
    }
}

/// Writes regions, lines and take-off places.
///
/// # Errors
/// Errors of `out`.
pub fn write(out: &mut dyn Write, craft: &[Craft], shares: &[Share]) -> io::Result<()> {
    let flown = craft.iter().zip(shares);
    let ways = flown.flat_map(|(craft, share)| share.sorties.iter().flat_map(|sortie| sortie.path(craft.home)));
    let corners = shares.iter().flat_map(|s| s.ground.bounds());
    let all = ways.chain(corners).filter(|p| p.is_finite());
    let (low, high) = all.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, h), p| (l.min(p), h.max(p)));
    let size = (high - low).max(DVec2::ONE);
    let paper = Paper { low, high, scale: (WIDTH - 2.0 * MARGIN) / size.max_element() };
    let [width, height] = [size.x, size.y].map(|m| m * paper.scale + 2.0 * MARGIN);
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {:.0}\" font-family=\"sans-serif\" font-size=\"13\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        height + 30.0
    );
    for (k, (craft, share)) in craft.iter().zip(shares).enumerate() {
        let color = COLORS[k % COLORS.len()];
        let _ = writeln!(
            text,
            "<path d=\"{}\" fill=\"{color}\" fill-opacity=\"0.35\" fill-rule=\"evenodd\" stroke=\"{color}\"/>",
            paper.ground(&share.ground)
        );
        for sortie in &share.sorties {
            let way: Vec<String> = sortie.path(craft.home).into_iter().map(|p| paper.at(p)).collect();
            let _ = writeln!(
                text,
                "<path d=\"M{}\" fill=\"none\" stroke=\"{color}\" stroke-dasharray=\"2 4\"/>",
                way.join("L")
            );
            for line in &sortie.lines {
                let _ = writeln!(
                    text,
                    "<path d=\"M{}L{}\" stroke=\"{color}\" stroke-width=\"2\"/>",
                    paper.at(line.from),
                    paper.at(line.to)
                );
            }
        }
        let place = |p: DVec2| paper.at(p).replacen(' ', "\" y=\"", 1);
        let name = &craft.id;
        let minutes = share.seconds() / 60.0;
        let _ = writeln!(
            text,
            "<text x=\"{}\" text-anchor=\"middle\">{name}, {minutes:.1} min</text>",
            place(share.ground.middle())
        );
        let _ = writeln!(text, "<circle cx=\"{}\" r=\"5\"/>", paper.at(craft.home).replacen(' ', "\" cy=\"", 1));
    }
    // The longest round length that fits into a quarter of the figure.
    let most = 0.25 * WIDTH / paper.scale;
    let power = 10f64.powf(most.log10().floor());
    let metres = [5.0, 2.0, 1.0].into_iter().map(|m| m * power).find(|m| *m <= most).unwrap_or(power);
    let (x, y) = (MARGIN, height + 10.0);
    let _ = writeln!(text, "<path d=\"M{x} {y}h{:.1}\" stroke=\"black\" stroke-width=\"3\"/>", metres * paper.scale);
    let _ = writeln!(
        text,
        "<text x=\"{x}\" y=\"{:.1}\">{metres} m, north is up; dots are take-off places</text>\n</svg>",
        y + 15.0
    );
    out.write_all(text.as_bytes())
}

//! A survey pattern: parallel lines over a region, spaced by the wanted overlap of the pictures' footprints.

use glam::{DVec2, DVec3};

/// How a region is flown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurveySettings {
    /// Height of the camera above z = 0, metres.
    pub height_m: f64,
    /// Speed along the lines, m/s.
    pub speed_ms: f64,
    /// Share of a picture's length seen again by the next one on the line, 0..1.
    pub forward_overlap: f64,
    /// Share of a picture's width seen again from the next line, 0..1.
    pub side_overlap: f64,
    /// Direction of the lines, degrees clockwise from north; `None` = along the region's longest edge.
    pub heading_deg: Option<f64>,
    /// A second set of lines across the first one (a double grid).
    pub cross: bool,
    /// How far the lines reach beyond the region at both ends, metres.
    pub margin_m: f64,
    /// Pitch of the camera, degrees; −90 looks straight down.
    pub gimbal_pitch_deg: f64,
}

impl Default for SurveySettings {
    fn default() -> Self {
        Self {
            height_m: 40.0,
            speed_ms: 5.0,
            forward_overlap: 0.75,
            side_overlap: 0.6,
            heading_deg: None,
            cross: false,
            margin_m: 0.0,
            gimbal_pitch_deg: -90.0,
        }
    }
}

/// One straight line with its exposures.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Start, metres east and north.
    pub from: DVec2,
    /// End.
    pub to: DVec2,
    /// Where pictures are taken, metres from the start, ascending.
    pub exposures: Vec<f64>,
}

/// A flight from waypoint to waypoint instead of a survey.
#[derive(Clone, Debug, PartialEq)]
pub struct Route {
    /// In flying order; the first is where the flight begins.
    pub waypoints: Vec<Waypoint>,
    /// Speed between them, m/s.
    pub speed_ms: f64,
    /// Pitch of the camera, degrees; −90 looks straight down.
    pub gimbal_pitch_deg: f64,
}

/// One of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Waypoint {
    /// Metres east, north, up.
    pub position: DVec3,
    /// Heading to be taken before a picture, degrees clockwise from north; `None` = as it flies.
    pub yaw_deg: Option<f64>,
    /// Whether a picture is taken there.
    pub picture: bool,
    /// Metres between two pictures on the way from there to the next one, the first of them there; `None` = none are taken.
    pub every_m: Option<f64>,
}

/// The lines over `region` (corners in metres east and north), in flying order; empty when the region has no area.
///
/// `footprint`: width across and length along the track of one picture on the ground, metres.
pub fn lines(region: &[DVec2], footprint: DVec2, settings: &SurveySettings) -> Vec<Line> {
    let heading = match settings.heading_deg {
        Some(degrees) => degrees.to_radians(),
        None => {
            let edges = (0..region.len()).map(|k| region[(k + 1) % region.len()] - region[k]);
            edges.max_by(|a, b| a.length_squared().total_cmp(&b.length_squared())).map_or(0.0, |e| e.x.atan2(e.y))
        }
    };
    let mut all = one_grid(region, heading, footprint, settings);
    if settings.cross {
        all.extend(one_grid(region, heading + std::f64::consts::FRAC_PI_2, footprint, settings));
    }
    all
}

fn one_grid(region: &[DVec2], heading: f64, footprint: DVec2, settings: &SurveySettings) -> Vec<Line> {
    let along = DVec2::new(heading.sin(), heading.cos());
    let across = DVec2::new(along.y, -along.x);
    let spacing = (footprint.x * (1.0 - settings.side_overlap)).max(0.5);
    let step = (footprint.y * (1.0 - settings.forward_overlap)).max(0.25);
    let reach = |axis: DVec2| {
        region.iter().map(|p| p.dot(axis)).fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
    };
    let (low, high) = reach(across);
    if region.len() < 3 || !(high - low).is_finite() || high - low < 1e-6 {
        return Vec::new();
    }
    let count = ((high - low) / spacing - 1e-6).ceil().clamp(1.0, 1000.0);
    let spacing = (high - low) / count;
    let mut found = Vec::new();
    for k in 0..count as usize {
        let offset = low + (k as f64 + 0.5) * spacing;
        // Where the polygon's edges cross this line; a concave region is flown from the first to the last crossing.
        let crossings = (0..region.len()).filter_map(|i| {
            let (a, b) = (region[i], region[(i + 1) % region.len()]);
            let (da, db) = (a.dot(across) - offset, b.dot(across) - offset);
            (da * db < 0.0).then(|| (a + (b - a) * (da / (da - db))).dot(along))
        });
        let (first, last) = crossings.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if first + 1e-6 > last {
            continue;
        }
        let (first, last) = (first - settings.margin_m, last + settings.margin_m);
        let length = last - first;
        let shots = (length / step + 1e-6).floor() as usize + 1;
        let start = 0.5 * (length - (shots - 1) as f64 * step);
        let exposures = (0..shots).map(|n| start + n as f64 * step).collect();
        let (from, to) = (across * offset + along * first, across * offset + along * last);
        let (from, to) = if found.len() % 2 == 0 { (from, to) } else { (to, from) };
        found.push(Line { from, to, exposures });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(side: f64) -> Vec<DVec2> {
        vec![DVec2::ZERO, DVec2::new(side, 0.0), DVec2::new(side, side), DVec2::new(0.0, side)]
    }

    #[test]
    fn lines_cover_the_region_with_the_asked_overlap_in_turns() {
        let settings = SurveySettings { heading_deg: Some(0.0), ..SurveySettings::default() };
        let lines = lines(&square(60.0), DVec2::new(50.0, 40.0), &settings);
        assert_eq!(lines.len(), 3);
        for pair in lines.windows(2) {
            assert!((pair[1].from.x - pair[0].to.x).abs() <= 20.0 + 1e-9, "side overlap");
            assert!((pair[1].from.y - pair[0].to.y).abs() < 1e-9, "the next line starts where this one ends");
        }
        assert!(
            lines.iter().all(|l| l.exposures.len() == 7 && l.exposures.windows(2).all(|w| w[1] - w[0] <= 10.0 + 1e-9))
        );
    }

    #[test]
    fn a_double_grid_doubles_the_lines_and_a_flat_region_has_none() {
        let settings = SurveySettings { cross: true, ..SurveySettings::default() };
        assert_eq!(lines(&square(60.0), DVec2::new(50.0, 40.0), &settings).len(), 6);
        assert!(lines(&[DVec2::ZERO, DVec2::X, DVec2::X * 2.0], DVec2::new(50.0, 40.0), &settings).is_empty());
        assert!(lines(&[], DVec2::new(50.0, 40.0), &settings).is_empty());
    }
}

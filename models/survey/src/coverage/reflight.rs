//! Which pictures would close the gaps of a flight: places at its height, each chosen for how much of what is missing it brings,
//! until nothing is missing. The order is by the nearest neighbour, gap after gap.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use config::coverage::CoverageSettings;
use glam::{DVec2, DVec3};

use super::frustum::{Frustum, Seen};
use super::gaps::Gap;
use super::{CoverageMap, State};
use models::camera::{Intrinsics, Pose, View};
use models::formats::telemetry::dji_rotation;

/// Cameras that look down more steeply than this are planned to look straight down, degrees below the horizon.
const STRAIGHT_DOWN: f64 = 75.0;
/// What is believed to be in the picture although the wind moves the aircraft and its gimbal: of a picture straight down the disc
/// that shows the same ground whichever way the aircraft heads, of others all but this share at each edge. At 40 m a picture of
/// 50 m by 40 m keeps 3 m all around: ArduCopter's WPNAV_RADIUS is 2 m.
const DISC: f64 = 0.85;
const EDGE: f64 = 0.08;
/// Angles are planned this much wider than they must be.
const ANGLE_RESERVE: f32 = 1.15;
/// Places to choose from lie this share of a picture's shorter side apart, or as far as key frames must.
const SPACING: f64 = 0.2;
/// Key frames must lie this much further apart than the least they may.
const SPACING_RESERVE: f64 = 1.2;
/// Most places to choose from for one gap: they lie further apart in larger ones.
const MOST_PLACES: f64 = 4096.0;
/// Most pictures of one re-flight: an hour's worth.
pub const MOST_STATIONS: usize = 1000;

/// Where one picture is to be taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Station {
    /// Camera centre, metres east, north, up.
    pub center: DVec3,
    /// Heading of the camera, degrees clockwise from north; `None` where any will do.
    pub yaw_deg: Option<f64>,
}

/// A flight that closes gaps.
#[derive(Clone, Debug, PartialEq)]
pub struct Reflight {
    /// In flying order.
    pub stations: Vec<Station>,
    /// Pitch of the camera, degrees; −90 looks straight down.
    pub pitch_deg: f64,
    /// Gaps that it does not close altogether: the next one will.
    pub gaps_left: usize,
}

/// How the flight was flown, and so will this one be.
struct Manner {
    lens: Intrinsics,
    height_m: f64,
    pitch_deg: f64,
    headings: Vec<f64>,
    seen: Seen,
}

impl Manner {
    /// The middle of what was flown.
    fn of(flown: &[View]) -> Option<Self> {
        let flown: Vec<&View> = flown.iter().filter(|v| v.is_usable()).collect();
        let middle = |value: fn(&View) -> f64| {
            let mut values: Vec<(f64, usize)> = flown.iter().enumerate().map(|(i, v)| (value(v), i)).collect();
            values.sort_by(|a, b| a.0.total_cmp(&b.0));
            values.get(values.len() / 2).copied()
        };
        let (height_m, typical) = middle(|v| v.pose.center.z)?;
        let (pitch, _) = middle(|v| v.pose.forward().normalize().z.clamp(-1.0, 1.0).asin())?;
        let right = flown[typical].pose.rotation * DVec3::X;
        let heading = (-right.y).atan2(right.x).to_degrees();
        let lens = flown[typical].intrinsics;
        let pitch_deg = pitch.to_degrees();
        Some(match pitch_deg < -STRAIGHT_DOWN {
            true => Self { lens, height_m, pitch_deg: -90.0, headings: vec![heading], seen: Seen::Disc(DISC) },
            false => {
                let headings = [0.0, 90.0, 180.0, 270.0].map(|turn| (heading + turn).rem_euclid(360.0)).into();
                Self { lens, height_m, pitch_deg, headings, seen: Seen::Inner(EDGE) }
            }
        })
    }

    fn view(&self, center: DVec3, heading: f64) -> View {
        let pose = Pose { rotation: dji_rotation(heading, self.pitch_deg, 0.0), center };
        View { intrinsics: self.lens, pose }
    }

    fn station(&self, center: DVec3, heading: f64) -> Station {
        Station { center, yaw_deg: matches!(self.seen, Seen::Inner(_)).then_some(heading) }
    }
}

/// The pictures that close `gaps` of `map`, flown as `flown` were, no closer together than `least_m`; `None` when nothing was
/// flown or nothing is missing.
pub fn plan(map: &CoverageMap, gaps: &[Gap], flown: &[View], least_m: f64) -> Option<Reflight> {
    let manner = Manner::of(flown).filter(|_| !gaps.is_empty())?;
    let rules = CoverageSettings { angle_deg: map.rules().angle_deg * ANGLE_RESERVE, ..*map.rules() };
    let mut trial = CoverageMap { rules, ..map.clone() };
    let mut here = flown.first()?.pose.center.truncate();
    let (mut stations, mut left) = (Vec::new(), 0);
    let mut open: Vec<&Gap> = gaps.iter().collect();
    while let Some(gap) = take_nearest(&mut open, here, |g| g.middle) {
        let room = MOST_STATIONS - stations.len();
        let mut chosen = close(&mut trial, gap, &manner, least_m, room);
        left += usize::from(is_open(&trial, gap));
        while let Some(station) = take_nearest(&mut chosen, here, |s| s.center.truncate()) {
            here = station.center.truncate();
            stations.push(station);
        }
    }
    (!stations.is_empty()).then_some(Reflight { stations, pitch_deg: manner.pitch_deg, gaps_left: left })
}

fn is_open(map: &CoverageMap, gap: &Gap) -> bool {
    let states = gap.squares.iter().filter_map(|&i| map.cell_at(i as usize));
    states.into_iter().any(|c| c.state != State::Covered)
}

fn take_nearest<T>(items: &mut Vec<T>, here: DVec2, place: impl Fn(&T) -> DVec2) -> Option<T> {
    let distances = items.iter().map(|item| place(item).distance_squared(here)).enumerate();
    let (at, _) = distances.min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(items.swap_remove(at))
}

/// Chooses for one gap, the picture that brings most first. What a picture brings only shrinks as others are taken (but for a
/// few angles), so that most need not be asked again (lazy greedy: Minoux 1978).
fn close(map: &mut CoverageMap, gap: &Gap, manner: &Manner, least_m: f64, room: usize) -> Vec<Station> {
    let mut wanted = vec![false; map.cells.len()];
    gap.squares.iter().for_each(|&i| wanted[i as usize] = true);
    let gain = |map: &CoverageMap, frustum: &Frustum| {
        map.in_reach(frustum).filter(|&i| wanted[i]).map(|i| map.gain(i, frustum)).sum::<u32>()
    };
    let places = places(map, gap, manner, least_m);
    let frusta: Vec<(Station, Frustum)> = places
        .iter()
        .flat_map(|&center| manner.headings.iter().map(move |&heading| (center, heading)))
        .filter_map(|(center, heading)| {
            Some((manner.station(center, heading), Frustum::of(&manner.view(center, heading), manner.seen)?))
        })
        .collect();
    let mut best: BinaryHeap<(u32, Reverse<usize>)> =
        frusta.iter().enumerate().map(|(i, (_, frustum))| (gain(map, frustum), Reverse(i))).collect();
    let mut chosen = Vec::new();
    while let Some((_, Reverse(i))) = best.pop()
        && chosen.len() < room
    {
        let (station, frustum) = &frusta[i];
        let now = gain(map, frustum);
        if best.peek().is_some_and(|next| next.0 > now) {
            best.push((now, Reverse(i)));
        } else if now == 0 {
            break;
        } else {
            map.note(frustum);
            chosen.push(*station);
        }
    }
    chosen
}

/// Places from which a picture may show some of the gap: a lattice that is the same for all gaps of a map.
fn places(map: &CoverageMap, gap: &Gap, manner: &Manner, least_m: f64) -> Vec<DVec3> {
    let grid = map.grid();
    let middles = gap.squares.iter().map(|&i| map.point(i as usize));
    let (low, high) = middles.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, h), p| (l.min(p), h.max(p)));
    let over = manner.height_m - 0.5 * (low.z + high.z);
    if over <= 0.0 {
        return Vec::new();
    }
    // What the optical axis and the picture's half reach ahead and aside of the camera.
    let k = &manner.lens;
    let slant = over / manner.pitch_deg.to_radians().sin().abs().max(0.25);
    let half = 0.5 * slant * f64::from(k.width).min(k.height.into()) / f64::from(k.fx.max(k.fy));
    let ahead = (slant * slant - over * over).max(0.0).sqrt();
    let (low, high) = (low.truncate() - half - ahead, high.truncate() + half + ahead);
    let size = high - low;
    let spacing = (least_m * SPACING_RESERVE).max(SPACING * 2.0 * half).max((size.x * size.y / MOST_PLACES).sqrt());
    let index = |v: DVec2| ((v - grid.corner) / spacing).round();
    let (from, to) = (index(low), index(high));
    let mut found = Vec::new();
    for row in from.y as i64..=to.y as i64 {
        for column in from.x as i64..=to.x as i64 {
            let place = grid.corner + spacing * DVec2::new(column as f64, row as f64);
            found.push(place.extend(manner.height_m));
        }
    }
    found
}

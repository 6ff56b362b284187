//! `dgtr survey` on three areas: dealt to fleets, written, read back and flown by the simulated aircraft, without its pictures.
#![cfg(feature = "lab")]
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "surveys/fences.rs"]
mod fences;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use config::coverage::CoverageSettings;
use config::ground::GroundSettings;
use config::mission::{Aircraft, KeyframeSettings, Mission};
use disk::Disk;
use flight::coverage::route;
use geometry::geodesy::{EnuFrame, Geodetic};
use geometry::polygon;
use glam::{DVec2, DVec3};
use ground::jobs::aggregate;
use ground::jobs::serve::admit::admit;
use ground::member::Member;
use models::camera::{Intrinsics, Pose, View};
use models::cloud::GaussianCloud;
use models::formats::flight_plan;
use models::formats::model::{self, ModelHeader};
use runtime::survey_job::{self, Camera, Flying, MISSION, Pictures, Planned, Request, Rest, Source};
use serde::Deserialize;
use sim::aircraft::Imperfections;
use sim::autopilot::AutopilotSettings;
use sim::reference::{Lens, flown_views};
use sim::survey::SurveySettings;
use sim::world::WorldSettings;
use sim::{SessionSettings, SimSettings};
use survey::coverage::{CoverageMap, CoverageRegion, State};
use survey::ortho::crs::Crs;
use survey::ortho::files::{MapFiles, NO_HEIGHT, Pixels};
use survey::ortho::grid::Grid;

const PLACE: Geodetic = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };
const CAMERA: Camera = Camera { picture: [4000, 3000], fov_deg: 60.0 };
const GSD_M: f64 = 0.025;
const CLEARANCE_M: f64 = 10.0;
/// A hole of the yard.
const HOLE: [[f64; 2]; 4] = [[80.0, 80.0], [160.0, 80.0], [160.0, 140.0], [80.0, 140.0]];

/// Longitude and latitude of places around [`PLACE`].
fn degrees(places: &[DVec2]) -> Vec<[f64; 2]> {
    let frame = EnuFrame::new(PLACE);
    let at = |p: &DVec2| frame.to_geodetic(DVec3::new(p.x, p.y, 0.0));
    places.iter().map(at).map(|g| [g.lon_deg, g.lat_deg]).collect()
}

fn corners(list: &[[f64; 2]]) -> Vec<DVec2> {
    list.iter().map(|c| DVec2::from(*c)).collect()
}

/// A convex field of 20 ha as GeoJSON.
fn field() -> String {
    let mut ring = degrees(&corners(&[[0.0, 0.0], [440.0, -40.0], [590.0, 190.0], [400.0, 430.0], [60.0, 350.0]]));
    ring.push(ring[0]);
    format!(
        r#"{{"type":"Feature","properties":{{"name":"field"}},"geometry":{{"type":"Polygon","coordinates":[{ring:?}]}}}}"#
    )
}

/// An L with a hole as KML.
fn yard() -> String {
    let ring = |list: &[[f64; 2]]| {
        let all: Vec<String> = degrees(&corners(list)).iter().map(|[lon, lat]| format!("{lon},{lat},0")).collect();
        format!("<LinearRing><coordinates>{}</coordinates></LinearRing>", all.join(" "))
    };
    let outside = ring(&[[0.0, 0.0], [640.0, 0.0], [640.0, 220.0], [240.0, 220.0], [240.0, 560.0], [0.0, 560.0]]);
    let hole = ring(&HOLE);
    format!(
        "<kml xmlns='http://www.opengis.net/kml/2.2'><Placemark><name>yard</name><Polygon><outerBoundaryIs>{outside}</outerBoundaryIs>\
         <innerBoundaryIs>{hole}</innerBoundaryIs></Polygon></Placemark></kml>"
    )
}

/// Three kilometres of a river that bends, as the fence of a plan.
fn river() -> String {
    let middle = |k: f64| DVec2::new(k * 2700.0, 420.0 * (k * 5.0).sin());
    let bank = |k: i32, side: f64| {
        let (a, b) = (middle(f64::from(k) / 40.0), middle((f64::from(k) + 0.5) / 40.0));
        a + (b - a).normalize().perp() * side
    };
    let banks: Vec<DVec2> = (0..=40).map(|k| bank(k, -60.0)).chain((0..=40).rev().map(|k| bank(k, 60.0))).collect();
    let ring: Vec<[f64; 2]> = degrees(&banks).into_iter().map(|[lon, lat]| [lat, lon]).collect();
    format!(
        r#"{{"fileType":"Plan","geoFence":{{"circles":[],"polygons":[{{"inclusion":true,"polygon":{ring:?},"version":1}}],"version":2}}}}"#
    )
}

fn request(area: &Path, count: usize) -> Request {
    Request {
        source: Source::File(area.to_owned()),
        name: "survey".into(),
        aircraft: (1..=count).map(|k| (format!("a{k}"), "udpin:127.0.0.1:14550".into())).collect(),
        camera: CAMERA,
        pictures: Pictures { gsd_m: GSD_M, forward_overlap: 0.75, side_overlap: 0.65, interval_s: 1.0 },
        flying: Flying {
            speed_m_s: 8.0,
            fastest_m_s: 15.0,
            wind_m_s: 5.0,
            endurance_min: vec![25.0],
            reserve: 0.25,
            take_off: Vec::new(),
            highest_m: 150.0,
            clearance_m: CLEARANCE_M,
        },
        home_m: PLACE.alt_m,
        terrain: None,
    }
}

/// What QGroundControl asks for when it opens a plan (`PlanMasterController`, `MissionController`, `SimpleMissionItem`).
#[derive(Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
#[allow(dead_code, reason = "that it is there is what counts")]
struct PlanFile {
    file_type: String,
    ground_station: String,
    version: u32,
    geo_fence: serde_json::Value,
    rally_points: serde_json::Value,
    mission: PlanMission,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
#[allow(dead_code, reason = "that it is there is what counts")]
struct PlanMission {
    version: u32,
    firmware_type: u32,
    vehicle_type: u32,
    global_plan_altitude_mode: u32,
    cruise_speed: f64,
    hover_speed: f64,
    planned_home_position: [f64; 3],
    items: Vec<PlanItem>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(non_snake_case, dead_code, reason = "names of QGroundControl")]
struct PlanItem {
    #[serde(rename = "type")]
    kind: String,
    command: u32,
    frame: u32,
    params: [Option<f64>; 7],
    autoContinue: bool,
    doJumpId: usize,
    AMSLAltAboveTerrain: Option<f64>,
    Altitude: Option<f64>,
    AltitudeMode: Option<u32>,
}

/// The plan by other types than ours: its items are numbered, begin with a take-off and end with a landing where it took off.
fn opened(path: &Path) {
    let file: PlanFile =
        serde_json::from_slice(&std::fs::read(path).expect("a plan")).expect("QGroundControl's members");
    let items = &file.mission.items;
    assert!(items.iter().enumerate().all(|(k, item)| item.doJumpId == k + 1 && item.kind == "SimpleItem"));
    assert_eq!((items[0].command, items[items.len() - 1].command), (22, 21), "{}", path.display());
    let home = file.mission.planned_home_position;
    let landing = items[items.len() - 1].params;
    assert!((0..2).all(|k| landing[4 + k].is_some_and(|v| (v - home[k]).abs() < 1e-6)) && landing[6] == Some(0.0));
}

/// How near a plan leads to the yard's hole, from take-off to landing.
fn from_hole_m(path: &Path) -> f64 {
    let plan = flight_plan::read(path).expect("a plan");
    let frame = EnuFrame::new(PLACE);
    let ways = std::iter::once(plan.home).chain(plan.waypoints.iter().map(|w| w.position)).chain(plan.landing);
    let ways: Vec<DVec2> = ways.map(|at| frame.to_enu(at).truncate()).collect();
    let places = ways.windows(2).flat_map(|w| {
        let steps = w[0].distance(w[1]).ceil().max(1.0);
        (0..=steps as usize).map(move |k| w[0].lerp(w[1], k as f64 / steps))
    });
    // A rectangle along the axes.
    let [low, high] = [HOLE[0], HOLE[2]].map(DVec2::from);
    places.map(|p| (p - p.clamp(low, high)).length()).fold(f64::MAX, f64::min)
}

/// The true views of a plan's flight, in wind and with the errors of a simulated aircraft.
fn flown(plan: &Path, mission: &Mission, seed: u64) -> Vec<View> {
    let plan = flight_plan::read(plan).expect("a plan");
    let c = &mission.camera;
    let lens =
        Lens { width: c.width, height: c.height, fx: c.fx.into(), fy: c.fy.into(), cx: c.cx.into(), cy: c.cy.into() };
    let settings = SimSettings {
        world_seed: 1,
        seed,
        world: WorldSettings::default(),
        origin: mission.origin,
        lens,
        region: Vec::new(),
        survey: SurveySettings::default(),
        route: Some(route(&plan, mission.origin, -90.0)),
        imperfections: Imperfections::default(),
        autopilot: AutopilotSettings::default(),
        session: SessionSettings::default(),
        prefix: String::new(),
    };
    let flight = settings.flight().expect("a flight");
    let intrinsics = Intrinsics { width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
    let views = flown_views(&flight, &lens);
    views.into_iter().map(|v| View { intrinsics, pose: Pose { rotation: v.rotation, center: v.position } }).collect()
}

/// Share of the area that is covered by the rules and at the asked ground sampling distance: no more than a twentieth coarser, as
/// ground between two lines is seen from the side.
fn covered(regions: &[Vec<DVec2>], views: &[View]) -> f64 {
    let (mut good, mut all) = (0.0, 0.0);
    for region in regions {
        let region = CoverageRegion::new(region.clone()).expect("a region");
        let mut map = CoverageMap::new(&region, 0.0, CoverageSettings { cell_m: 3.0, ..CoverageSettings::default() })
            .expect("a map");
        views.iter().for_each(|view| map.add(view));
        let grid = *map.grid();
        for (column, row) in (0..grid.rows).flat_map(|row| (0..grid.columns).map(move |column| (column, row))) {
            let Some(cell) = map.cell(column, row) else { continue };
            all += grid.cell_m2();
            if cell.state == State::Covered && cell.gsd_m.is_some_and(|gsd| gsd <= 1.05 * GSD_M) {
                good += grid.cell_m2();
            }
        }
    }
    good / all
}

/// Everything that a survey promises of a folder.
fn kept(name: &str, out: &Path, planned: &Planned, hectares: f64) {
    let mission = Mission::read(&out.join(MISSION)).expect("a mission");
    let regions: Vec<Vec<DVec2>> =
        mission.aircraft.iter().map(|a| mission.region(a).into_iter().map(DVec2::from).collect()).collect();
    // Once: the areas add up, and no place has two owners.
    let sum: f64 = regions.iter().map(|r| polygon::signed_area(r)).sum::<f64>() / 1e4;
    assert!((sum / hectares - 1.0).abs() < 1e-3, "{name}: {sum} of {hectares} ha");
    assert!((planned.hectares / hectares - 1.0).abs() < 1e-3, "{name}: {} ha", planned.hectares);
    let every = regions.iter().flatten();
    let (low, high) = every.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, h), p| (l.min(*p), h.max(*p)));
    let (mut owned, mut twice) = (0, 0);
    for k in 0..4000u32 {
        let share = DVec2::new(f64::from(k) / 4000.0, f64::from(k.reverse_bits()) / f64::from(u32::MAX));
        let owners = regions.iter().filter(|r| polygon::contains(r, low + (high - low) * share)).count();
        owned += usize::from(owners > 0);
        twice += usize::from(owners > 1);
    }
    assert!(owned > 100 && twice * 1000 <= owned, "{name}: {twice} of {owned} places have two owners");
    assert_eq!(planned.holes, usize::from(name.starts_with("yard")), "{name}");
    let minutes: Vec<f64> = mission
        .aircraft
        .iter()
        .map(|a| planned.rows.iter().filter(|r| r.aircraft == a.id).map(|r| r.minutes).sum())
        .collect();
    let (least, most) = minutes.iter().fold((f64::MAX, 0.0f64), |(l, m), v| (l.min(*v), m.max(*v)));
    assert!(least > 0.9 * most, "{name}: {minutes:.1?} min");
    let mut views = Vec::new();
    for (k, row) in planned.rows.iter().enumerate() {
        assert!(row.minutes < 25.0 * 0.75 + 1e-6 && row.side_overlap > 0.65 - 1e-6, "{name}: {row:?}");
        opened(&row.plan);
        if planned.holes > 0 {
            let off = from_hole_m(&row.plan);
            assert!(off >= CLEARANCE_M - 0.02, "{name}: {off} m from the hole: {row:?}");
        }
        let taken = flown(&row.plan, &mission, k as u64);
        // At a line's end a centimetre decides over a picture.
        let off = taken.len().abs_diff(row.pictures);
        assert!(30 * off <= row.pictures, "{name}: {} pictures, not {row:?}", taken.len());
        views.extend(taken);
    }
    let share = covered(&regions, &views);
    println!(
        "{name}: {minutes:.1?} min, {} sorties, {} pictures, covered {:.2} %",
        planned.rows.len(),
        views.len(),
        100.0 * share
    );
    assert!(share >= 0.99, "{name}: {:.2} % covered", 100.0 * share);
    let table = std::fs::read_to_string(out.join("survey.csv")).expect("a table");
    assert_eq!(table.lines().count(), 1 + planned.rows.len());
    let figure = std::fs::read_to_string(out.join("survey.svg")).expect("a figure");
    let svg = survey::xml::parse(&figure).expect("SVG");
    let drawn = |name: &str| svg.descendants().filter(|n| n.is_element() && n.tag_name().name() == name).count();
    assert_eq!((drawn("circle"), drawn("text")), (mission.aircraft.len(), mission.aircraft.len() + 1));
}

#[test]
fn three_areas_flown_by_one_three_and_eight_are_covered_once_and_at_the_asked_distance() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, text, hectares) in
        [("field.geojson", field(), 19.955), ("yard.kml", yard(), 21.76), ("river.plan", river(), 0.0)]
    {
        let area = folder.path().join(name);
        std::fs::write(&area, text).expect("written");
        for count in [1, 3, 8] {
            let out = folder.path().join(format!("{name}-{count}"));
            let planned =
                survey_job::run(&request(&area, count), &out).unwrap_or_else(|e| panic!("{name}, {count}: {e}"));
            let hectares = if hectares > 0.0 { hectares } else { planned.hectares };
            kept(&format!("{name}, {count} aircraft"), &out, &planned, hectares);
        }
    }
}

/// Side of the squares in each of which a model has a Gaussian where it saw ground, metres.
const SIDE_M: f64 = 4.0;

fn square(p: DVec2) -> (i32, i32) {
    let at = (p / SIDE_M).floor().as_ivec2();
    (at.x, at.y)
}

/// A model on the ground as training would leave it, but for its looks: a Gaussian in each square that a view saw well, and the views.
fn delivered(ground: &Path, mission: &Mission, id: &str, views: &[View], finished: bool) {
    let header = ModelHeader {
        mission: mission.name.clone(),
        aircraft: id.into(),
        origin: Some(mission.origin),
        views: views.iter().enumerate().map(|(k, view)| (format!("{id}{k}.jpg"), *view)).collect(),
        finished,
        ..ModelHeader::default()
    };
    // Half of the shorter side of a picture.
    let reach = 0.5 * GSD_M * f64::from(CAMERA.picture[1]);
    let seen: BTreeSet<(i32, i32)> = views
        .iter()
        .flat_map(|view| {
            let middle = view.pose.center.truncate();
            let (low, high) = (square(middle - reach), square(middle + reach));
            (low.0 + 1..high.0).flat_map(move |x| (low.1 + 1..high.1).map(move |y| (x, y)))
        })
        .collect();
    let mut cloud = GaussianCloud::with_capacity(0, seen.len());
    for (x, y) in seen {
        let [x, y] = [x, y].map(|k| ((f64::from(k) + 0.5) * SIDE_M) as f32);
        cloud.push([x, y, 0.0], [0.5; 3], [1.0, 0.0, 0.0, 0.0], 0.5, &[0.0; 3]);
    }
    let folder = ground.join("received").join(id);
    std::fs::create_dir_all(&folder).expect("a folder");
    model::write(&folder.join("model.dgtr"), &header, &cloud).expect("written");
}

/// What the ground merges of the models in its folder: views that took part, and the share of all regions' squares that hold a Gaussian,
/// and the share that hold several.
fn merged(ground: &Path, mission: &Mission) -> (Vec<View>, f64, f64) {
    let member = |a: &Aircraft| {
        let path = ground.join("received").join(&a.id).join("model.dgtr");
        Member::of(admit(mission, &a.id, &path).unwrap_or_else(|e| panic!("{}: {e}", a.id)))
    };
    let members = mission.aircraft.iter().map(member).collect();
    // Nothing was rendered that could be distilled.
    let settings = GroundSettings { epochs: 0, register: false, ..mission.ground.clone() };
    let outcome = aggregate::run(members, &settings, Some(mission.origin), ground, &|| false).expect("merged");
    let (header, cloud) = model::read(&outcome.path).expect("a model");
    let mut count: HashMap<(i32, i32), usize> = HashMap::new();
    for [x, y, _] in &cloud.means {
        *count.entry(square(DVec2::new((*x).into(), (*y).into()))).or_default() += 1;
    }
    let (mut all, mut held, mut twice) = (0usize, 0usize, 0usize);
    for region in mission.aircraft.iter().map(|a| mission.region(a).into_iter().map(DVec2::from).collect::<Vec<_>>()) {
        let (low, high) = region.iter().fold((DVec2::MAX, DVec2::MIN), |(l, h), p| (l.min(*p), h.max(*p)));
        let (from, to) = (square(low), square(high));
        for at in (from.0..=to.0).flat_map(|x| (from.1..=to.1).map(move |y| (x, y))) {
            let middle = (DVec2::new(at.0.into(), at.1.into()) + 0.5) * SIDE_M;
            if polygon::contains(&region, middle) {
                let here = count.get(&at).copied().unwrap_or(0);
                (all, held, twice) = (all + 1, held + usize::from(here > 0), twice + usize::from(here > 1));
            }
        }
    }
    let share = |n: usize| n as f64 / all as f64;
    (header.views.into_iter().map(|(_, view)| view).collect(), share(held), share(twice))
}

/// The aircraft keep all of their pictures.
fn many() -> KeyframeSettings {
    KeyframeSettings { max: 20_000, ..KeyframeSettings::default() }
}

/// Metres from a polygon; 0 inside.
fn off_m(corners: &[DVec2], p: DVec2) -> f64 {
    if polygon::contains(corners, p) {
        return 0.0;
    }
    let sides = corners.iter().zip(corners.iter().cycle().skip(1));
    let apart = sides.map(|(a, b)| {
        let t = ((p - *a).dot(*b - *a) / (*b - *a).length_squared().max(1e-9)).clamp(0.0, 1.0);
        p.distance(a.lerp(*b, t))
    });
    apart.fold(f64::INFINITY, f64::min)
}

#[test]
fn what_one_of_three_left_half_way_is_dealt_to_the_others_and_covered_in_the_end() {
    let folder = tempfile::tempdir().expect("a folder");
    let (area, out, ground) = (folder.path().join("field"), folder.path().join("out"), folder.path().join("ground"));
    std::fs::write(&area, field()).expect("written");
    let asked = request(&area, 3);
    let planned = survey_job::run(&asked, &out).expect("planned");
    let file = out.join(MISSION);
    let mission = Mission::read(&file).expect("a mission");
    let mut all = Vec::new();
    let mut own: BTreeMap<String, Vec<View>> = BTreeMap::new();
    for (k, row) in planned.rows.iter().enumerate() {
        let mut views = flown(&row.plan, &mission, k as u64);
        if row.aircraft == "a2" {
            views.truncate(views.len() / 2);
        }
        own.entry(row.aircraft.clone()).or_default().extend(&views);
        all.extend(views);
    }
    for (id, views) in &own {
        delivered(&ground, &mission, id, views, id != "a2");
    }
    let regions = |mission: &Mission| -> Vec<Vec<DVec2>> {
        mission.aircraft.iter().map(|a| mission.region(a).into_iter().map(DVec2::from).collect()).collect()
    };
    let before = covered(&regions(&mission), &all);
    assert!((0.75..0.95).contains(&before), "{before}");
    let rest = Rest::of(&file, &ground, &[]).expect("something is left");
    assert_eq!(rest.lost, ["a2"]);
    let again = folder.path().join("again");
    let (aircraft, camera, origin) = (rest.aircraft(), rest.camera(), rest.origin());
    assert!((camera.fov_deg - CAMERA.fov_deg).abs() < 1e-3 && camera.picture == CAMERA.picture);
    let source = Source::Rest(Box::new(rest));
    let more =
        survey_job::run(&Request { source, aircraft, camera, home_m: origin.alt_m, ..asked }, &again).expect("dealt");
    assert!(more.rows.iter().all(|row| row.aircraft != "a2") && more.hectares < 0.5 * planned.hectares, "{more:?}");
    let now = Mission::read(&again.join(MISSION)).expect("a mission");
    let (frame, area) = (EnuFrame::new(mission.origin), regions(&mission));
    for (k, row) in more.rows.iter().enumerate() {
        opened(&row.plan);
        // Nobody is sent out of the mission's area: what is dealt lies inside, as far as lines reach beyond its sides and corners.
        for waypoint in flight_plan::read(&row.plan).expect("a plan").waypoints {
            let p = frame.to_enu(waypoint.position).truncate();
            let off = area.iter().map(|region| off_m(region, p)).fold(f64::INFINITY, f64::min);
            assert!(off <= 1.5 * more.beyond_m.expect("no fence"), "{off} m outside of the area: {p}");
        }
        let views = flown(&row.plan, &now, 10 + k as u64);
        own.entry(row.aircraft.clone()).or_default().extend(&views);
        all.extend(views);
    }
    let after = covered(&regions(&now), &all);
    println!("covered {:.1} %, and {:.2} % in the end", 100.0 * before, 100.0 * after);
    assert!(after >= 0.98, "{after}");
    // The regions follow: together they are what they were.
    let hectares = |mission: &Mission| regions(mission).iter().map(|r| polygon::signed_area(r)).sum::<f64>() / 1e4;
    assert!((hectares(&now) / hectares(&mission) - 1.0).abs() < 1e-3, "{} {}", hectares(&now), hectares(&mission));
    let lost = |mission: &Mission| polygon::signed_area(&regions(mission)[1]);
    assert!(lost(&now) < 0.8 * lost(&mission), "who failed keeps what is covered");
    // The ground merges what all of them brought. The others went on with the key frames of their first flight; what one that failed
    // brought counts where it covered ground.
    let (_, incomplete, _) = merged(&ground, &Mission { keyframes: many(), ..mission.clone() });
    assert!(incomplete < 0.95, "{incomplete}");
    for (id, views) in own.iter().filter(|(id, _)| *id != "a2") {
        delivered(&ground, &now, id, views, true);
    }
    let (views, complete, twice) = merged(&ground, &Mission { keyframes: many(), ..now.clone() });
    println!("merged {} of {} views, {:.2} % of all regions", views.len(), all.len(), 100.0 * complete);
    assert!(complete >= 0.98 && twice < 0.02, "{complete} hold something, {twice} several");
    let share = covered(&regions(&now), &views);
    assert!(share >= 0.98, "{share} of the merged model's ground is covered by its views");
    // Nothing is dealt twice, and nobody is not a fleet.
    for (without, word) in [
        (vec!["a1", "a2", "a3"], "no aircraft is left"),
        (vec!["b"], "no aircraft 'b'"),
        (vec!["a1"], "nothing is left"),
    ] {
        let without: Vec<String> = without.into_iter().map(str::to_owned).collect();
        let refused = Rest::of(&file, &ground, &without).expect_err(word).to_string();
        assert!(refused.contains(word), "{refused}");
    }
    std::fs::copy(&file, ground.join(MISSION)).expect("kept by the ground");
    let other = std::fs::read_to_string(&file).expect("a mission").replacen("name = \"", "name = \"other-", 1);
    std::fs::write(ground.join(MISSION), other).expect("written");
    let refused = Rest::of(&file, &ground, &["a2".into()]).expect_err("another mission's").to_string();
    assert!(refused.contains("give the folder and the mission of one flight"), "{refused}");
    assert!(Rest::of(&file, folder.path(), &[]).expect_err("no ground").to_string().contains("--out of dgtr serve"));
}

/// Plans of other programs: a survey of QGroundControl with and without a speed, pictures by distance, Mission Planner's waypoints.
#[test]
fn plans_that_other_programs_write_are_flown() {
    for (name, waypoints, pictures) in
        [("survey.plan", 2, 2), ("survey_noHoverSpeed.plan", 2, 2), ("trigdist.plan", 4, 10), ("mp.waypoints", 1, 0)]
    {
        let Some(path) = needs::shared(&format!("field/mavlink/inputs/{name}")) else { continue };
        let plan = flight_plan::read(&path).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!((plan.waypoints.len(), plan.speed_m_s), (waypoints, 5.0), "{name}");
        let text = format!(
            "name = \"m\"\norigin = {{ lat_deg = {:?}, lon_deg = {:?}, alt_m = {:?} }}\n\
             camera = {{ width = 400, height = 300, fx = 346.0, fy = 346.0, cx = 200.0, cy = 150.0 }}\n\
             [[aircraft]]\nid = \"a\"\nlink = \"tcpin:1\"\ncamera = {{ folder = \"c\" }}\n\
             region_enu = [[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]\n",
            plan.home.lat_deg, plan.home.lon_deg, plan.home.alt_m
        );
        let mission = Mission::parse(&text, Path::new("/m")).expect("a mission");
        assert_eq!(flown(&path, &mission, 1).len(), pictures, "{name}");
    }
}

/// A hillside of one in ten that goes up to the north, as a GeoTIFF in the place's UTM zone.
fn hillside(folder: &Path) -> PathBuf {
    let crs = Crs::utm(PLACE).expect("a zone");
    let [low, high] = [-300.0, 1200.0].map(|m| crs.to_map(DVec3::new(m, m, 0.0)).expect("a place").truncate());
    let zero = crs.to_map(DVec3::ZERO).expect("a place").y;
    let grid = Grid::new(crs, [low, high], 10.0).expect("a grid");
    let mut files = MapFiles::begin(folder, &grid).expect("a map");
    for block in files.blocks().to_vec() {
        let pixels = || (0..block.height).flat_map(|y| (0..block.width).map(move |x| (x, y)));
        let north =
            |(x, y): (u32, u32)| grid.place(DVec2::new(f64::from(block.x + x) + 0.5, f64::from(block.y + y) + 0.5)).y;
        let heights: Vec<f32> = pixels().map(|p| (500.0 + 0.1 * (north(p) - zero)) as f32).collect();
        let mut rgba: Vec<u8> = pixels().flat_map(|_| [120, 130, 140, 255]).collect();
        let unknown = vec![NO_HEIGHT; heights.len()];
        let pixels = Pixels { rgba: &mut rgba, heights: &heights, height_sigmas: &unknown, plane_sigmas: &unknown };
        files.write(block, pixels).expect("written");
    }
    files.finish(&Disk::default(), None).expect("a map");
    folder.join("dsm.tif")
}

#[test]
fn lines_over_a_hillside_keep_their_height_above_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let (area, out) = (folder.path().join("field"), folder.path().join("out"));
    std::fs::write(&area, field()).expect("written");
    let terrain = hillside(&folder.path().join("map"));
    let planned =
        survey_job::run(&Request { terrain: Some(terrain.clone()), ..request(&area, 2) }, &out).expect("planned");
    let frame = EnuFrame::new(PLACE);
    let mission = Mission::read(&out.join(MISSION)).expect("a mission");
    let mut heights = Vec::new();
    for row in &planned.rows {
        let plan = flight_plan::read(&row.plan).expect("a plan");
        let ground = |at: Geodetic| 500.0 + 0.1 * frame.to_enu(at).y;
        assert!((plan.home.alt_m - ground(plan.home)).abs() < 1.5, "{:?}", plan.home);
        let lines = plan.waypoints.iter().filter(|w| w.every_m.is_some());
        heights.extend(lines.map(|w| w.position.alt_m - ground(w.position)));
    }
    assert!(heights.len() > 10 && heights.iter().all(|m| (m - planned.height_m).abs() < 5.0), "{heights:.1?}");
    assert!((mission.origin.alt_m - 500.0).abs() < 50.0, "{:?}", mission.origin);
    // Where the map ends there is no plan.
    let far = Request { terrain: Some(terrain), ..request(&area, 1) };
    let far = Request { flying: Flying { take_off: vec![[47.42, 8.5]], ..far.flying.clone() }, ..far };
    let refused = survey_job::run(&far, &folder.path().join("far")).expect_err("beyond the map").to_string();
    assert!(refused.starts_with("--terrain holds no height"), "{refused}");
}

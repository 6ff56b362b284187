//! From an area to a flight of many: regions of equal flight time, a mission, plans, a figure and a table, written into a folder.

use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use config::mission::{Draft, DraftArea, MAX_CORNERS, Mission, MissionError};
use config::survey::SurveySettings;
use disk::{Disk, DiskError};
use fleet::FleetError;
use fleet::deal::{Share, deal};
use fleet::figure;
use fleet::flights::{Flights, Off, crossings};
use fleet::ground::{Ground, Ring};
use fleet::obstacles::Obstacles;
use fleet::pace::{Manner, Pace};
use fleet::ring::ring;
use fleet::sortie::{Craft, Sortie};
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec2;
use measure::MeasureError;
use models::formats::FormatError;

mod after;
mod place;
mod regions;
mod terrain;

pub use after::Rest;
use place::{area, homes, moved, outside, placed};
use terrain::Terrain;

/// Names in the folder.
pub const MISSION: &str = "mission.toml";
const FIGURE: &str = "survey.svg";
const TABLE: &str = "survey.csv";
/// Lines are longer than the ground by this many distances of pictures, at both ends, so that its border lies in as many pictures as
/// its middle.
const BEYOND: f64 = 1.5;
/// Take-off places are no higher above the sea, and no lower below it, metres.
const HIGHEST_HOME_M: f64 = 10_000.0;
/// Least distance of lines and of pictures on a line, metres.
const NEAREST_M: f64 = 0.5;

/// Why nothing was planned.
#[derive(Debug, thiserror::Error)]
pub enum SurveyError {
    /// The area's file, or the terrain's.
    #[error(transparent)]
    Measure(#[from] MeasureError),
    /// An area or settings that cannot be flown.
    #[error("{path}: {source}", path = path.display())]
    Area {
        /// The file.
        path: PathBuf,
        /// Why.
        source: FleetError,
    },
    /// Settings that cannot be flown.
    #[error(transparent)]
    Fleet(#[from] FleetError),
    /// The mission that would be written.
    #[error(transparent)]
    Mission(#[from] MissionError),
    /// A file that cannot be written.
    #[error(transparent)]
    File(#[from] FormatError),
    /// What was asked for.
    #[error("{0}")]
    Request(String),
}

impl Error for SurveyError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Measure(e) => e.kind(),
            Self::File(e) => e.kind(),
            _ => ErrorKind::Input,
        }
    }
}

/// The camera: pixels, and the angle between the left and the right edge of a picture.
#[derive(Clone, Copy, Debug)]
pub struct Camera {
    /// Width and height, pixels.
    pub picture: [u32; 2],
    /// Degrees.
    pub fov_deg: f64,
}

/// How pictures are taken.
#[derive(Clone, Copy, Debug)]
pub struct Pictures {
    /// Metres of ground to a pixel.
    pub gsd_m: f64,
    /// Share of a picture seen again by the next one on the line.
    pub forward_overlap: f64,
    /// Share of a picture seen again from the next line.
    pub side_overlap: f64,
    /// The camera needs so many seconds from picture to picture.
    pub interval_s: f64,
}

/// How it is flown.
#[derive(Clone, Debug)]
pub struct Flying {
    /// Over ground, m/s.
    pub speed_m_s: f64,
    /// The fastest through the air, m/s.
    pub fastest_m_s: f64,
    /// Wind, m/s.
    pub wind_m_s: f64,
    /// Minutes that a battery lasts, of all aircraft or of each.
    pub endurance_min: Vec<f64>,
    /// Share of it that is left at the landing.
    pub reserve: f64,
    /// Latitude and longitude of the take-off places: none, one for all, or one for each.
    pub take_off: Vec<[f64; 2]>,
    /// Metres above ground at most.
    pub highest_m: f64,
    /// Metres that are kept from holes.
    pub clearance_m: f64,
}

/// What is flown.
#[derive(Clone, Debug)]
pub enum Source {
    /// An area in a file.
    File(PathBuf),
    /// What a mission's aircraft left.
    Rest(Box<Rest>),
}

/// What is asked for.
#[derive(Clone, Debug)]
pub struct Request {
    /// What is flown.
    pub source: Source,
    /// Name of the mission.
    pub name: String,
    /// Ids and links of the aircraft.
    pub aircraft: Vec<(String, String)>,
    /// The camera.
    pub camera: Camera,
    /// Pictures.
    pub pictures: Pictures,
    /// Flying.
    pub flying: Flying,
    /// Height of the take-off places as the autopilot reports it, metres, where no terrain says it.
    pub home_m: f64,
    /// A GeoTIFF of the ground's heights.
    pub terrain: Option<PathBuf>,
}

/// A row of the table: one sortie.
#[derive(Clone, Debug)]
pub struct Row {
    /// Who flies it.
    pub aircraft: String,
    /// Its plan.
    pub plan: PathBuf,
    /// From take-off to landing.
    pub minutes: f64,
    /// Pictures.
    pub pictures: usize,
    /// Kilometres from the take-off place and back.
    pub km: f64,
    /// Share of a picture seen again from the next line.
    pub side_overlap: f64,
    /// Hectares of the aircraft's region.
    pub hectares: f64,
}

/// What was planned and written.
#[derive(Clone, Debug)]
pub struct Planned {
    /// In the order of the aircraft.
    pub rows: Vec<Row>,
    /// Metres above ground.
    pub height_m: f64,
    /// Over ground, m/s.
    pub speed_m_s: f64,
    /// Hectares.
    pub hectares: f64,
    /// Where aircraft take off when nobody said it.
    pub take_off: Option<Geodetic>,
    /// Lines reach so far beyond the area, metres; `None`: it is a fence, and they end inside.
    pub beyond_m: Option<f64>,
    /// Rings that are cut out of the area and flown round.
    pub holes: usize,
    /// Ways to, from and between lines that lead round them.
    pub detours: usize,
}

/// Where it is flown, in metres of one frame.
struct Site {
    ground: Ground,
    /// What is cut out of the area.
    holes: Vec<Ring>,
    /// Around the area, and whether nobody may leave that.
    outside: Ring,
    fence: bool,
    obstacles: Obstacles,
}

/// Plans `request` and writes it into `out`.
///
/// # Errors
/// An area, settings or terrain that cannot be flown; a folder that holds a mission already or cannot be written to.
pub fn run(request: &Request, out: &Path) -> Result<Planned, SurveyError> {
    if out.join(MISSION).exists() {
        return Err(SurveyError::Request(format!(
            "{} is there already; choose another folder with --out",
            out.join(MISSION).display()
        )));
    }
    if !(-HIGHEST_HOME_M..=HIGHEST_HOME_M).contains(&request.home_m) {
        let wanted = format!("{:.0} to {HIGHEST_HOME_M:.0} m", -HIGHEST_HOME_M);
        return Err(setting("--home-height", request.home_m, wanted));
    }
    let count = request.aircraft.len();
    let (base_m, manner) = manner(&request.camera, &request.pictures, &request.flying)?;
    let (place, area) = match &request.source {
        Source::File(path) => area(path).map(|(area, middle, fence)| (middle, Some((path, area, fence))))?,
        Source::Rest(rest) => (rest.origin(), None),
    };
    let site_in = |frame: &EnuFrame| -> Result<Site, SurveyError> {
        let (ground, holes, outside, fence) = match (&area, &request.source) {
            (Some((path, area, fence)), _) => {
                let (ground, holes) = placed(path, area, frame)?;
                (ground, holes, outside(area, frame), *fence)
            }
            (None, Source::Rest(rest)) => (rest.left.clone(), rest.holes.clone(), rest.outside.clone(), rest.fence),
            (None, Source::File(_)) => Default::default(),
        };
        let free = obstacles(&holes, request.flying.clearance_m);
        // What a fence encloses is never left, and other areas only where no way round their holes lies inside.
        let obstacles = match fence {
            true => free.and_then(|free| free.fenced(&outside)),
            false => free.map(|free| free.inside(&outside, manner.beyond_m)),
        };
        Ok(Site { obstacles: obstacles.map_err(|e| request.in_source(e))?, ground, holes, outside, fence })
    };
    let frame = EnuFrame::new(place);
    let site = site_in(&frame)?;
    let homes = homes(&request.flying, &frame, (&site.ground, &site.obstacles), count)?;
    let terrain =
        request.terrain.as_deref().map(|path| Terrain::open(path, &frame, &site.ground, &homes)).transpose()?;
    let height = |p: DVec2| terrain.as_ref().and_then(|t| t.height(p));
    let home_m = match (&terrain, homes.first()) {
        (Some(_), Some(home)) => height(*home).ok_or_else(|| {
            SurveyError::Request(
                "--terrain holds no height at the take-off place; give a map that reaches there".into(),
            )
        })?,
        _ => request.home_m,
    };
    // The frame of an area lies as high as its take-off place; others have other metres, by a ten-thousandth for each 640 m.
    let origin = match &request.source {
        Source::File(_) => Geodetic { alt_m: (home_m * 100.0).round() / 100.0, ..place },
        Source::Rest(_) => place,
    };
    let (frame, homes) = (EnuFrame::new(origin), moved(&frame, &EnuFrame::new(origin), homes));
    let site = site_in(&frame)?;
    let Site { obstacles, ground, holes, .. } = &site;
    let craft = craft(request, &homes, &manner)?;
    let shares = deal(ground, obstacles, &craft, &manner).map_err(|e| request.in_source(e))?;
    let settings = settings(request, &frame, &homes, &site);
    let text = match &request.source {
        Source::File(_) => mission(request, origin, &shares, settings)?,
        Source::Rest(rest) => rest.mission(&shares, settings)?,
    };
    Mission::parse(&text, Path::new("."))?;
    let terrain: Option<&dyn Fn(DVec2) -> Option<f64>> = if terrain.is_some() { Some(&height) } else { None };
    let flights = Flights { frame, manner: &manner, base_m, terrain, home_m: origin.alt_m };
    let disk = Disk::default();
    let mut rows = Vec::new();
    let mut plans = Vec::new();
    let across = across_m(&request.camera, manner.height_m);
    for (craft, share) in craft.iter().zip(&shares) {
        for (k, sortie) in share.sorties.iter().enumerate() {
            let name = match share.sorties.len() {
                1 => format!("{}.plan", craft.id),
                _ => format!("{}-{}.plan", craft.id, k + 1),
            };
            plans.push((out.join(name), flights.plan(craft, sortie)?));
            rows.push(Row {
                aircraft: craft.id.clone(),
                plan: plans[plans.len() - 1].0.clone(),
                minutes: sortie.seconds / 60.0,
                pictures: flights.pictures(sortie),
                km: sortie.metres(craft.home) / 1e3,
                side_overlap: 1.0 - share.spacing_m / across,
                hectares: share.ground.area_m2() / 1e4,
            });
        }
    }
    let mut names: Vec<&PathBuf> = plans.iter().map(|(path, _)| path).collect();
    names.sort();
    if let Some(pair) = names.windows(2).find(|pair| pair[0] == pair[1]) {
        return Err(SurveyError::Request(format!(
            "{}: would hold the plans of two aircraft; give them ids that end in no number after a hyphen",
            pair[0].display()
        )));
    }
    for (path, plan) in &plans {
        disk.replace(path, |to| plan.write(to)).map_err(failed(path))?;
    }
    let path = out.join(FIGURE);
    disk.replace(&path, |to| figure::write(to, &craft, &shares)).map_err(failed(&path))?;
    let planned = Planned {
        rows,
        height_m: manner.height_m,
        speed_m_s: manner.pace.speed_m_s,
        hectares: ground.area_m2() / 1e4,
        beyond_m: (!site.fence).then_some(manner.beyond_m),
        holes: holes.len(),
        detours: shares.iter().flat_map(|share| &share.sorties).map(Sortie::detours).sum(),
        take_off: (request.flying.take_off.is_empty()).then(|| frame.to_geodetic(homes[0].extend(0.0))),
    };
    let path = out.join(TABLE);
    disk.replace(&path, |to| table(to, request, &planned)).map_err(failed(&path))?;
    // Last: a folder with a mission is whole.
    let path = out.join(MISSION);
    disk.replace(&path, |to| to.write_all(text.as_bytes())).map_err(failed(&path))?;
    Ok(planned)
}

fn failed(path: &Path) -> impl FnOnce(DiskError) -> SurveyError {
    move |e| FormatError::disk(path, e).into()
}

impl Request {
    /// With the file that an error is about.
    fn in_source(&self, e: FleetError) -> SurveyError {
        match &self.source {
            Source::File(path) => in_file(path, e),
            Source::Rest(_) => e.into(),
        }
    }
}

fn in_file(path: &Path, source: FleetError) -> SurveyError {
    match source {
        FleetError::Area(_) => SurveyError::Area { path: path.into(), source },
        source => source.into(),
    }
}

fn setting(what: &'static str, value: impl ToString, wanted: impl Into<String>) -> SurveyError {
    FleetError::Setting { what, value: value.to_string(), wanted: wanted.into() }.into()
}

/// Width of a picture on the ground, metres.
fn across_m(camera: &Camera, height_m: f64) -> f64 {
    2.0 * height_m * (camera.fov_deg / 2.0).to_radians().tan()
}

/// Metres between pictures of a line, and how the area is photographed. Pictures lie with their longer side across the lines.
fn manner(camera: &Camera, pictures: &Pictures, flying: &Flying) -> Result<(f64, Manner), SurveyError> {
    let [width, height] = camera.picture.map(f64::from);
    if !(width >= 1.0 && height >= 1.0 && width <= 65_536.0 && height <= 65_536.0) {
        return Err(setting("--picture", format!("{width}x{height}"), "1 to 65536 pixels each way"));
    }
    if !(1.0..170.0).contains(&camera.fov_deg) {
        return Err(setting("--fov-deg", camera.fov_deg, "1 to 170 degrees"));
    }
    if !(0.001..=10.0).contains(&pictures.gsd_m) {
        return Err(setting("--gsd", pictures.gsd_m * 100.0, "0.1 to 1000 cm"));
    }
    for (what, share) in [("--forward-overlap", pictures.forward_overlap), ("--side-overlap", pictures.side_overlap)] {
        if !(0.0..=0.95).contains(&share) {
            return Err(setting(what, share, "0 to 0.95"));
        }
    }
    if !(0.0..=60.0).contains(&pictures.interval_s) {
        return Err(setting("--interval", pictures.interval_s, "0 to 60 seconds"));
    }
    let across = width * pictures.gsd_m;
    let height_m = across / (2.0 * (camera.fov_deg / 2.0).to_radians().tan());
    let spacing_m = across * (1.0 - pictures.side_overlap);
    let base_m = height * pictures.gsd_m * (1.0 - pictures.forward_overlap);
    if spacing_m.min(base_m) < NEAREST_M {
        let wanted = format!(
            "such that lines and pictures lie {NEAREST_M} m apart or more; ask for less overlap or coarser pixels"
        );
        return Err(setting("--gsd", format!("{} cm", pictures.gsd_m * 100.0), wanted));
    }
    // The camera keeps up.
    let most = if pictures.interval_s > 0.0 { base_m / pictures.interval_s } else { f64::INFINITY };
    if most < 0.5 {
        return Err(setting(
            "--interval",
            pictures.interval_s,
            format!("{:.2} s or less, as pictures lie {base_m:.1} m apart", base_m / 0.5),
        ));
    }
    let mut pace = Pace::new(flying.speed_m_s, flying.wind_m_s, flying.fastest_m_s)?;
    pace.speed_m_s = pace.speed_m_s.min(most);
    Ok((base_m, Manner { spacing_m, beyond_m: BEYOND * base_m, height_m, pace }))
}

fn craft(request: &Request, homes: &[DVec2], manner: &Manner) -> Result<Vec<Craft>, SurveyError> {
    let Flying { endurance_min, reserve, highest_m, .. } = &request.flying;
    let count = request.aircraft.len();
    let fits = |minutes: &f64| (1.0..=1440.0).contains(minutes);
    if !(endurance_min.len() == 1 || endurance_min.len() == count) || !endurance_min.iter().all(fits) {
        let given = endurance_min.iter().map(f64::to_string).collect::<Vec<_>>().join(",");
        return Err(setting(
            "--endurance",
            given,
            format!("1 to 1440 minutes, once or once for each of {count} aircraft"),
        ));
    }
    if !(0.0..=0.9).contains(reserve) {
        return Err(setting("--reserve", reserve, "0 to 0.9"));
    }
    if !(5.0..=10_000.0).contains(highest_m) {
        return Err(setting("--highest", highest_m, "5 to 10000 m"));
    }
    let off = if request.terrain.is_some() { Off::above_terrain(manner.height_m) } else { Off::default() };
    let heights = crossings(count, manner.height_m, *highest_m, off)?;
    let one = |(k, (id, _)): (usize, &(String, String))| Craft {
        id: id.clone(),
        home: homes[k],
        battery_s: 60.0 * endurance_min[k % endurance_min.len()] * (1.0 - reserve),
        crossing_m: heights[k],
    };
    Ok(request.aircraft.iter().enumerate().map(one).collect())
}

/// What is flown round.
fn obstacles(holes: &[Ring], clearance_m: f64) -> Result<Obstacles, FleetError> {
    match (1.0..=500.0).contains(&clearance_m) {
        true => Obstacles::new(holes, clearance_m),
        false => Err(FleetError::Setting {
            what: "--clearance",
            value: clearance_m.to_string(),
            wanted: "1 to 500 m".into(),
        }),
    }
}

/// What is asked for, as the mission keeps it.
fn settings(request: &Request, frame: &EnuFrame, homes: &[DVec2], site: &Site) -> SurveySettings {
    let Request { pictures, flying, .. } = request;
    let place = |home: &DVec2| {
        let at = frame.to_geodetic(home.extend(0.0));
        // A ten-millionth of a degree is a centimetre.
        [at.lat_deg, at.lon_deg].map(|v| (v * 1e7).round() / 1e7)
    };
    let minutes = (0..homes.len()).map(|k| flying.endurance_min[k % flying.endurance_min.len()]);
    SurveySettings {
        gsd_cm: (pictures.gsd_m * 1e6).round() / 1e4,
        forward_overlap: pictures.forward_overlap,
        side_overlap: pictures.side_overlap,
        interval_s: pictures.interval_s,
        speed_m_s: flying.speed_m_s,
        fastest_m_s: flying.fastest_m_s,
        wind_m_s: flying.wind_m_s,
        endurance_min: minutes.collect(),
        reserve: flying.reserve,
        take_off: homes.iter().map(place).collect(),
        highest_m: flying.highest_m,
        clearance_m: flying.clearance_m,
        // Whoever reads the mission stands in another folder.
        terrain: request.terrain.as_deref().map(|path| std::path::absolute(path).unwrap_or_else(|_| path.into())),
        holes_enu: site.holes.iter().map(|ring| ring.iter().map(|p| millimetres(*p)).collect()).collect(),
        outside_enu: site.outside.iter().map(|p| millimetres(*p)).collect(),
        fence: site.fence,
        lost: Vec::new(),
    }
}

fn millimetres(p: DVec2) -> [f64; 2] {
    p.to_array().map(|v| (v * 1e3).round() / 1e3)
}

/// The mission file's text.
fn mission(
    request: &Request,
    origin: Geodetic,
    shares: &[Share],
    settings: SurveySettings,
) -> Result<String, SurveyError> {
    let regions = shares.iter().zip(&request.aircraft).map(|(share, (id, _))| region(&share.ground, id));
    let regions = regions.collect::<Result<Vec<_>, FleetError>>().map_err(|e| request.in_source(e))?;
    let draft = Draft {
        name: request.name.clone(),
        origin,
        picture: request.camera.picture,
        fov_deg: request.camera.fov_deg,
        area: DraftArea::Regions(regions),
        aircraft: request.aircraft.clone(),
        preset: None,
        survey: Some(settings),
    };
    Ok(draft.text())
}

/// Corners of a region as a mission holds them, to the millimetre.
fn region(ground: &Ground, id: &str) -> Result<Vec<[f64; 2]>, FleetError> {
    let corners = ring(ground);
    if corners.len() > MAX_CORNERS {
        let count = corners.len();
        return Err(FleetError::Area(format!(
            "leaves {id} a region of {count} corners; a mission holds {MAX_CORNERS}, so draw it simpler"
        )));
    }
    Ok(corners.into_iter().map(millimetres).collect())
}

fn table(out: &mut dyn std::io::Write, request: &Request, planned: &Planned) -> std::io::Result<()> {
    writeln!(
        out,
        "aircraft,plan,pictures,minutes,km,gsd_cm,forward_overlap,side_overlap,height_m,speed_m_s,region_ha"
    )?;
    for row in &planned.rows {
        let plan = row.plan.file_name().unwrap_or_default().to_string_lossy();
        writeln!(
            out,
            "{},{plan},{},{:.2},{:.3},{:.2},{:.3},{:.3},{:.1},{:.2},{:.3}",
            row.aircraft,
            row.pictures,
            row.minutes,
            row.km,
            request.pictures.gsd_m * 100.0,
            request.pictures.forward_overlap,
            row.side_overlap,
            planned.height_m,
            planned.speed_m_s,
            row.hectares
        )?;
    }
    Ok(())
}

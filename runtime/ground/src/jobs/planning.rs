//! Makes the plan of a merge: brings the models into one frame and one light, cuts them into squares of ground, and says of each square
//! what it depends on. The Gaussians of one model at a time are in memory.

use std::collections::{BTreeMap, HashSet};
use std::path::PathBuf;
use std::time::Instant;

use config::ground::GroundSettings;
use config::keys::to_hex;
use disk::Disk;
use geometry::geodesy::Geodetic;
use glam::DVec2;
use models::cloud::GaussianCloud;
use models::formats::model::columns::{self, write_floats};
use models::formats::model::encode_header;
use models::ground_cell::CellKey;

use crate::AggregateError;
use crate::block::{Block, column_bytes};
use crate::hold::Held;
use crate::light::{self, Light};
use crate::member::{self, Bounds, Member};
use crate::merge::{merge, side_m};
use crate::plan::{CELLS, Cell, Hash, MODELS, MOST_CELLS, MOST_MODELS, NAME, Piece, Placed, Plan, model_name};
use crate::region::{Partition, Region};
use crate::register::edge::Edges;
use crate::register::fit::RenderedFitter;
use crate::register::{Registered, Registrar};
use crate::squares::Squares;
use crate::store::Store;

/// Gaussians farther from what their model shows than this many times its longer side show no ground, as in a streamed scene.
const STRAY_SPANS: f64 = 20.0;

/// A plan, and what was found on the way to it.
#[derive(Debug)]
pub struct Planned {
    /// The plan.
    pub plan: Plan,
    /// How the models were moved onto their neighbours.
    pub registered: Registered,
    /// Why none could be; the models then stay where their GPS put them.
    pub not_registered: Option<String>,
    /// How far the models' light was apart.
    pub light: Light,
    /// Seconds by stage.
    pub seconds: Vec<(&'static str, f64)>,
}

/// Fits by rendering on the ground's device, and remembers it in `folder`.
pub fn registrar(settings: &GroundSettings, folder: &std::path::Path) -> Registrar<RenderedFitter> {
    Registrar::new(Edges::open(&Disk::default(), folder), RenderedFitter::new(settings.device.as_deref()))
}

/// Plans the merge of these models; `store` may hold the plan of an earlier one. They are moved to where they go. `origin` is the common
/// origin wanted (None takes the first model's), `fits` the folder of what is known of pairs.
///
/// # Errors
/// Models that do not belong together or cannot be read; the store's.
pub fn plan(
    members: &mut [Member],
    settings: &GroundSettings,
    origin: Option<Geodetic>,
    store: &Store,
    fits: PathBuf,
    cancelled: &dyn Fn() -> bool,
) -> Result<Planned, AggregateError> {
    if members.is_empty() {
        return Err(AggregateError::NoModels);
    }
    if members.len() > MOST_MODELS {
        return Err(AggregateError::TooMany { what: "models", most: MOST_MODELS });
    }
    // One that cannot be read holds nothing in place.
    let earlier = Plan::read(store).unwrap_or_else(|e| {
        tracing::warn!("{e}");
        None
    });
    let mut laps = Laps { seconds: Vec::new(), start: Instant::now() };
    let origin = member::unify(members, origin)?;
    let held = Held::of(earlier.as_ref(), |plan| plan.origin == origin);
    laps.end("unify");
    let (mut registered, mut not_registered) = (Registered::default(), None);
    if settings.register {
        match registrar(settings, &fits).register(members, &held, cancelled) {
            Ok(done) => registered = done,
            Err(e) => not_registered = Some(e),
        }
    }
    laps.end("register");
    let light = light::unite(members, &|m, gain| held.gain(m, gain))?;
    laps.end("light");
    let coverage_m = held.coverage_m(side_m(members));
    let squares = Squares::new(settings, coverage_m);
    let regions = Partition::new(members, settings.border_m).regions;
    let models = members.iter().zip(regions).map(|(m, region)| Ok(cut(m, &squares)?.placed(m, region)));
    let mut plan = Plan {
        mission: members[0].header.mission.clone(),
        origin,
        squares,
        coverage_m,
        border_m: settings.border_m.into(),
        sh_degree: members.iter().map(|m| m.sh_degree).max().unwrap_or(0),
        share: None,
        recipe: settings.into(),
        models: models.collect::<Result<_, AggregateError>>()?,
        cells: Vec::new(),
    };
    plan.cells = cells(&plan)?;
    let all: u64 = plan.models.iter().flat_map(|m| &m.pieces).map(|p| u64::from(p.rows)).sum();
    if let Some(most) = settings.max_gaussians.map(|n| n as u64).filter(|most| all > *most) {
        lay_out(members, &plan, store, &|_| true)?;
        deal(&mut plan, store, most, &held)?;
    }
    for i in 0..plan.cells.len() {
        plan.cells[i].input = plan.inputs(&plan.cells[i]).hash()?;
    }
    laps.end("plan");
    Ok(Planned { plan, registered, not_registered, light, seconds: laps.seconds })
}

/// What each stage took.
struct Laps {
    seconds: Vec<(&'static str, f64)>,
    start: Instant,
}

impl Laps {
    fn end(&mut self, stage: &'static str) {
        self.seconds.push((stage, self.start.elapsed().as_secs_f64()));
        self.start = Instant::now();
    }
}

/// A model cut into squares.
struct Cut {
    head: Vec<u8>,
    pieces: Vec<(CellKey, GaussianCloud)>,
    strays: u64,
}

/// Cuts a model.
fn cut(member: &Member, squares: &Squares) -> Result<Cut, AggregateError> {
    let cloud = member.cloud()?;
    let Bounds { low, high } = member.bounds();
    let reach = STRAY_SPANS * (high - low).max_element().max(squares.side_m());
    let (low, high) = (low - reach, high + reach);
    let mut rows: BTreeMap<CellKey, Vec<u32>> = BTreeMap::new();
    let mut strays = 0;
    for (i, mean) in cloud.means.iter().enumerate() {
        let p = DVec2::new(mean[0].into(), mean[1].into());
        match p.cmpge(low).all() && p.cmple(high).all() {
            true => rows.entry(squares.key(mean)).or_default().push(i as u32),
            false => strays += 1,
        }
    }
    let pieces = rows.into_iter().map(|(key, rows)| (key, cloud.rows(&rows))).collect();
    Ok(Cut { head: encode_header(&member.path, &member.header)?, pieces, strays })
}

impl Cut {
    fn placed(&self, member: &Member, region: Option<Region>) -> Placed {
        let mut from = self.head.len() as u64;
        let mut hasher = blake3::Hasher::new();
        let head = *blake3::hash(&self.head).as_bytes();
        hasher.update(&head);
        let piece = |(key, cloud): &(CellKey, GaussianCloud)| {
            let mut of_piece = blake3::Hasher::new();
            // Into a hash: there is nothing that could fail.
            columns::of(cloud).into_iter().for_each(|c| drop(write_floats(&mut of_piece, c)));
            let piece = Piece { key: *key, rows: cloud.len() as u32, from, hash: *of_piece.finalize().as_bytes() };
            hasher.update(&piece.hash);
            from += column_bytes(cloud.sh_degree, cloud.len() as u64);
            piece
        };
        let pieces = self.pieces.iter().map(piece).collect();
        Placed {
            name: member.name().into(),
            content: *member.content(),
            correction: member.correction().map(crate::frame::Motion::parts),
            gain: member.gain(),
            gaussians: member.gaussians as u64,
            strays: self.strays,
            sh_degree: member.sh_degree,
            object: *hasher.finalize().as_bytes(),
            head: (self.head.len() as u64, head),
            region,
            pieces,
        }
    }
}

/// All squares in which there is something.
fn cells(plan: &Plan) -> Result<Vec<Cell>, AggregateError> {
    let mut rows: BTreeMap<CellKey, u64> = BTreeMap::new();
    plan.models.iter().flat_map(|m| &m.pieces).for_each(|p| *rows.entry(p.key).or_default() += u64::from(p.rows));
    if rows.len() > MOST_CELLS {
        return Err(AggregateError::TooMany { what: "squares of ground.cell_m", most: MOST_CELLS });
    }
    let all = rows.values().sum::<u64>().max(1) as f64;
    // A bound on the seconds of all is shared out.
    let seconds = |n: u64| plan.recipe.seconds.map(|s| s * n as f64 / all);
    Ok(rows.into_iter().map(|(key, n)| Cell { key, most: None, seconds: seconds(n), input: [0; 32] }).collect())
}

/// Deals `most` Gaussians to the cells: each keeps the same share of what it would have.
fn deal(plan: &mut Plan, store: &Store, most: u64, held: &Held<'_>) -> Result<(), AggregateError> {
    let mut counts = Vec::with_capacity(plan.cells.len());
    for cell in &plan.cells {
        let inputs = plan.inputs(cell);
        let merged = merge(&Block::new(&inputs, store))?;
        counts.push(merged.inside.iter().filter(|inside| **inside).count() as u64);
    }
    let all: u64 = counts.iter().sum();
    if all <= most {
        return Ok(());
    }
    let share = held.share(most as f64 / all as f64);
    plan.share = Some(share);
    for (cell, count) in plan.cells.iter_mut().zip(counts) {
        // What is a whole number but for rounding is one.
        cell.most = Some((count as f64 * share + 1e-6) as u64);
    }
    Ok(())
}

/// Puts a plan where workers find it: after the models, so that what it names is there.
///
/// # Errors
/// The store's.
pub fn publish(plan: &Plan, store: &Store) -> Result<(), AggregateError> {
    let bytes = plan.bytes()?;
    Ok(store.put(NAME, &|out| out.write_all(&bytes))?)
}

/// Puts the models that these cells of the plan depend on into the store.
///
/// # Errors
/// A model cannot be read any more; the store's.
pub fn lay_out_for(members: &[Member], plan: &Plan, store: &Store, cells: &[usize]) -> Result<(), AggregateError> {
    let mut is_wanted = vec![false; plan.models.len()];
    for i in cells {
        plan.inputs(&plan.cells[*i]).models.iter().for_each(|m| is_wanted[m.index] = true);
    }
    lay_out(members, plan, store, &|index| is_wanted[index])
}

/// Puts the models that `is_wanted` and that are not there yet into the store.
///
/// # Errors
/// A model cannot be read any more; the store's.
pub fn lay_out(
    members: &[Member],
    plan: &Plan,
    store: &Store,
    is_wanted: &dyn Fn(usize) -> bool,
) -> Result<(), AggregateError> {
    for (index, (member, placed)) in members.iter().zip(&plan.models).enumerate() {
        let name = model_name(&placed.object);
        if !is_wanted(index) || store.size(&name)?.is_some() {
            continue;
        }
        let Cut { head, pieces, .. } = cut(member, &plan.squares)?;
        store.put(&name, &|mut out| {
            out.write_all(&head)?;
            let mut all = pieces.iter().flat_map(|(_, cloud)| columns::of(cloud));
            all.try_for_each(|column| write_floats(&mut out, column))
        })?;
    }
    Ok(())
}

/// Leaves in a folder only what the plan's cells came to: the models' pieces are made again from the models when they are wanted. Only
/// where nobody else works.
pub fn tidy(store: &Store, cells: &[Hash]) {
    let names: HashSet<String> = cells.iter().map(to_hex).collect();
    store.keep_only(MODELS, &|_| false);
    store.keep_only(CELLS, &|name| names.contains(name));
}

//! `dgtr serve --mission FILE --out DIR`: receives the models of all aircraft, merges them, writes the report.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use config::error::Error;
use config::mission::Mission;
use disk::Disk;

use engine::ortho::{draw_file, keep_scratch_in};
use ground::jobs::serve::{self, Board, COVERED_PCT, Joining, Reception, ServeError};
use ground::jobs::summary;
use job::console::Progress;
use job::interrupt::Interrupt;
use job::resources;
use job::run_json::RunReport;
use job::service::Supervisor;
use job::session::{self, Owner, Session};
use models::formats::FormatError;
use pages::report::{Craft, REPORT, ReportData, Timing, bytes};

use super::CliError;
use super::aggregate::{Settings, finish};
use super::ending::within_bounds;
use super::http::HttpArgs;

/// Arguments of `dgtr serve`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Mission file shared by all aircraft and the ground.
    #[arg(long)]
    pub mission: PathBuf,
    /// Folder for what is received, global.dgtr, run.json and report.html.
    #[arg(long)]
    pub out: PathBuf,
    /// Seconds to wait before what has arrived is merged [default: until all are in, or Ctrl-C].
    #[arg(long, value_name = "SECONDS")]
    pub timeout: Option<f64>,
    /// Take models that an earlier session received as well.
    #[arg(long)]
    pub again: bool,
    /// How to merge, over `[ground]` of the mission.
    #[command(flatten)]
    pub settings: Settings,
    /// The live page.
    #[command(flatten)]
    pub http: HttpArgs,
}

/// Runs `dgtr serve`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let (mut mission, text) = Mission::read_with_text(&args.mission)?;
    args.settings.merging.apply(&mut mission.ground)?;
    mission.upload.again |= args.again;
    let timeout = match args.timeout {
        Some(s) => Some(Duration::try_from_secs_f64(s).map_err(|e| CliError::input(format!("--timeout {s}: {e}")))?),
        None => None,
    };
    let interrupt = Interrupt::install()?;
    if let Err(e) = resources::open_many_files() {
        tracing::debug!("descriptors: {e}");
    }
    let mut board = Board::new(&mission, &args.out);
    let _server = args.http.serve(&mission.http, board.watch())?;
    let owner = Owner {
        command: "serve".into(),
        // Another word is another day's session.
        mission: [Some(mission.name.clone()), mission.upload.session.clone()]
            .into_iter()
            .flatten()
            .collect::<Vec<_>>()
            .join(", session "),
        aircraft: String::new(),
        origin: [mission.origin.lat_deg, mission.origin.lon_deg, mission.origin.alt_m],
        picture: [0; 2],
    };
    let _session = Session::begin(&Disk::default(), &args.out, &owner)?;
    let carried = match session::newest_earlier(&args.out) {
        Some(earlier) => serve::carry(&mission, &earlier, &args.out)?,
        None => Vec::new(),
    };
    if !carried.is_empty() {
        tracing::info!("the models of {} go on from the session before", carried.join(", "));
    }
    // With the models that belong to it: what is left is dealt by both.
    let kept = args.out.join(serve::MISSION);
    if !Mission::read_with_text(&kept).is_ok_and(|(_, before)| before == text) {
        let written = Disk::default().replace(&kept, |to| to.write_all(text.as_bytes()));
        written.map_err(|e| FormatError::disk(&kept, e))?;
    }
    keep_scratch_in(&args.out);
    let stop = AtomicBool::new(false);
    let supervisor = Supervisor::from_environment();
    let mut told = None;
    let mut joining = Joining::start(&mission, &args.out);
    let mut bar = Progress::new("receive", mission.aircraft.len() as u64);
    let reception = serve::receive(&mission, &args.out, timeout, &stop, &mut |p| {
        stop.store(interrupt.requested(), Ordering::Relaxed);
        supervisor.ready();
        supervisor.alive();
        board.round(p);
        joining.arrived(&p.received);
        if told.replace(p.finished) != Some(p.finished) {
            supervisor.status(&format!("{} of {} final models", p.finished, p.aircraft));
        }
        bar.set(p.finished as u64, || {
            let under_way: Vec<String> = p.transfers.iter().map(|(id, n, of)| format!("{id} {n}/{of}")).collect();
            format!("{} received {}", bytes(p.bytes), under_way.join(", "))
        });
    })
    .map_err(ServeError::from)?;
    bar.finish(&format!(
        "{} of {} final models",
        mission.aircraft.len() - reception.missing.len(),
        mission.aircraft.len()
    ));
    // A Ctrl-C that ended the reception: what is here is merged all the same, and a second one ends at once.
    if !interrupt.requested() {
        within_bounds(&interrupt).map_err(CliError::failed)?;
    }
    supervisor.status(&format!("merging {} models", reception.received.len()));
    board.say("merging and distilling");
    let joined = joining.finish(&|| supervisor.alive());
    let cancelled = || {
        supervisor.alive();
        false
    };
    let merged = serve::merge(&mission, &reception, &args.out, &cancelled);
    let (outcome, left_out) = match merged {
        Err(e @ ServeError::Nothing(_)) => return nothing(&args.out, &mission, &reception, e),
        merged => merged?,
    };
    let mut run = summary::run_report("serve", &outcome, mission.ground.seed);
    note_reception(&mut run, &reception);
    run.more.insert("joined_s".into(), joined.seconds.into());
    run.more.insert("joined_fits".into(), joined.fits.into());
    let mut data = summary::report(&outcome);
    add_reception(&mut data, &reception);
    let readable = reception.received.iter().filter(|r| left_out.iter().all(|u| u.0 != r.path));
    let locals: Vec<_> = readable.map(|r| (r.aircraft.clone(), r.path.clone())).collect();
    let metric = mission.network.metric.as_deref();
    args.settings.compare(&locals, &outcome, metric, (&mut run, &mut data))?;
    for (path, why) in left_out {
        data.warnings.push(format!("{} was received but cannot be used: {why}", path.display()));
    }
    if mission.map.ground {
        let from = Instant::now();
        board.say("drawing the map");
        match draw_file(&outcome.path, mission.ground.device.as_deref(), &args.out.join("map")) {
            Ok(map) => {
                let names =
                    ["orthophoto", "heights", "standard deviations of heights", "standard deviations of places"];
                data.files.extend(names.map(str::to_owned).into_iter().zip(map.files));
            }
            Err(e) => data.warnings.push(format!("There is no new map: {e}.")),
        }
        run.stage("map", from);
    }
    let seen = board.watch().freeze();
    // What was said while it received stands in the report, too.
    let said: Vec<String> = seen.warnings.iter().filter(|line| !data.warnings.contains(*line)).cloned().collect();
    data.warnings.extend(said);
    data.warnings.extend(left_short(&args.out, &seen.aircraft, &reception.missing));
    (data.aircraft, data.ground) = (seen.aircraft, seen.ground);
    if !reception.missing.is_empty() {
        run.outcome = "interrupted".into();
    }
    finish(&args.out, run, data, outcome)?;
    match reception.missing.is_empty() {
        true => Ok(()),
        false => Err(CliError::interrupted(format!(
            "merged without the final model of {}; run the same command again to continue receiving{}",
            reception.missing.join(", "),
            shown_instead(&reception)
        ))),
    }
}

/// Aircraft that left ground of their region uncovered, or sent no final model: what a battery, a link or an early landing did to them.
fn left_short(out: &Path, aircraft: &[Craft], missing: &[String]) -> Option<String> {
    let short =
        |craft: &&Craft| missing.contains(&craft.name) || craft.covered.is_some_and(|percent| percent < COVERED_PCT);
    let of = |craft: &Craft| format!("{} ({} % of its region covered)", craft.name, craft.covered.unwrap_or(0));
    let short: Vec<&Craft> = aircraft.iter().filter(short).collect();
    let without: String = short.iter().map(|craft| format!(" --without {}", craft.name)).collect();
    let out = out.display();
    (!short.is_empty() && short.len() < aircraft.len()).then(|| {
        format!(
            "Ground is left by {}. `dgtr survey --after {out}{without}` deals it to the others.",
            short.iter().map(|craft| of(craft)).collect::<Vec<_>>().join(", ")
        )
    })
}

/// What is known when nothing arrived that counts: written down all the same, with what was refused.
fn nothing(out: &Path, mission: &Mission, reception: &Reception, error: ServeError) -> Result<(), CliError> {
    let mut run = RunReport::new("serve");
    run.outcome = "interrupted".into();
    note_reception(&mut run, reception);
    let title = format!("Mission {}", mission.name);
    let mut data = ReportData { title, subtitle: "nothing was merged".into(), ..ReportData::default() };
    add_reception(&mut data, reception);
    data.files.push(("figures".into(), run.write(out)?));
    data.write(&out.join(REPORT))?;
    data.warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
    Err(CliError::new(error.kind(), format!("{error}{}", shown_instead(reception))))
}

/// The last models of other sessions that were shown in the place of this one's, as the end of a line.
fn shown_instead(reception: &Reception) -> String {
    reception.stale.iter().map(|(_, why)| format!("; {why}")).collect()
}

fn note_reception(run: &mut RunReport, reception: &Reception) {
    run.wall_s += reception.seconds;
    run.stage_ms.insert("receive".into(), reception.seconds * 1e3);
    run.more.insert("received".into(), serde_json::to_value(reception.counters).unwrap_or_default());
    run.more.insert("refused".into(), serde_json::to_value(&reception.refusals).unwrap_or_default());
    run.more.insert("missing".into(), reception.missing.clone().into());
    run.more.insert("stale".into(), reception.stale.iter().map(|s| s.0.as_str()).collect::<Vec<_>>().into());
    run.more.insert("unbound".into(), reception.unbound().collect::<Vec<_>>().into());
}

fn add_reception(data: &mut ReportData, reception: &Reception) {
    for row in &mut data.models {
        row.uploaded = reception.received.iter().find(|r| r.aircraft == row.name).map(|r| r.size);
    }
    let total: u64 = reception.received.iter().map(|r| r.size).sum();
    data.headline.push(("received".into(), bytes(total)));
    data.timings.insert(0, Timing { name: "receive".into(), of: String::new(), seconds: reception.seconds });
    for aircraft in &reception.missing {
        data.warnings.push(format!("The final model of {aircraft} has not arrived."));
    }
    for id in reception.unbound() {
        data.warnings.push(format!(
            "The model of {id} is not bound to this session: only its flight number says that it is not an earlier one's. Run `dgtr \
             serve` with the stick before the flight, or set [upload] session."
        ));
    }
    for (why, times) in reception.refusals.iter() {
        data.warnings.push(format!("Refused {times} times: {why}."));
    }
    let c = &reception.counters;
    for (what, n) in [
        ("corrupt chunks, fetched again", c.corrupt),
        ("failed attempts, repeated", c.retries),
        ("chunks that were here already", c.chunks_reused),
        ("offers of other missions", c.foreign),
        ("offers from unknown aircraft", c.unknown),
        ("offers above max_model_mib", c.oversize),
        ("left_out offers", c.damaged),
    ] {
        if n > 0 {
            data.skipped.push((what.into(), n));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_left_ground_is_named_with_the_command_that_deals_it_to_the_others() {
        let craft = |name: &str, covered| Craft { covered, ..Craft::new(name, "final model is here") };
        let said = |aircraft: &[Craft], missing: &[&str]| {
            let missing: Vec<String> = missing.iter().map(|id| (*id).to_owned()).collect();
            left_short(Path::new("ground"), aircraft, &missing)
        };
        let fleet = [craft("a1", Some(99)), craft("a2", Some(48)), craft("a3", Some(97)), craft("a4", None)];
        let line = said(&fleet, &["a4"]).unwrap_or_default();
        assert!(line.contains("a2 (48 % of its region covered), a4 (0 % of its region covered)"), "{line}");
        assert!(line.contains("`dgtr survey --after ground --without a2 --without a4`"), "{line}");
        // Nothing is dealt where all is well, or nobody is left.
        assert_eq!(said(&fleet[..1], &[]), None);
        assert_eq!(said(&fleet[1..2], &["a2"]), None);
    }
}

//! An aggregation as `run.json` and as a report.

use job::run_json::RunReport;
use pages::report::{Comparison, MapRegion, ModelRow, ReportData, Table, Timing, count};

use super::aggregate::Outcome;
use crate::register::Registration;

/// Neighbours named in a row of the report.
const NEIGHBOURS_SHOWN: usize = 4;

/// `run.json` of an aggregation.
pub fn run_report(command: &str, outcome: &Outcome, seed: u64) -> RunReport {
    let mut run = RunReport::new(command);
    run.outcome = if outcome.interrupted { "interrupted" } else { "done" }.into();
    run.gaussians = outcome.gaussians as u64;
    run.views = outcome.header.views.len() as u64;
    run.seed = seed;
    for (stage, seconds) in &outcome.seconds {
        run.stage_ms.insert((*stage).into(), seconds * 1e3);
        run.wall_s += seconds;
    }
    for kept in &outcome.kept {
        run.skip("gaussians_outside_own_region", kept.foreign as u64);
        run.skip("gaussians_over_budget", kept.over_budget as u64);
        run.skip("gaussians_far_from_all", kept.stray as u64);
    }
    let [made, of] = outcome.cells;
    run.more.insert("ground_cells".into(), serde_json::json!({ "made": made, "of": of }));
    let r = &outcome.registered;
    let registered = serde_json::json!({ "pairs": r.pairs, "fitted": r.fitted, "models": r.models.len() });
    run.more.insert("registered".into(), registered);
    run.more.insert("light".into(), outcome.light.largest.into());
    run.more.insert("color_step".into(), serde_json::json!(outcome.light.step));
    if let Some(d) = &outcome.distilled {
        run.steps = d.learnt.steps.into();
        run.skip("views_without_seam", (d.learnt.views - d.learnt.used) as u64);
        run.skip("gaussians_transparent", d.learnt.pruned as u64);
        run.device = d.device.clone();
        [run.memory.device_bytes_planned, run.memory.device_bytes_peak] = d.device_bytes;
        run.more.insert("seam_share".into(), d.learnt.seam_share.into());
        let cells = serde_json::json!({
            "met": d.learnt.cells, "accepted": d.learnt.accepted, "over_plan": d.learnt.over_plan, "views_kept_back": d.learnt.kept_back
        });
        run.more.insert("distilled_cells".into(), cells);
    }
    let names = outcome.models.iter().map(|m| m.0.as_str());
    let models: Vec<serde_json::Value> = names
        .zip(&outcome.kept)
        .enumerate()
        .map(|(i, (name, kept))| {
            let agreement = outcome.distilled.as_ref().and_then(|d| d.agreement[i]);
            serde_json::json!({ "name": name, "gaussians": kept, "agreement_db": agreement })
        })
        .collect();
    run.more.insert("models".into(), models.into());
    run
}

/// What the report of every aggregation shows; callers add what only they know (uploads, held-out figures).
pub fn report(outcome: &Outcome) -> ReportData {
    let mission = &outcome.header.mission;
    let title = if mission.is_empty() { "Global model".into() } else { format!("Mission {mission}") };
    let n = outcome.models.len();
    let device = outcome.distilled.as_ref().map_or("", |d| d.device.as_str());
    let mut data = ReportData {
        title,
        subtitle: [format!("{n} model{} merged", if n == 1 { "" } else { "s" }), device.into()]
            .into_iter()
            .filter(|s| !s.is_empty())
            .collect::<Vec<_>>()
            .join(" · "),
        headline: vec![
            ("aircraft".into(), count(n as u64)),
            ("training views".into(), count(outcome.header.views.len() as u64)),
            ("Gaussians".into(), count(outcome.gaussians as u64)),
        ],
        files: vec![("global model".into(), outcome.path.clone())],
        ..Default::default()
    };
    for (i, (name, header)) in outcome.models.iter().enumerate() {
        let corners = outcome.regions[i].as_ref().map(|r| r.corners.iter().map(|c| c.to_array()).collect());
        let cameras = header.views.iter().map(|(_, v)| v.pose.center.truncate().to_array()).collect();
        data.map.push(MapRegion { name: name.clone(), corners: corners.unwrap_or_default(), cameras });
        data.models.push(ModelRow {
            name: name.clone(),
            views: Some(header.views.len() as u64),
            gaussians: Some(outcome.kept[i].gaussians as u64),
            steps: Some(header.steps),
            ..Default::default()
        });
    }
    data.models.push(ModelRow {
        name: "global".into(),
        views: Some(outcome.header.views.len() as u64),
        gaussians: Some(outcome.gaussians as u64),
        steps: Some(outcome.header.steps),
        seconds: Some(outcome.seconds.iter().map(|s| s.1).sum()),
        ..Default::default()
    });
    let stages = outcome.seconds.iter();
    data.timings.extend(stages.map(|(s, t)| Timing { name: (*s).into(), of: String::new(), seconds: *t }));
    data.tables.push(merge_table(outcome));
    registration(outcome, &mut data);
    distillation(outcome, &mut data);
    data
}

/// What two models' colours of the same place differ by.
fn color_step(outcome: &Outcome) -> String {
    let percent = outcome.light.step.map(|factor| format!("{:.1} %", 100.0 * (factor - 1.0)));
    format!(
        "Colours that two aircraft's models have of the same place differ by {} (median) as they came and by {} in one light.",
        percent[0], percent[1]
    )
}

fn merge_table(outcome: &Outcome) -> Table {
    let head = ["", "Gaussians", "own region", "fill holes", "left to neighbours", "over budget", "before", "after"];
    let row = |(i, (name, _)): (usize, &(String, _))| {
        let k = &outcome.kept[i];
        let agreement = outcome.distilled.as_ref().and_then(|d| d.agreement[i]);
        let db = |j: usize| agreement.map_or_else(|| "–".into(), |a| format!("{:.2} dB", a[j]));
        let counts = [k.gaussians, k.own, k.fill, k.foreign, k.over_budget].map(|n| count(n as u64));
        std::iter::once(name.clone()).chain(counts).chain([db(0), db(1)]).collect()
    };
    Table {
        title: "Merging".into(),
        note: format!(
            "Each piece of ground is taken from the aircraft that answers for it. Before and after distillation: how closely the \
             union shows what the aircraft's own model shows, where views that were kept back from it show the cells in which \
             regions meet. {}",
            color_step(outcome)
        ),
        head: head.map(String::from).to_vec(),
        rows: outcome.models.iter().enumerate().map(row).collect(),
    }
}

fn registration(outcome: &Outcome, data: &mut ReportData) {
    if let Some(why) = &outcome.not_registered {
        data.warnings
            .push(format!("The models were merged where their GPS put them, they could not be registered: {why}"));
    }
    let r = &outcome.registered;
    data.warnings.extend(r.warnings.iter().cloned());
    if r.models.is_empty() {
        return;
    }
    let row = |m: &Registration| {
        let mut neighbours = m.neighbours.iter().take(NEIGHBOURS_SHOWN).cloned().collect::<Vec<_>>().join(", ");
        if m.neighbours.len() > NEIGHBOURS_SHOWN {
            neighbours += &format!(" and {} more", m.neighbours.len() - NEIGHBOURS_SHOWN);
        }
        let metres = |v: f64| format!("{v:.2} m");
        let scale = format!("{:+.2} %", 100.0 * (m.scale - 1.0));
        vec![m.name.clone(), neighbours, metres(m.moved_m), format!("{:.2}°", m.turned_deg), scale, metres(m.rms_m)]
    };
    data.tables.push(Table {
        title: "Registration".into(),
        note: format!(
            "Models that show the same ground are brought together. {} pairs overlap; {} of them were fitted now, the others \
             were known.",
            count(r.pairs as u64),
            count(r.fitted as u64)
        ),
        head: ["", "fitted onto", "moved by", "turned by", "larger by", "neighbours' points apart"].map(String::from).to_vec(),
        rows: r.models.iter().map(row).collect(),
    });
}

fn distillation(outcome: &Outcome, data: &mut ReportData) {
    let foreign: usize = outcome.kept.iter().map(|k| k.foreign).sum();
    data.skipped.push(("Gaussians outside their aircraft's region".into(), foreign as u64));
    if let Some(e) = &outcome.not_distilled {
        data.warnings.push(format!("The models were merged but not distilled: {e}"));
    }
    if outcome.interrupted {
        data.warnings.push("Stopped on request before distillation was over.".into());
    }
    let Some(d) = &outcome.distilled else { return };
    data.skipped.push(("views that see no seam, not distilled".into(), (d.learnt.views - d.learnt.used) as u64));
    data.skipped.push(("Gaussians that ended up transparent".into(), d.learnt.pruned as u64));
    data.skipped.push((
        "cells of seams that distillation did not bring closer".into(),
        (d.learnt.cells - d.learnt.accepted) as u64,
    ));
    if d.learnt.over_plan > 0 {
        let cells = count(d.learnt.over_plan as u64);
        data.warnings.push(format!(
            "{cells} cells of seams were not distilled to stay within ground.device_mib; raise it to mend them"
        ));
    }
    for s in &d.samples {
        data.comparisons.push(Comparison {
            title: s.name.clone(),
            note: format!("seam seen by {}", outcome.models[s.model].0),
            panels: vec![
                ("the aircraft's own model".into(), s.teacher.clone()),
                (format!("merged, {:.1} dB from it", s.psnr[0]), s.merged.clone()),
                (format!("distilled, {:.1} dB from it", s.psnr[1]), s.global.clone()),
            ],
        });
    }
}

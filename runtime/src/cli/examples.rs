//! What every command's help ends with: one or two calls as people give them. One table, so that a test parses each.

use clap::Command;

/// A command's path below the program and its examples.
pub type Examples = [(&'static str, &'static [&'static str])];

/// Examples of `dgtr`.
pub(super) const EXAMPLES: &Examples = &[
    (
        "train",
        &["dgtr train pictures --out model --seconds 120", "dgtr train /media/card/DCIM --out model --preset medium"],
    ),
    ("eval", &["dgtr eval model/model.dgtr pictures --split test --baselines"]),
    ("render", &["dgtr render model/model.dgtr --cameras pictures/transforms.json --out renders"]),
    ("ortho", &["dgtr ortho global.dgtr --out map --gsd 5", "dgtr ortho global.dgtr --out map --contours 0.5"]),
    (
        "volume",
        &[
            "dgtr volume map/dsm.tif heaps.geojson --out volumes",
            "dgtr volume new/dsm.tif pit.kml --base old/dsm.tif --out volumes",
        ],
    ),
    ("change", &["dgtr change march/map june/map --out changes"]),
    ("aggregate", &["dgtr aggregate west/model.dgtr east/model.dgtr --out merged"]),
    (
        "ground plan",
        &[
            "dgtr ground plan west/model.dgtr east/model.dgtr --store shared",
            "dgtr ground plan a.dgtr b.dgtr --mission mission.toml --store s3://bucket/field",
        ],
    ),
    ("ground cell", &["dgtr ground cell 0/0/0 0/-1/0 --store shared", "dgtr ground cell --share 3/16 --store shared"]),
    ("ground join", &["dgtr ground join --store shared --out merged"]),
    ("serve", &["dgtr serve --mission mission.toml --out ground --http 127.0.0.1:8080"]),
    (
        "fly",
        &[
            "dgtr fly --mission mission.toml --out flight",
            "dgtr fly --mission mission.toml --aircraft west --out flight --http 127.0.0.1:8080",
        ],
    ),
    ("export", &["dgtr export global.dgtr --to html", "dgtr export global.dgtr --to streamed --out scene"]),
    ("import", &["dgtr import scene.ply --out scene.dgtr"]),
    ("keys", &["dgtr keys --mission mission.toml", "dgtr keys --mission mission.toml --only west"]),
    ("init", &["dgtr init", "dgtr init --origin 47.4,8.5,430 --picture 4056x3040 --fov-deg 62"]),
    (
        "survey",
        &[
            "dgtr survey field.geojson --aircraft 3 --picture 4056x3040 --fov-deg 62 --gsd 2 --out survey",
            "dgtr survey --after ground",
        ],
    ),
    ("plan", &["dgtr plan --mission mission.toml", "dgtr plan --budget-mib 300 --json"]),
    ("doctor", &["dgtr doctor --mission mission.toml", "dgtr doctor --report board.json"]),
    ("demo", &["dgtr demo", "dgtr demo --seconds 20 --http 127.0.0.1:8080"]),
    ("replay", &["dgtr replay pictures --link pty:port --speed 4"]),
    ("sim", &["dgtr sim --mission mission.toml --speed 4", "dgtr sim --mission mission.toml --card card"]),
];

/// `program` with examples at the end of every command's help.
pub fn with_examples(program: Command, examples: &Examples) -> Command {
    within(program, "", examples)
}

fn within(command: Command, path: &str, all: &Examples) -> Command {
    let names: Vec<String> = command.get_subcommands().map(|c| c.get_name().to_owned()).collect();
    let command = names.into_iter().fold(command, |command, name| {
        let path = format!("{path} {name}");
        command.mut_subcommand(&name, |c| within(c, path.trim_start(), all))
    });
    let Some((_, examples)) = all.iter().find(|e| e.0 == path) else { return command };
    let before = command.get_after_help().map(|text| format!("{text}\n\n")).unwrap_or_default();
    let word = if examples.len() > 1 { "Examples" } else { "Example" };
    command.after_help(format!("{before}{word}:\n  {}", examples.join("\n  ")))
}

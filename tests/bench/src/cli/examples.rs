//! What every measurement's help ends with. One table, so that a test parses each.

use runtime::cli::examples::Examples;

/// A measurement and its examples.
pub const EXAMPLES: &Examples = &[
    ("stages", &["cargo run --release -p bench -- stages --json stages.json"]),
    ("map", &["cargo run --release -p bench -- map --out map"]),
    ("detail", &["cargo run --release -p bench -- detail --out detail"]),
    ("forecast", &["cargo run --release -p bench -- forecast --json forecast.json"]),
    ("ground", &["cargo run --release -p bench -- ground --out field --aircraft 24 --side-m 700"]),
    (
        "levels",
        &[
            "cargo run --release -p bench -- levels global.dgtr --out levels",
            "cargo run --release -p bench -- levels --gaussians 20000000 --out levels",
        ],
    ),
    ("memory", &["cargo run --release -p bench -- memory pictures"]),
    (
        "methods",
        &[
            "cargo run --release -p bench -- methods pictures --regions 3 --steps 400 --out methods",
            "cargo run --release -p bench -- methods --simulated 6 --methods dgtr,vastgaussian",
        ],
    ),
    (
        "poses",
        &[
            "cargo run --release -p bench -- poses DCIM other/DCIM",
            "cargo run --release -p bench -- poses DCIM --reference transforms.json",
        ],
    ),
    ("scene", &["cargo run --release -p bench -- scene --gaussians 5000000 --device-mib 512 --out scene"]),
    ("skips", &["cargo run --release -p bench -- skips pictures"]),
    ("sparse", &["cargo run --release -p bench -- sparse pictures --scale 0.5 --steps 400 --seeds 1 --out sparse"]),
    ("stress", &["cargo run --release -p bench -- stress"]),
    ("time-error", &["cargo run --release -p bench -- time-error pictures --out time-error"]),
];

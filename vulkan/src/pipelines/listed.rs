//! The kernels and the configurations in which `tests/boards.sh` has the boards' drivers compile them: `tests/boards/kernels.txt`,
//! made from the list of kernels. `DGTR_BLESS=1` remakes it.

use super::*;
use crate::constants::SHORT_PART;
use config::plan::Lanes;
use std::collections::BTreeSet;
use std::path::Path;

/// A line per kernel and configuration: a name for the table, the SPIR-V, the specialisation constants in order.
fn lines() -> BTreeSet<String> {
    // What a GPU gets where nothing was measured, and what autotuning may choose instead (`KernelConfig`).
    let (wide, narrow, tiles) = (64, 32, 32);
    let one = KernelConfig { wide, narrow, share_lanes: 1, tiles, tile_lanes: 1, fetched: 1, summed: 1, part: STRIP };
    let other = KernelConfig { share_lanes: 32, tiles: 8, tile_lanes: 8, summed: 8, part: SHORT_PART, ..one };
    let (fetching, meeting) = (KernelConfig { fetched: 8, ..other }, KernelConfig { tiles: 2, ..other });
    let mut lines = BTreeSet::new();
    for kernel in KERNELS {
        for config in [one, other, fetching, meeting] {
            let of_tiles = kernel.group == Group::Tiles;
            if config != one && kernel.variant.is_none() || [fetching, meeting].contains(&config) && !of_tiles {
                continue;
            }
            let suffix = match (takes_variant(kernel.group, config), kernel.group) {
                (false, _) => "",
                (true, Group::Tiles) if config == meeting => "_runs_shared",
                (true, Group::Tiles) => "_runs",
                (true, Group::Strips) => "_short",
                (true, _) => "_group",
            };
            let (lanes, staged) = (local_size(kernel.group, config), u32::from(config.fetched > 1));
            let halves = u32::from(kernel.bindings.contains(&"sh_first_moment"));
            // Nothing else is summed over a tile.
            let sums = u32::from(suffix.starts_with("_runs") && kernel.file.starts_with("rasterise_backward"));
            for (half, rolled) in (0..=halves).flat_map(|half| (0..=sums).map(move |rolled| (half, rolled))) {
                let name = format!("{}{suffix}", kernel.file);
                let chosen = [("", 1), ("+half", half), ("+staged", staged), ("+rolled", rolled)];
                let label: String = chosen.iter().filter(|c| c.1 == 1).map(|c| c.0).collect();
                let Lanes { sort, loops } = Lanes::BOARD;
                let constants = format!("{lanes} {} 3 {sort} {loops} 0 {half} {staged} {rolled}", sh_columns(3));
                lines.insert(format!("{name}:{lanes}{label} {name}.spv {constants}"));
                let strips = config == other && kernel.group == Group::Strips;
                if kernel.spirv.storage.is_some() && half == 0 && (config == one || strips) {
                    lines.insert(format!("{name}:{lanes}+storage {name}.storage.spv {constants}"));
                }
            }
        }
    }
    lines
}

#[test]
fn the_boards_compile_every_kernel_in_every_kind_of_config() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/boards/kernels.txt");
    let text: String = lines().into_iter().map(|line| line + "\n").collect();
    if std::env::var_os("DGTR_BLESS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let stored = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(stored == text, "tests/boards/kernels.txt is older than src/kernels.rs: DGTR_BLESS=1 remakes it");
    // The kernels whose sums over a tile are taken by its lanes are what the drivers have most trouble with.
    assert!(text.lines().count() > 40 && text.contains("rasterise_backward_runs:64+staged+rolled "), "{text}");
}

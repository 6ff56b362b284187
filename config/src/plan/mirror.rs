//! What the host reads and writes of a plan. A card with memory of its own keeps the plan there, out of the host's reach or slow to
//! read; the host then works on a mirror of these sections, as fixed as the plan itself.

use super::{Plan, view_bytes};

/// Read or written by the host; all others are the kernels' own.
const SECTIONS: [&str; 11] = [
    "frame",
    "status",
    "lane_sums",
    "strip_sums",
    "geometry",
    "sh",
    "sh_first_moment",
    "sh_second_moment",
    "tile_starts",
    "image",
    "transmittance",
];

impl Plan {
    /// Name and bytes of what a mirror holds, in order; of the views one slot, whichever is written.
    pub fn mirrored(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        let slot = if self.view_slots > 0 { view_bytes(self.pixels as u64) } else { 0 };
        let sections = SECTIONS.into_iter().map(|name| (name, self.bytes(name))).chain([("views", slot)]);
        sections.filter(|(_, bytes)| *bytes > 0)
    }

    /// Bytes of the host's memory that the mirror takes.
    pub fn mirror_bytes(&self) -> u64 {
        self.mirrored().map(|(_, bytes)| bytes).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::PlanRequest;

    #[test]
    fn a_mirror_holds_every_section_it_names_and_less_than_the_plan() {
        for views in [0, 3] {
            let plan = Plan::new(&PlanRequest { views, ..PlanRequest::default() }).unwrap();
            assert_eq!(plan.mirrored().count(), SECTIONS.len() + usize::from(views > 0));
            let all: u64 = SECTIONS.iter().map(|name| plan.bytes(name)).sum();
            assert_eq!(plan.mirror_bytes(), all + if views > 0 { plan.bytes("views") / 3 } else { 0 });
            assert!(plan.mirror_bytes() < plan.total_bytes);
        }
    }
}

//! Density control under the hard cap: where Gaussians are taken from and where they go.

use crate::settings::{Limits, choice, table};

choice! {
    /// What happens at a densification.
    pub enum Strategy {
        /// `none` when the initialisation already fills `dense_share` of the plan's Gaussians, `relocate` otherwise.
        Auto = "auto",
        /// Dead Gaussians move onto live ones (3DGS-MCMC), free rows are filled by splitting.
        Relocate = "relocate",
        /// Dead Gaussians are removed, nothing is added.
        Prune = "prune",
        /// The number and the identity of the Gaussians stay as they are (InstantSplat).
        None = "none",
    }
}

table! {
    /// Relocation, growth and pruning.
    #[derive(Copy)]
    pub struct DensitySettings {
        /// What happens at a densification.
        pub strategy: Strategy = Strategy::default();
        /// Longest distance between two densifications.
        pub every: u32 = 300, unit "steps", from "the paper, 4.1";
        /// A short schedule still densifies this often before `until`.
        pub at_least: u32 = 10, from "6 to 10: fox at 1,000 steps and 40,000 Gaussians +0.12 dB (1b428c2)";
        /// No densification after this progress.
        pub until: f32 = 0.7;
        /// At most this share of the present Gaussians is added at one densification.
        pub growth: f32 = 0.2, in Limits::at_least(0.0);
        /// A copy begins this far from its source, in standard deviations drawn from the source's own Gaussian. In a
        /// schedule of a few hundred steps two Gaussians at one place would not part in time.
        pub spread: f32 = 0.5, in Limits::at_least(0.0),
            from "Brush; +0.4 dB on fox at 1,000 steps against copies at the same place (3DGS-MCMC)";
        /// A Gaussian below this opacity is dead.
        pub dead_opacity: f32 = 0.005, in Limits::within(0.0, 0.5), from "3DGS and 3DGS-MCMC min_opacity";
        /// Share of the plan's Gaussians from which on an initialisation counts as dense.
        pub dense_share: f32 = 0.5;
    }
}

impl DensitySettings {
    /// Steps between two densifications in a schedule of `steps` steps.
    pub fn interval(&self, steps: u32) -> u32 {
        let short = (steps as f32 * self.until.clamp(0.0, 1.0) / self.at_least.max(1) as f32) as u32;
        self.every.min(short).max(1)
    }

    /// What [`Strategy::Auto`] means for `loaded` Gaussians in a plan of `capacity`.
    pub fn resolve(&self, loaded: usize, capacity: usize) -> Strategy {
        match self.strategy {
            Strategy::Auto if loaded as f32 >= self.dense_share * capacity as f32 => Strategy::None,
            Strategy::Auto => Strategy::Relocate,
            chosen => chosen,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_schedules_densify_more_often_than_every_300_steps() {
        let d = DensitySettings::default();
        assert_eq!(d.interval(10_000), 300);
        assert_eq!(d.interval(1_000), 70);
        assert_eq!(d.interval(1), 1);
    }

    #[test]
    fn a_dense_initialisation_is_left_alone() {
        let d = DensitySettings { strategy: Strategy::Auto, ..DensitySettings::default() };
        assert_eq!(d.resolve(60, 100), Strategy::None);
        assert_eq!(d.resolve(10, 100), Strategy::Relocate);
        let p = DensitySettings { strategy: Strategy::Prune, ..d };
        assert_eq!(p.resolve(60, 100), Strategy::Prune);
    }
}

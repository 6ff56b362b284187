//! Density control under the hard cap: where Gaussians are taken from and where they go.

use serde::{Deserialize, Serialize};

/// What happens at a densification.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Strategy {
    /// [`Strategy::None`] when the initialisation already fills [`DensitySettings::dense_share`] of the plan's
    /// Gaussians, [`Strategy::Relocate`] otherwise.
    #[default]
    Auto,
    /// Dead Gaussians move onto live ones (3DGS-MCMC), free rows are filled by splitting.
    Relocate,
    /// Dead Gaussians are removed, nothing is added.
    Prune,
    /// The number and the identity of the Gaussians stay as they are (InstantSplat).
    None,
}

/// When and how much.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DensitySettings {
    /// What happens.
    pub strategy: Strategy,
    /// Longest distance between two densifications, steps.
    pub every: u32,
    /// A short schedule still densifies this often before [`Self::until`].
    pub at_least: u32,
    /// No densification after this progress.
    pub until: f32,
    /// At most this share of the present Gaussians is added at one densification.
    pub growth: f32,
    /// A copy begins this far from its source, in standard deviations drawn from the source's own Gaussian. In a
    /// schedule of a few hundred steps two Gaussians at one place would not part in time.
    pub spread: f32,
    /// A Gaussian below this opacity is dead.
    pub dead_opacity: f32,
    /// Share of the plan's Gaussians from which on an initialisation counts as dense.
    pub dense_share: f32,
}

impl Default for DensitySettings {
    fn default() -> Self {
        Self {
            strategy: Strategy::default(),
            every: 300, // paper §4.1: every 300 iterations
            at_least: 6,
            until: 0.7,
            growth: 0.2,
            spread: 0.5, // Brush; +0.4 dB on fox at 1,000 steps against copies at the same place (3DGS-MCMC)
            dead_opacity: 0.005, // 3DGS and 3DGS-MCMC min_opacity
            dense_share: 0.5,
        }
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
        assert_eq!(d.interval(1_000), 116);
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

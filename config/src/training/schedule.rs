//! What changes while training goes on: SH degree, resolution, choice of views, early stop.

use crate::settings::{Limits, table};

table! {
    /// Spherical harmonics.
    #[derive(Copy)]
    pub struct ShSettings {
        /// Highest degree.
        pub degree: u8 = 3, in Limits::within(0.0, 3.0);
        /// Progress from which degree 1, 2, 3 may be used.
        pub raise_at: [f32; 3] = [0.0; 3],
            from "all at once, as Brush; 3DGS raises the degree every 1,000 of 30,000 steps ([0.033, 0.067, 0.1])";
        /// Share of the Gaussians whose own degree is raised by one at each of six occasions in the first half: those whose
        /// views disagree most on their colour. 1 = every Gaussian has the degree in use.
        pub raise_share: f32 = 1.0, in Limits::within(0.0, 1.0);
        /// Adam's moments of the coefficients in 16 bits instead of 32: at degree 3 a fifth less memory per Gaussian.
        pub half_moments: bool = false;
    }
}

impl ShSettings {
    /// The degree in use at `progress`.
    pub fn degree_at(&self, progress: f32) -> u8 {
        let raised = self.raise_at.iter().take_while(|p| progress >= **p).count();
        (raised as u8).min(self.degree)
    }
}

table! {
    /// Coarse to fine: pictures are averaged 4 × 4, then 2 × 2, then taken as they are. Small ones are visited more often in the same time,
    /// and what they leave to be learnt takes few visits.
    #[derive(Copy)]
    pub struct ResolutionSettings {
        /// A quarter of the size until this progress.
        pub quarter_until: f32 = 0.0,
            from "0.2 gains 0.1 dB on fox in 45 s and loses 0.007 of SSIM on sheffield_cross (dc27ca5)";
        /// Half the size until this progress.
        pub half_until: f32 = 0.5,
            from "0.1 to 0.5, in the same time: fox +0.4 to +0.7 dB (45 s), sheffield_cross +0.13 (38 s); dc27ca5";
        /// No picture becomes shorter than this on either side.
        pub least_side: u32 = 64, unit "pixels";
        /// The size is reduced at least by this, whatever the progress: 1, 2 or 4.
        pub least_divisor: u32 = 1;
    }
}

impl ResolutionSettings {
    /// By how much a picture of `width` × `height` is reduced at `progress`: 1, 2 or 4.
    pub fn divisor_at(&self, progress: f32, width: u32, height: u32) -> u32 {
        let wanted = match progress {
            p if p < self.quarter_until => 4,
            p if p < self.half_until => 2,
            _ => 1,
        };
        let wanted = wanted.max(self.least_divisor);
        let least = width.min(height);
        [4, 2].into_iter().find(|d| *d <= wanted && least / d >= self.least_side.max(1)).unwrap_or(1)
    }

    /// Shares of a schedule, and by how much pictures of `width` × `height` are reduced in each.
    pub fn phases(&self, width: u32, height: u32) -> [(f32, u32); 3] {
        let quarter = self.quarter_until.clamp(0.0, 1.0);
        let half = self.half_until.clamp(quarter, 1.0);
        [(0.0, quarter), (quarter, half), (half, 1.0)]
            .map(|(from, until)| (until - from, self.divisor_at(0.5 * (from + until), width, height)))
    }
}

table! {
    /// Which view comes next. Every epoch visits each view once, in a seeded shuffle.
    #[derive(Copy)]
    pub struct ViewSettings {
        /// Most visits to each view where nobody says how many steps or seconds there are: few pictures are learnt by heart.
        pub visits: u32 = 100, in Limits::within(1.0, 1e6),
            from "fox gains 1.0 dB from 50 visits to 100 and 0.4 from 100 to 200; sheffield_cross loses 0.1, brighton_beach 0.2 (b2e25c7)";
        /// Share of extra visits per epoch that go to the views with the largest last loss.
        pub residual_share: f32 = 0.0, in Limits::within(0.0, 1.0);
    }
}

table! {
    /// When to end before the schedule does: when the loss of pictures of full size has stopped falling.
    #[derive(Copy)]
    pub struct StopSettings {
        /// Whether to look at all.
        pub enabled: bool = false;
        /// Epochs in a row that must improve by less than `least_gain` before training ends.
        pub patience: u32 = 5, unit "epochs";
        /// Relative fall of an epoch's mean loss that counts as progress.
        pub least_gain: f32 = 2e-3;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn degree_rises_with_progress_and_never_beyond_the_highest() {
        let s = ShSettings { degree: 2, raise_at: [0.1, 0.2, 0.3], ..Default::default() };
        let got: Vec<u8> = [0.0, 0.1, 0.25, 0.9].map(|p| s.degree_at(p)).to_vec();
        assert_eq!(got, [0, 1, 2, 2]);
    }

    #[test]
    fn small_pictures_are_not_reduced() {
        let r = ResolutionSettings { quarter_until: 0.1, half_until: 0.3, least_side: 64, ..Default::default() };
        assert_eq!(r.divisor_at(0.0, 640, 480), 4);
        assert_eq!(r.divisor_at(0.0, 270, 480), 4);
        assert_eq!(r.divisor_at(0.0, 200, 480), 2);
        assert_eq!(r.divisor_at(0.2, 640, 480), 2);
        assert_eq!(r.divisor_at(0.3, 640, 480), 1);
        assert_eq!(r.divisor_at(0.0, 17, 1), 1);
    }

    #[test]
    fn phases_are_the_shares_in_which_each_divisor_holds() {
        let r = ResolutionSettings { quarter_until: 0.25, half_until: 0.75, least_side: 64, ..Default::default() };
        assert_eq!(r.phases(640, 480), [(0.25, 4), (0.5, 2), (0.25, 1)]);
        assert_eq!(r.phases(200, 160), [(0.25, 2), (0.5, 2), (0.25, 1)]);
        let never = ResolutionSettings { quarter_until: 0.0, half_until: 0.0, ..r };
        assert_eq!(never.phases(640, 480), [(0.0, 1), (0.0, 1), (1.0, 1)]);
    }
}

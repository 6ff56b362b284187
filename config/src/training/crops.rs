//! Pictures that are larger than training pictures are trained in crops as well.

use crate::settings::{Limits, table};

table! {
    /// Crops: windows of the camera's pictures at a larger size than whole pictures are trained at, with the same number of pixels
    /// as one of those, so that a step costs what it costs without them.
    #[derive(Copy)]
    pub struct CropSettings {
        /// Most crops of all pictures together; they wait in the file of views. 0 = none.
        pub most: u32 = 512, in Limits::within(0.0, 65_536.0),
            from "about as many as a flight has time to look at; 0.6 GB of 640 × 480";
        /// Scale of the pictures they are cut out of; absent = the largest half of the camera's size whose crops find room.
        pub scale: Option<f32> = None, in Limits::within(0.001, 1.0);
        /// Progress from which on crops are visited.
        pub from: f32 = 0.5, in Limits::within(0.0, 1.0),
            from "sheffield_cross at half its size: 0.2 gains 0.24 dB at full size, 0.5 gains 0.38 (0ee6a83)";
        /// Share of the steps from then on that look at a crop, not at a whole picture.
        pub share: f32 = 0.75, in Limits::within(0.0, 1.0),
            from "the same: 0.5 and 1 gain less";
    }
}

/// A picture less than this wider than its training picture shows nothing that is worth its crops.
const LEAST_FACTOR: f64 = 1.25;

impl CropSettings {
    /// Crops of a training picture's size that cover a picture of size `whole`; none where that is hardly larger, or the settings
    /// want none.
    pub fn planned(&self, whole: (u32, u32), training: (u32, u32)) -> u32 {
        let worth = f64::from(whole.0) >= LEAST_FACTOR * f64::from(training.0);
        let all = whole.0.div_ceil(training.0.max(1)).saturating_mul(whole.1.div_ceil(training.1.max(1)));
        if worth && self.share > 0.0 && self.most > 0 { all } else { 0 }
    }

    /// Whether the step after `steps` steps looks at a crop, at `progress`.
    pub fn is_due(&self, steps: u32, progress: f32) -> bool {
        let upto = |steps: u32| (f64::from(steps) * f64::from(self.share)).floor();
        progress >= self.from && upto(steps.saturating_add(1)) > upto(steps)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_larger_pictures_have_crops() {
        let settings = CropSettings::default();
        let planned = |whole| settings.planned(whole, (640, 480));
        assert_eq!([(640, 480), (799, 600), (800, 600), (1280, 960), (4000, 3000)].map(planned), [0, 0, 4, 4, 49]);
        assert_eq!(CropSettings { most: 0, ..settings }.planned((4000, 3000), (640, 480)), 0);
        assert_eq!(CropSettings { share: 0.0, ..settings }.planned((4000, 3000), (640, 480)), 0);
    }

    #[test]
    fn crops_get_their_share_of_the_steps_evenly_and_none_before_their_time() {
        let settings = CropSettings { from: 0.5, share: 0.75, ..CropSettings::default() };
        let due: Vec<bool> = (0..8).map(|step| settings.is_due(step, 0.5)).collect();
        assert_eq!(due, [false, true, true, true, false, true, true, true]);
        assert!((0..8).all(|step| !settings.is_due(step, 0.49)));
        assert!((0..8).all(|step| CropSettings { share: 1.0, ..settings }.is_due(step, 1.0)));
        assert!((0..8).all(|step| !CropSettings { share: 0.0, ..settings }.is_due(step, 1.0)));
    }
}

//! `[keyframes]`: which pictures are trained on.

use crate::settings::{Limits, table};

table! {
    /// The key-frame rule of the paper (after NeuralRecon): moved more than `t_min_m` **or** turned more than `r_max_deg`.
    #[derive(Copy)]
    pub struct KeyframeSettings {
        /// Least translation from the last key frame.
        pub t_min_m: f32 = 5.0, in Limits::at_least(0.0);
        /// Or least rotation from it.
        pub r_max_deg: f32 = 15.0, in Limits::above(0.0).up_to(180.0), from "NeuralRecon";
        /// Most key frames of one aircraft: the size of the rings, and what the memory is planned for.
        pub max: u32 = 256, in Limits::within(2.0, 4096.0);
        /// Leave out pictures from where an earlier key frame already stood, unless the ground in sight still lacks pictures (see
        /// `[coverage]`).
        pub skip_covered: bool = true;
        /// Steps trained for every key frame that is taken in, however many more wait: a flight that outruns its computer has a
        /// trained model in flight, too. With 0 nothing is trained while key frames wait.
        pub train_steps: u32 = 4, in Limits::within(0.0, 1000.0), unit "steps";
    }
}

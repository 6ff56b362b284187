//! Whether what is learnt of the training views holds for others.

use crate::settings::{Limits, table};

table! {
    /// Of a schedule that looks at each view often, some views are kept back for its first third. Where what is learnt of the others makes
    /// them worse (few pictures of vegetation), Gaussians are left out of each step from then on (DropGaussian).
    #[derive(Copy)]
    pub struct ValidationSettings {
        /// Share of the views that is kept back; 0 = none, and nothing is left out but what `regularise.drop` says.
        pub share: f32 = 0.1, in Limits::within(0.0, 0.5);
        /// Schedules that look at each view less often than this learn nothing by heart: they keep none back.
        pub visits: u32 = 50, in Limits::at_least(1.0), unit "looks at each view",
            from "forests are best after 25 to 50 (tests/results/TRIED.md)";
        /// DropGaussian's γ where they become much worse; less where they become a little worse.
        pub drop: f32 = 0.2, in Limits::within(0.0, 0.9),
            from "brighton_beach, 1,500 steps: 17.33 dB with 0, 17.90 with 0.1, 18.07 with 0.2, 18.05 with 0.3";
    }
}

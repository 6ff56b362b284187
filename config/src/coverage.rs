//! `[coverage]` of the mission file: when a piece of ground counts as photographed well enough.

use crate::settings::{Limits, table};

table! {
    /// When a piece of ground counts as covered; what is missing is told after the landing, as a file and as a flight that gets it.
    #[derive(Copy)]
    pub struct CoverageSettings {
        /// Pictures that must see it.
        pub pictures: u32 = 3, in Limits::within(1.0, 100.0),
            from "the third ray is the first that can contradict a height; Pix4D wants as many for a point";
        /// Widest angle at which two of them must meet there.
        pub angle_deg: f32 = 10.0, in Limits::within(0.0, 120.0),
            from "a base of 0.17 of the height; pictures of a survey overlap by 75 %: 12° between neighbours";
        /// Side of the squares the ground is judged by; larger where the region has too many of them for the memory set aside.
        pub cell_m: f32 = 2.0, in Limits::within(0.05, 1000.0);
        /// Height of the ground above the origin; absent = of where the aircraft took off, as the autopilot says.
        pub ground_m: Option<f32> = None, in Limits::within(-20_000.0, 20_000.0);
        /// Smaller holes are left alone.
        pub least_m2: f32 = 25.0, in Limits::within(0.0, 1e9), unit "square metres";
        /// Noise of a measured point in a picture: what the expected error of a height follows from.
        pub pixel_sigma: f32 = 0.5, in Limits::within(0.01, 100.0), unit "pixels",
            from "refine.pixel_sigma, which holds for key points, and a little more for surfaces";
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_accepted_and_nonsense_is_named() {
        assert_eq!(CoverageSettings::default().check(), Ok(()));
        for (text, field) in [
            ("pictures = 0", "pictures"),
            ("angle_deg = nan", "angle_deg"),
            ("cell_m = 0.0", "cell_m"),
            ("ground_m = inf", "ground_m"),
        ] {
            let settings: CoverageSettings = toml::from_str(text).expect("TOML");
            assert_eq!(settings.check().expect_err(text).field, field);
        }
    }
}

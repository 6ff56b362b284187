//! One aircraft's card: how it stands now, or how it stood at the end. Of fixed size once it is made, so that the loops that
//! report into it allocate nothing.

use image::RgbImage;
use serde_json::{Value, json};

use super::curve::Curve;
use super::text::{bytes, count, seconds};
use super::{ReportError, picture};

/// Longest side of the picture on a card, pixels.
const THUMBNAIL: u32 = 192;

/// What is known of one aircraft.
#[derive(Clone, Debug, Default)]
pub struct Craft {
    /// Its name.
    pub name: String,
    /// What it does, in a few words.
    pub state: &'static str,
    /// The rung of the failsafe ladder and its cause, when it is not the lowest.
    pub trouble: Option<(&'static str, &'static str)>,
    /// The link: to the autopilot on board, to the aircraft on the ground. Empty while nothing is known.
    pub link: &'static str,
    /// Metres east, north, up of the origin.
    pub at: Option<[f64; 3]>,
    /// Charge of the battery, percent.
    pub battery: Option<u8>,
    /// Pictures that came from the camera.
    pub pictures: Option<u64>,
    /// Key frames.
    pub key_frames: Option<u64>,
    /// Ground of the region that is covered, percent.
    pub covered: Option<u32>,
    /// Gaussians.
    pub gaussians: Option<u64>,
    /// How far it is.
    pub schedule: Schedule,
    /// Bytes that went to the ground, or came from the aircraft.
    pub bytes: Option<u64>,
    /// Chunks here and chunks wanted of a model that is under way.
    pub chunks: Option<(usize, usize)>,
    /// The training curve.
    pub plot: Plot,
    /// The last key frame.
    pub thumbnail: Thumbnail,
}

/// How far a training or a transfer is.
#[derive(Clone, Copy, Debug, Default)]
pub struct Schedule {
    /// Optimiser steps.
    pub steps: Option<u64>,
    /// Share that is over, 0…1.
    pub progress: Option<f32>,
    /// What is left, seconds.
    pub left_s: Option<f64>,
}

/// A curve with its axes.
#[derive(Clone, Debug)]
pub struct Plot {
    /// What goes to the right and what goes up.
    pub axes: [&'static str; 2],
    /// Its points.
    pub curve: Curve,
}

impl Default for Plot {
    fn default() -> Self {
        Self { axes: ["step", "loss"], curve: Curve::default() }
    }
}

/// A small picture in memory that is taken once.
#[derive(Clone, Debug, Default)]
pub struct Thumbnail {
    size: (u32, u32),
    rgb: Vec<u8>,
    /// Grows with every picture; 0 = there is none.
    pub serial: u64,
}

impl Thumbnail {
    /// Takes every so many pixels of `image`.
    pub fn take(&mut self, image: &RgbImage) {
        let (width, height) = image.dimensions();
        let step = width.max(height).div_ceil(THUMBNAIL).max(1);
        self.size = (width / step, height / step);
        self.rgb.clear();
        for y in 0..self.size.1 {
            for x in 0..self.size.0 {
                self.rgb.extend_from_slice(&image.get_pixel(x * step, y * step).0);
            }
        }
        self.serial += 1;
    }

    /// As a picture; `None` before the first.
    pub fn image(&self) -> Option<RgbImage> {
        RgbImage::from_raw(self.size.0, self.size.1, self.rgb.clone()).filter(|_| self.serial > 0)
    }
}

impl Craft {
    /// A card of which only the name and the state are known.
    pub fn new(name: &str, state: &'static str) -> Self {
        // Three bytes a pixel; all that a card will ever need.
        let rgb = Vec::with_capacity(3 * (THUMBNAIL * THUMBNAIL) as usize);
        let thumbnail = Thumbnail { rgb, ..Thumbnail::default() };
        Self { name: name.into(), state, thumbnail, ..Self::default() }
    }

    /// Label and value of what is known, in reading order.
    pub fn facts(&self) -> Vec<(&'static str, String)> {
        let at = |p: [f64; 3]| format!("{:.0} m east, {:.0} m north, {:.0} m up", p[0], p[1], p[2]);
        let all = [
            ("link", Some(self.link.to_owned()).filter(|l| !l.is_empty())),
            ("position", self.at.filter(|p| p.iter().all(|v| v.is_finite())).map(at)),
            ("battery", self.battery.map(|p| format!("{p} %"))),
            ("pictures", self.pictures.map(count)),
            ("key frames", self.key_frames.map(count)),
            ("covered", self.covered.map(|p| format!("{p} %"))),
            ("Gaussians", self.gaussians.map(count)),
            ("steps", self.schedule.steps.map(count)),
            ("time left", self.schedule.left_s.map(seconds)),
            ("model under way", self.chunks.map(|(n, of)| format!("{n} of {of} chunks"))),
            ("transferred", self.bytes.map(bytes)),
        ];
        all.into_iter().filter_map(|(label, value)| Some((label, value?))).collect()
    }

    /// For the page: with its picture inside when it is `frozen`, else with the number by which it is asked for.
    pub(super) fn json(&self, frozen: bool) -> Result<Value, ReportError> {
        let thumbnail = match self.thumbnail.image().filter(|_| frozen) {
            Some(image) => Some(picture::data_uri(&image).map_err(ReportError::picture(&self.name))?.into()),
            None => (self.thumbnail.serial > 0).then(|| json!(self.thumbnail.serial)),
        };
        Ok(json!({
            "name": self.name,
            "state": self.state,
            "trouble": self.trouble.map(|(rung, cause)| format!("{rung} ({cause})")),
            "at": self.at,
            "progress": self.schedule.progress,
            "facts": self.facts(),
            "axes": self.plot.axes,
            "curve": self.plot.curve.points(),
            "thumbnail": thumbnail,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_card_says_only_what_is_known_and_takes_no_memory_while_it_is_filled() {
        let mut craft = Craft::new("west", "listening");
        assert!(craft.facts().is_empty());
        (craft.schedule.left_s, craft.at) = (Some(95.0), Some([f64::NAN; 3]));
        assert_eq!(craft.facts(), [("time left", "95 s".to_owned())]);
        let room = craft.thumbnail.rgb.capacity();
        for size in [(4056, 3040), (640, 480), (3, 2), (193, 1)] {
            craft.thumbnail.take(&RgbImage::new(size.0, size.1));
            let (width, height) = craft.thumbnail.image().expect("a picture").dimensions();
            assert!(width.max(height) <= THUMBNAIL && width >= 1, "{size:?} became {width} × {height}");
        }
        assert_eq!(craft.thumbnail.rgb.capacity(), room);
    }
}

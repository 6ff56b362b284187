//! What surrounds a mark, in the photograph and in the model's rendering of it, so that a person sees at once whether it sits.

use std::collections::HashMap;

use engine::evaluate::surveyed::Mark;
use image::{Rgb, RgbImage};
use models::metrics::to_rgb8;
use pages::report::Comparison;
use survey::dataset::{Dataset, picture_names};

/// Points that are shown, and pictures of each.
const POINTS: usize = 40;
const PICTURES: usize = 2;
/// What is shown around a mark, pixels to each side, and how many times it is enlarged.
const AROUND: i64 = 24;
const ENLARGED: i64 = 4;
/// Arms of a cross, in pixels of the enlarged picture, and what is left free in its middle.
const ARM: i64 = 40;
const FREE: i64 = 10;
/// Where a point is marked, and where it was surveyed.
const MARKED: [u8; 3] = [255, 220, 0];
const SURVEYED: [u8; 3] = [0, 230, 255];

/// A mark and what the model shows around it.
struct Crop {
    point: String,
    picture: String,
    crosses: Vec<([f32; 2], [u8; 3])>,
    rendered: RgbImage,
}

/// What is shown of the marks.
#[derive(Default)]
pub(super) struct Crops {
    all: Vec<Crop>,
    /// How many of each point: points of one name may be of two lists.
    of_point: HashMap<(&'static str, usize), usize>,
}

impl Crops {
    /// Takes what the rendering shows around a mark, while there is room.
    pub fn take(&mut self, list: &'static str, name: &str, mark: &Mark) {
        let same = self.of_point.get(&(list, mark.point)).copied().unwrap_or(0);
        let is_full = same >= PICTURES || (same == 0 && self.of_point.len() >= POINTS);
        if is_full || !mark.pixel.iter().all(|v| v.is_finite()) {
            return;
        }
        let Some(image) = to_rgb8(&mark.shown.rgb, mark.shown.width, mark.shown.height) else { return };
        let crosses: Vec<_> = [(Some(mark.pixel), MARKED), (mark.surveyed, SURVEYED)]
            .into_iter()
            .filter_map(|(at, c)| Some((at?, c)))
            .collect();
        let rendered = cut(&image, mark.pixel, &crosses);
        *self.of_point.entry((list, mark.point)).or_default() += 1;
        self.all.push(Crop { point: name.to_owned(), picture: mark.picture.to_owned(), crosses, rendered });
    }

    /// Points of which something is shown.
    pub fn points(&self) -> usize {
        self.of_point.len()
    }

    /// Each beside its photograph, which is decoded anew at `scale`; one that cannot be any more is left out.
    pub fn beside_photographs(mut self, set: &Dataset, scale: f64) -> Vec<Comparison> {
        let names = picture_names(set);
        // One picture shows several points and is decoded once.
        let mut order: Vec<usize> = (0..self.all.len()).collect();
        order.sort_by(|a, b| self.all[*a].picture.cmp(&self.all[*b].picture));
        let mut photographs: Vec<Option<RgbImage>> = vec![None; self.all.len()];
        let mut last: Option<(String, Option<RgbImage>)> = None;
        for i in order {
            let crop = &self.all[i];
            if last.as_ref().is_none_or(|(name, _)| *name != crop.picture) {
                let loaded = names.find(&crop.picture).and_then(|at| set.load(at, scale).ok()).map(|p| p.image);
                last = Some((crop.picture.clone(), loaded));
            }
            if let Some((_, Some(image))) = &last {
                photographs[i] = Some(cut(image, crop.crosses[0].0, &crop.crosses));
            }
        }
        let mut shown: Vec<(Crop, Option<RgbImage>)> = self.all.drain(..).zip(photographs).collect();
        shown.sort_by(|a, b| a.0.point.cmp(&b.0.point));
        let panels = |crop: Crop, photograph: Option<RgbImage>| {
            let mut panels = vec![("model".to_owned(), crop.rendered)];
            panels.extend(photograph.map(|image| ("photograph".to_owned(), image)));
            let note = match crop.crosses.len() {
                1 => "upright: where it is marked; its height was not surveyed".to_owned(),
                _ => "yellow, upright: where it is marked; blue, oblique: where it was surveyed".to_owned(),
            };
            Comparison { title: format!("{} in {}", crop.point, crop.picture), note, panels }
        };
        shown.into_iter().map(|(crop, photograph)| panels(crop, photograph)).collect()
    }
}

/// What a picture shows around a pixel, enlarged, with crosses at other pixels of it; black beyond its edges.
fn cut(image: &RgbImage, around: [f32; 2], crosses: &[([f32; 2], [u8; 3])]) -> RgbImage {
    // Far outside of any picture is as far as outside of it.
    let whole = |v: f64| v.clamp(-1e6, 1e6).floor() as i64;
    let middle = around.map(|v| whole(v.into()));
    let side = (2 * AROUND + 1) * ENLARGED;
    let mut out = RgbImage::new(side as u32, side as u32);
    for (x, y, pixel) in out.enumerate_pixels_mut() {
        let from = |v: u32, axis: usize| u32::try_from(i64::from(v) / ENLARGED - AROUND + middle[axis]).ok();
        if let (Some(u), Some(v)) = (from(x, 0), from(y, 1))
            && u < image.width()
            && v < image.height()
        {
            *pixel = *image.get_pixel(u, v);
        }
    }
    let places: Vec<[i64; 2]> = crosses
        .iter()
        .map(|(at, _)| {
            [0, 1].map(|axis| {
                let from_corner = f64::from(at[axis]) - middle[axis] as f64 + AROUND as f64;
                whole(from_corner * ENLARGED as f64)
            })
        })
        .collect();
    // Upright and oblique in turn, so that one does not cover the other; what either means stays free.
    let is_free = |x: i64, y: i64| !places.iter().any(|p| (p[0] - x).abs() < FREE && (p[1] - y).abs() < FREE);
    for (i, (place, (_, color))) in places.iter().zip(crosses).enumerate() {
        for s in -ARM..=ARM {
            let arms = if i % 2 == 0 { [[s, 0], [0, s]] } else { [[s, s], [s, -s]] };
            for [x, y] in arms.map(|arm| [place[0] + arm[0], place[1] + arm[1]]) {
                if (0..side).contains(&x) && (0..side).contains(&y) && is_free(x, y) {
                    out.put_pixel(x as u32, y as u32, Rgb(*color));
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mark_is_in_the_middle_and_what_lies_beyond_the_picture_is_black() {
        let mut image = RgbImage::from_pixel(60, 40, Rgb([9, 9, 9]));
        image.put_pixel(2, 3, Rgb([200, 0, 0]));
        let shown = cut(&image, [2.5, 3.5], &[([2.5, 3.5], MARKED), ([8.5, 3.5], SURVEYED)]);
        let side = shown.width();
        assert_eq!(side, shown.height());
        let middle = side / 2;
        assert_eq!(shown.get_pixel(middle, middle).0, [200, 0, 0], "its pixel is not painted over");
        assert_eq!(shown.get_pixel(middle + FREE as u32 + 2, middle).0, MARKED);
        // Six pixels to the right, four times enlarged, and oblique.
        let arm = FREE as u32 + 2;
        assert_eq!(shown.get_pixel(middle + 24 + arm, middle + arm).0, SURVEYED);
        assert_eq!(shown.get_pixel(middle + 24, middle).0, [9; 3], "where it was surveyed is not painted over, either");
        assert_eq!((shown.get_pixel(0, 0).0, shown.get_pixel(side - 1, middle + 9).0), ([0; 3], [9; 3]));
        // Far outside of it nothing is shown, and nothing breaks.
        assert!(cut(&image, [-1e30, 1e30], &[]).pixels().all(|p| p.0 == [0; 3]));
    }
}

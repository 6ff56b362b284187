//! One light for the merged scene: cameras of different aircraft expose differently, and each model has the light of its own. Where two
//! models show the same ground their colours are compared, and all are brought to what most of them agree on.

use std::collections::HashMap;

use models::cloud::GaussianCloud;
use models::light::{Ratio, solve};

use super::AggregateError;
use super::member::Member;

/// Edge of the cubes in which colours are compared, as a share of the ground's longer side, and its bounds in metres.
const EDGE_SHARE: f64 = 1.0 / 128.0;
const EDGE_M: [f64; 2] = [0.25, 4.0];
/// Cubes of a model that are compared, at most.
const MOST_CUBES: usize = 1 << 13;
/// Opacity that a cube's Gaussians have together before its colour counts.
const SOLID: f32 = 1.0;
/// Colours beyond these are clipped or dark.
const USABLE: [f32; 2] = [0.04, 0.96];
/// Cubes that two models share before they say anything of each other's light.
const ENOUGH: usize = 50;
/// Gains that differ by less are not seen.
const EVEN: f32 = 0.01;

type Cubes = HashMap<[i32; 3], [f32; 3]>;

/// How far the models' light was apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// The largest factor that was taken out of a model, 1 where light was even.
    pub largest: f32,
    /// Median factor between the colours that two models have of the same place, before and after: what a border shows.
    pub step: [f32; 2],
}

impl Default for Light {
    fn default() -> Self {
        Self { largest: 1.0, step: [1.0; 2] }
    }
}

/// Finds the gain of each model and has it, or what `hold` says instead, taken out of its Gaussians.
///
/// # Errors
/// A model's file cannot be read any more.
pub fn unite(members: &mut [Member], hold: &dyn Fn(&Member, [f32; 3]) -> [f32; 3]) -> Result<Light, AggregateError> {
    if members.len() < 2 {
        return Ok(Light::default());
    }
    let longest = members.iter().map(|m| m.bounds().span().max_element()).fold(0.0, f64::max);
    let edge = (longest * EDGE_SHARE).clamp(EDGE_M[0], EDGE_M[1]) as f32;
    let mut ratios = Vec::new();
    let mut seen: Vec<Cubes> = Vec::with_capacity(members.len());
    for (b, member) in members.iter().enumerate() {
        let theirs = cubes(&member.cloud()?, edge);
        for (a, own) in seen.iter().enumerate() {
            if members[a].bounds().shared_m2(&member.bounds()) > 0.0 {
                ratios.extend(compare([a as u32, b as u32], own, &theirs).into_iter().flatten());
            }
        }
        seen.push(theirs);
    }
    let solved = solve(members.len(), &mut ratios);
    let largest = solved.gains.iter().flatten().flatten().fold(0.0f32, |most, g| most.max(g.abs()));
    let step = solved.before.exp();
    let is_even = largest < EVEN;
    for (member, found) in members.iter_mut().zip(&solved.gains) {
        let gain = hold(member, found.filter(|_| !is_even).unwrap_or_default());
        if (found.is_some() && !is_even) || gain != [0.0; 3] {
            member.brought_into_common_light(gain);
        }
    }
    if is_even {
        return Ok(Light { largest: 1.0, step: [step; 2] });
    }
    Ok(Light { largest: largest.exp(), step: [step, solved.after.exp()] })
}

/// Colours of the cubes of `edge` that `cloud` fills, thinned out alike in all models.
fn cubes(cloud: &GaussianCloud, edge: f32) -> Cubes {
    let mut sums: HashMap<[i32; 3], [f32; 4]> = HashMap::new();
    for i in 0..cloud.len() {
        let color = cloud.color(i);
        if color.iter().all(|v| (USABLE[0]..=USABLE[1]).contains(v)) {
            let opacity = 1.0 / (1.0 + (-cloud.opacity_logits[i]).exp());
            let sum = sums.entry(cloud.means[i].map(|v| (v / edge).floor() as i32)).or_default();
            (0..3).for_each(|c| sum[c] += opacity * color[c]);
            sum[3] += opacity;
        }
    }
    sums.retain(|_, sum| sum[3] >= SOLID);
    let share = (MOST_CUBES as f64 / sums.len().max(1) as f64).min(1.0);
    sums.retain(|cube, _| f64::from(scattered(*cube)) <= share * f64::from(u32::MAX));
    sums.into_iter().map(|(cube, [r, g, b, n])| (cube, [r / n, g / n, b / n])).collect()
}

/// A number that says nothing of where a cube lies.
fn scattered([x, y, z]: [i32; 3]) -> u32 {
    let mixed = [x, y, z].into_iter().fold(0u32, |h, v| (h ^ v as u32).wrapping_mul(0x9E37_79B1).rotate_left(15));
    (mixed ^ (mixed >> 13)).wrapping_mul(0x85EB_CA6B)
}

/// What two models say of each other, in the order of the cubes' places: the same on every run.
fn compare(models: [u32; 2], own: &Cubes, theirs: &Cubes) -> Option<Vec<Ratio>> {
    let mut both: Vec<&[i32; 3]> = own.keys().filter(|cube| theirs.contains_key(*cube)).collect();
    both.sort_unstable();
    let ratio = |cube: &&[i32; 3]| {
        let (a, b) = (own.get(*cube)?, theirs.get(*cube)?);
        Some(Ratio { pictures: models, t2: [0.0; 2], log: std::array::from_fn(|c| (a[c] / b[c]).ln()) })
    };
    let ratios: Vec<Ratio> = both.iter().filter_map(ratio).collect();
    (ratios.len() >= ENOUGH).then_some(ratios)
}

#[cfg(test)]
mod tests {
    use models::light::PictureLight;

    use super::*;
    use crate::testing::{carpet, model, nadir, written};

    #[test]
    fn models_of_two_cameras_are_brought_into_one_light_and_remember_their_own() {
        let dir = tempfile::tempdir().expect("a folder");
        let factor = [1.3f32, 1.1, 0.8];
        let names = ["a", "b", "c"];
        let mut members: Vec<Member> = Vec::new();
        for (i, name) in names.iter().enumerate() {
            let x = 20.0 * i as f64;
            let mut cloud = carpet([x, 0.0], [x + 40.0, 40.0], 0.25);
            if i == 1 {
                cloud.multiply_colors(factor);
            }
            let mut local = model(name, &[], cloud);
            local.header.views = vec![("v".into(), nadir(x, 20.0, 30.0))];
            members.push(written(dir.path(), &local));
        }
        let before = members[1].cloud().expect("read");
        let light = unite(&mut members, &|_, gain| gain).expect("united");
        assert!((light.largest - 1.3).abs() < 0.02, "{light:?}");
        assert!(light.step[0] > 1.08 && light.step[1] < 1.01, "{light:?}");
        let after = members[1].cloud().expect("read");
        for c in 0..3 {
            let ratio = after.color(777)[c] / before.color(777)[c];
            assert!((ratio * factor[c] - 1.0).abs() < 0.02, "channel {c}: {ratio}");
            assert!((members[1].header.lights[0].gain[c] - factor[c].ln()).abs() < 0.02);
        }
        let again = unite(&mut members, &|_, gain| gain).expect("united");
        assert!(
            again.largest == 1.0 && again.step[0] == again.step[1] && again.step[0] < 1.01,
            "one light now: {again:?}"
        );
    }

    #[test]
    fn models_in_one_light_or_apart_are_left_as_they_are() {
        let dir = tempfile::tempdir().expect("a folder");
        let carpets = [carpet([0.0, 0.0], [40.0, 40.0], 0.25), carpet([500.0, 0.0], [540.0, 40.0], 0.25)];
        let [near, far] = carpets.map(|cloud| model("m", &[], cloud));
        let mut same = [written(dir.path(), &near), written(dir.path(), &near)];
        assert_eq!(unite(&mut same, &|_, gain| gain).expect("united"), Light::default());
        let mut dark = far;
        dark.path = "dark".into();
        dark.cloud.multiply_colors([0.5; 3]);
        let mut apart = [written(dir.path(), &near), written(dir.path(), &dark)];
        assert_eq!(unite(&mut apart, &|_, gain| gain).expect("united"), Light::default());
        let even = |m: &Member| m.header.lights.iter().all(|l| *l == PictureLight::default());
        assert!(same.iter().chain(&apart).all(even));
    }
}

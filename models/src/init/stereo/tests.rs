//! Matching against its definition, on a scene whose depths are known, and on pictures that say nothing.

use image::Rgb;

use super::features::PRODUCT;
use super::*;

const SIZE: (u32, u32) = (96, 72);
const FOCAL: f32 = 90.0;
const RANGE: [f32; 2] = [20.0, 90.0];

/// Random numbers of 0…1, the same for the same place.
fn noise(x: i64, y: i64) -> f32 {
    let mixed = (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    let mixed = (mixed ^ (mixed >> 29)).wrapping_mul(0x1656_67b1_9e37_79f9);
    (mixed >> 40) as f32 / (1u64 << 24) as f32
}

/// Texture of a surface, between its random values linearly.
fn texture(x: f32, y: f32) -> f32 {
    let (i, j) = (x.floor(), y.floor());
    let (u, v) = (x - i, y - j);
    let at = |a: i64, b: i64| noise(i as i64 + a, j as i64 + b);
    (at(0, 0) * (1.0 - u) + at(1, 0) * u) * (1.0 - v) + (at(0, 1) * (1.0 - u) + at(1, 1) * u) * v
}

/// A roof 40 m below the camera that stands 20 m above the ground.
fn surface(x: f32, y: f32, above: bool) -> Option<f32> {
    match above {
        true => ((-12.0..4.0).contains(&x) && (-8.0..8.0).contains(&y)).then_some(40.0),
        false => Some(60.0),
    }
}

/// Depth and brightness at a pixel of a camera at (x, y), which looks straight down with x to the right.
fn seen(camera: [f32; 2], u: f32, v: f32) -> (f32, u8) {
    let ray = [(u - SIZE.0 as f32 / 2.0) / FOCAL, (v - SIZE.1 as f32 / 2.0) / FOCAL];
    let hit = |depth: f32| [camera[0] + ray[0] * depth, camera[1] + ray[1] * depth];
    let [x, y] = hit(40.0);
    let (depth, [x, y]) = match surface(x, y, true) {
        Some(depth) => (depth, [x, y]),
        None => (60.0, hit(60.0)),
    };
    (depth, (255.0 * texture(1.7 * x + depth, 1.7 * y)) as u8)
}

fn picture(camera: [f32; 2]) -> RgbImage {
    RgbImage::from_fn(SIZE.0, SIZE.1, |u, v| Rgb([seen(camera, u as f32 + 0.5, v as f32 + 0.5).1; 3]))
}

/// Of a source at `camera`, seen from one at the origin.
fn projection(camera: [f32; 2]) -> [f32; 16] {
    let [x, y] = camera.map(|v| -FOCAL * v);
    [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
}

const CAMERAS: [[f32; 2]; 4] = [[8.0, 0.0], [-8.0, 1.0], [1.0, 8.0], [0.0, -9.0]];

fn with_sources<T>(cameras: &[[f32; 2]], then: impl FnOnce(&RgbImage, &[Source<'_>]) -> T) -> T {
    let images: Vec<RgbImage> = cameras.iter().map(|c| picture(*c)).collect();
    let source = |(image, camera): (_, &[f32; 2])| Source { image, projection: projection(*camera) };
    then(&picture([0.0; 2]), &images.iter().zip(cameras).map(source).collect::<Vec<_>>())
}

#[test]
fn a_roof_and_the_ground_are_found_where_they_are_and_confidence_says_what_is_wrong() {
    let mut stereo = Stereo::default();
    with_sources(&CAMERAS, |reference, sources| {
        let found = stereo.depths(reference, sources, RANGE);
        assert_eq!((found.width, found.cell), (96, 1));
        let cells = || (0..found.depth.len()).map(|i| (i % 96, i / 96, found.depth[i], found.confidence[i]));
        let is_right = |x: usize, y: usize, depth: f32| {
            let (truth, _) = seen([0.0; 2], x as f32 + 0.5, y as f32 + 0.5);
            (depth / truth - 1.0).abs() < 0.05
        };
        let wrong = cells().filter(|(x, y, depth, _)| !is_right(*x, *y, *depth)).count();
        assert!(wrong * 20 < found.depth.len(), "{wrong} of {}", found.depth.len());
        let sure: Vec<_> = cells().filter(|cell| cell.3 > 0.5).collect();
        let wrong = sure.iter().filter(|(x, y, depth, _)| !is_right(*x, *y, *depth)).count();
        assert!(2 * sure.len() > found.depth.len() && wrong * 20 < sure.len(), "{wrong} of {} sure ones", sure.len());
    });
}

#[test]
fn pictures_that_say_nothing_have_no_sure_depth_and_every_depth_is_a_number_within_the_range() {
    let black = RgbImage::new(SIZE.0, SIZE.1);
    let textured = picture([0.0; 2]);
    let tiny = RgbImage::from_fn(8, 8, |x, y| Rgb([(31 * x + 17 * y) as u8; 3]));
    let good = projection([8.0, 0.0]);
    let mut behind = good;
    behind[10] = -1.0;
    let cases: [(&str, &RgbImage, &RgbImage, [f32; 16]); 7] = [
        ("black pictures", &black, &black, good),
        ("a black source", &textured, &black, good),
        ("a source that sees nothing", &textured, &textured, projection([1e6, 0.0])),
        ("a source behind the scene", &textured, &textured, behind),
        ("not a number", &textured, &textured, [f32::NAN; 16]),
        ("infinitely far", &textured, &textured, [f32::INFINITY; 16]),
        ("few pixels", &tiny, &tiny, projection([1e6, 0.0])),
    ];
    let mut stereo = Stereo::default();
    for (what, reference, image, projection) in cases {
        let found = stereo.depths(reference, &[Source { image, projection }], RANGE);
        assert_eq!(found.depth.len(), (reference.width() * reference.height()) as usize, "{what}");
        assert!(found.depth.iter().all(|d| (0.99 * RANGE[0]..=1.01 * RANGE[1]).contains(d)), "{what}");
        assert!(found.confidence.iter().all(|c| (0.0..0.5).contains(c)), "{what}");
    }
    assert!(stereo.depths(&textured, &[], RANGE).confidence.iter().all(|c| *c < 0.5), "no source");
}

#[test]
fn strips_of_one_row_or_column_are_matched_like_other_pictures() {
    let mut stereo = Stereo::default();
    for (w, h) in [(640, 1), (1, 640), (640, 15), (640, 17), (1, 1)] {
        let image = RgbImage::from_fn(w, h, |x, y| Rgb([(x * 7 + y * 3) as u8; 3]));
        let source = Source { image: &image, projection: projection([1.0, 0.0]) };
        let found = stereo.depths(&image, &[source; 4], RANGE);
        let rows = found.depth.len() / found.width;
        assert!(rows > 0 && found.width * found.cell <= w as usize && rows * found.cell <= h as usize, "{w} × {h}");
        assert!(found.depth.iter().all(|d| (0.99 * RANGE[0]..=1.01 * RANGE[1]).contains(d)), "{w} × {h}");
        let grid = crate::init::depth_frame::DepthGrid::of_cells((w as usize, h as usize), 2, &found);
        assert_eq!(grid.depth.len(), grid.width * grid.height, "{w} × {h}");
        assert!(stereo.held_bytes() <= Stereo::planned_bytes(640 * 640), "{w} × {h}");
    }
}

/// Products of features at cells that lie beyond the rim are those of the nearest cell within it.
fn correlation(features: &Features, source: usize, (x, y): (i64, i64), half: i64, shift: [f32; 2]) -> f32 {
    let finer = &features.sources[source];
    let mut sum = 0;
    for j in -half..=half {
        for i in -half..=half {
            let cx = (x + i).clamp(0, features.width as i64 - 1);
            let cy = (y + j).clamp(0, features.height as i64 - 1);
            let (u, v) = (2.0 * (cx as f32 + shift[0] + 0.5), 2.0 * (cy as f32 + shift[1] + 0.5));
            let is_inside = u >= 0.0 && v >= 0.0 && u < finer.width as f32 && v < finer.height as f32;
            let theirs = if is_inside { finer.values[v as usize * finer.width + u as usize] } else { 0 };
            sum += i64::from(features.reference[cy as usize * features.width + cx as usize]) * i64::from(theirs);
        }
    }
    sum as f32 / (((2 * half + 1) * (2 * half + 1)) as f32 * PRODUCT)
}

#[test]
fn running_sums_of_the_volume_are_the_correlations_of_its_windows() {
    let mut stereo = Stereo::default();
    with_sources(&CAMERAS, |reference, sources| {
        stereo.depths(reference, sources, RANGE);
        let inverse = Inverse::over(RANGE);
        let (w, h) = stereo.volume.size();
        for plane in [0, 17, 40, 63] {
            for y in [0, 1, 9, 36, 60, 71] {
                for x in [0, 2, 11, 48, 90, 95] {
                    let mut found: Vec<f32> = (0..sources.len())
                        .filter_map(|s| {
                            let shift = CAMERAS[s].map(|v| -FOCAL * v * inverse.at(plane as f32));
                            let (u, v) = (x as f32 + shift[0] + 0.5, y as f32 + shift[1] + 0.5);
                            let is_seen = u >= 0.0 && v >= 0.0 && u < w as f32 && v < h as f32;
                            let of = |half| correlation(&stereo.features, s, (x, y), half, shift);
                            is_seen.then(|| 0.8 * of(3) + 0.2 * of(10))
                        })
                        .collect();
                    found.sort_by(|a, b| b.total_cmp(a));
                    let best = found.first().copied().unwrap_or(0.0);
                    let second = found.get(1).copied().unwrap_or(best);
                    let cost = UNIT as f32 * (1.0 - 0.65 * best - 0.35 * second);
                    let made = f32::from(stereo.volume.costs[plane * w * h + y as usize * w + x as usize]);
                    // Correlations and costs are whole numbers, rounded towards 0.
                    assert!((made - cost.clamp(0.0, 255.0)).abs() <= 2.0, "{plane} {x} {y}: {made} {cost}");
                }
            }
        }
    });
}

/// Sums of the cheapest ways to (x, y) along one direction, by the definition: equation 13 of Hirschmüller's paper.
fn way(volume: &Volume, luminance: &[f32], (x, y): (i64, i64), step: (i64, i64)) -> [i32; PLANES] {
    let (w, h) = volume.size();
    let own = |x: i64, y: i64| -> [i32; PLANES] {
        std::array::from_fn(|d| i32::from(volume.costs[d * w * h + y as usize * w + x as usize]))
    };
    let is_inside = |x: i64, y: i64| x >= 0 && y >= 0 && x < w as i64 && y < h as i64;
    let mut from = (x, y);
    while is_inside(from.0 - step.0, from.1 - step.1) {
        from = (from.0 - step.0, from.1 - step.1);
    }
    let mut costs = own(from.0, from.1);
    while from != (x, y) {
        let to = (from.0 + step.0, from.1 + step.1);
        let light = |(x, y): (i64, i64)| luminance[y as usize * w + x as usize];
        let large = (5.0 / (1.0 + 8.0 * (light(to) - light(from)).abs())).max(0.75);
        let [small, large] = [0.5, large].map(|penalty: f32| (UNIT as f32 * penalty) as i32);
        let least = costs.iter().copied().min().unwrap_or(0);
        let here = own(to.0, to.1);
        costs = std::array::from_fn(|d| {
            let beside = [d.checked_sub(1), Some(d + 1)];
            let beside = beside.into_iter().flatten().filter_map(|d| costs.get(d)).map(|c| c + small);
            here[d] + beside.chain([costs[d], least + large]).min().unwrap_or(0) - least
        });
        from = to;
    }
    costs
}

#[test]
fn sums_of_the_paths_are_those_of_eight_directions() {
    let mut stereo = Stereo::default();
    with_sources(&CAMERAS[..3], |reference, sources| {
        stereo.depths(reference, sources, RANGE);
        let (w, _) = stereo.volume.size();
        for (x, y) in [(0, 0), (95, 0), (0, 71), (95, 71), (48, 36), (1, 50), (70, 3)] {
            let mut sums = [0; PLANES];
            for step in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)] {
                let way = way(&stereo.volume, &stereo.features.luminance, (x, y), step);
                sums.iter_mut().zip(way).for_each(|(sum, cost)| *sum += cost);
            }
            let made = stereo.paths.sums[y as usize * w + x as usize].map(i32::from);
            assert_eq!(made, sums, "{x} {y}");
        }
    });
}

#[test]
fn what_is_held_is_within_the_plan_and_given_back() {
    for (w, h) in [(640, 480), (640, 160), (512, 512), (320, 240), (480, 640)] {
        let image = RgbImage::from_fn(w, h, |x, y| Rgb([(x * 7 + y * 3) as u8; 3]));
        let source = Source { image: &image, projection: projection([1.0, 0.0]) };
        let mut stereo = Stereo::default();
        stereo.depths(&image, &[source; 6], RANGE);
        let (held, planned) = (stereo.held_bytes(), Stereo::planned_bytes(u64::from(w * h)));
        assert!(held <= planned && 4 * held > planned, "{w} × {h}: {held} of {planned}");
        stereo.close();
        assert_eq!(stereo.held_bytes(), 0);
    }
}

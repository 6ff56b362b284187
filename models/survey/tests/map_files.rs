//! The files of a map as another program reads them (crate `tiff`; `tests/maps.sh` asks GDAL).
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use std::fs::File;
use std::path::Path;

use disk::Disk;
use geometry::geodesy::Geodetic;
use glam::{DVec2, DVec3};
use survey::ortho::crs::Crs;
use survey::ortho::files::{MapFiles, NO_HEIGHT, Pixels};
use survey::ortho::grid::{BLOCK, Block, Grid};
use survey::ortho::height_raster;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

const ORIGIN: Geodetic = Geodetic { lat_deg: 53.38, lon_deg: -1.47, alt_m: 60.0 };

fn grid(crs: Crs, metres: [f64; 2], gsd: f64) -> Grid {
    let low = crs.to_map(DVec3::new(12.3, 4.5, 0.0)).unwrap().truncate();
    Grid::new(crs, [low, low + DVec2::from(metres)], gsd).unwrap()
}

fn color(x: u32, y: u32) -> [u8; 4] {
    [(x % 251) as u8, (y % 241) as u8, 77, 255]
}

fn height(x: u32, y: u32) -> f32 {
    60.0 + x as f32 * 0.01 - y as f32 * 0.02
}

/// Every block but the second, whose ground nobody saw; a corner of the first is uncovered.
fn write(grid: &Grid, folder: &Path) -> u64 {
    let mut files = MapFiles::begin(folder, grid).unwrap();
    for (i, block) in files.blocks().to_vec().into_iter().enumerate().filter(|(i, _)| *i != 1) {
        let Block { x, y, width, height: rows } = block;
        let pixels = (0..rows).flat_map(|v| (0..width).map(move |u| (x + u, y + v)));
        let bare = |x: u32, y: u32| i == 0 && x < 10 && y < 10;
        let mut rgba: Vec<u8> =
            pixels.clone().flat_map(|(x, y)| if bare(x, y) { [0; 4] } else { color(x, y) }).collect();
        let heights: Vec<f32> = pixels.map(|(x, y)| if bare(x, y) { NO_HEIGHT } else { height(x, y) }).collect();
        let part = |of: f32| heights.iter().map(|z| if *z == NO_HEIGHT { *z } else { of * z }).collect::<Vec<f32>>();
        let (height_sigmas, plane_sigmas) = (part(0.01), part(0.02));
        let pixels =
            Pixels { rgba: &mut rgba, heights: &heights, height_sigmas: &height_sigmas, plane_sigmas: &plane_sigmas };
        files.write(block, pixels).unwrap();
    }
    let written = files.finish(&Disk::default(), Some(ORIGIN)).unwrap();
    let [height, plane] = written.sigma_m.map(|median| median.unwrap());
    assert!((0.5..0.7).contains(&height) && (plane / height - 2.0).abs() < 0.1, "{height} {plane}");
    written.covered
}

#[test]
fn another_program_reads_the_pixels_the_place_and_the_overviews() {
    let folder = tempfile::tempdir().unwrap();
    let grid = grid(Crs::utm(ORIGIN).unwrap(), [650.0, 350.0], 0.5);
    let [columns, rows] = grid.size();
    let covered = write(&grid, folder.path());
    assert_eq!(covered, u64::from(columns) * u64::from(rows) - 100 - u64::from(BLOCK * BLOCK));
    for (name, of) in [("ortho.tif", 0.0), ("dsm.tif", 1.0), ("dsm_sigma.tif", 0.01), ("ortho_sigma.tif", 0.02)] {
        let file = File::open(folder.path().join(name)).unwrap();
        let mut tif = Decoder::new(file).unwrap().with_limits(Limits::unlimited());
        assert_eq!(tif.dimensions().unwrap(), (columns, rows));
        let [west, north] = grid.corner();
        assert_eq!(tif.get_tag_f64_vec(Tag::ModelPixelScaleTag).unwrap()[..2], [0.5, 0.5]);
        assert_eq!(tif.get_tag_f64_vec(Tag::ModelTiepointTag).unwrap(), [0.0, 0.0, 0.0, west, north, 0.0]);
        let keys = tif.get_tag_u16_vec(Tag::GeoKeyDirectoryTag).unwrap();
        // ProjectedCSTypeGeoKey (3072): UTM zone 30 north; GTRasterTypeGeoKey (1025): pixels are areas.
        assert!(keys.chunks(4).any(|k| k == [3072, 0, 1, 32_630]), "{keys:?}");
        assert!(keys.chunks(4).any(|k| k == [1025, 0, 1, 1]), "{keys:?}");
        match tif.read_image().unwrap() {
            DecodingResult::U8(bytes) => {
                let at = |x: u32, y: u32| -> [u8; 4] {
                    let i = 4 * (y * columns + x) as usize;
                    bytes[i..i + 4].try_into().unwrap()
                };
                for (x, y) in [(10, 0), (511, 511), (5, 512), (columns - 1, rows - 1)] {
                    assert_eq!(at(x, y), color(x, y), "{x} {y}");
                }
                assert_eq!((at(0, 0)[3], at(600, 100)[3]), (0, 0), "bare ground is transparent");
            }
            DecodingResult::F32(heights) => {
                assert_eq!(tif.get_tag_ascii_string(Tag::GdalNodata).unwrap(), "-9999");
                let at = |x: u32, y: u32| heights[(y * columns + x) as usize];
                for (x, y) in [(10, 0), (511, 511), (5, 512), (columns - 1, rows - 1)] {
                    assert_eq!(at(x, y), of * height(x, y), "{x} {y}");
                }
                assert_eq!((at(0, 0), at(600, 100)), (NO_HEIGHT, NO_HEIGHT));
            }
            other => panic!("{name} holds {other:?}"),
        }
        let mut overviews = 0;
        while tif.more_images() {
            tif.next_image().unwrap();
            overviews += 1;
        }
        let side = columns.max(rows) >> overviews;
        assert!(overviews >= 1 && side <= BLOCK, "{overviews} overviews");
    }
    let points = height_raster::read(&folder.path().join("dsm.tif"), Some(ORIGIN), grid.bounds().unwrap()).unwrap();
    assert!(points.len() as f64 > 0.9 * f64::min(covered as f64, 65_536.0), "{} points", points.len());
    for point in points {
        let at = grid.crs().to_map(point).unwrap();
        let pixel = grid.pixel(at.truncate()).floor();
        assert!((at.z - f64::from(height(pixel.x as u32, pixel.y as u32))).abs() < 1e-4, "{at} at {pixel}");
    }
    let world = std::fs::read_to_string(folder.path().join("ortho.tfw")).unwrap();
    let lines: Vec<f64> = world.lines().map(|l| l.parse().unwrap()).collect();
    assert_eq!(lines[..4], [0.5, 0.0, 0.0, -0.5]);
    assert_eq!(lines[4..], [grid.corner()[0] + 0.25, grid.corner()[1] - 0.25]);
    let georef: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path().join("map.georef.json")).unwrap()).unwrap();
    assert_eq!((georef["crs"].as_str(), georef["covered_pixels"].as_u64()), (Some("EPSG:32630"), Some(covered)));
    for name in ["ortho.png", "dsm.png"] {
        let small = image::open(folder.path().join(name)).unwrap();
        assert!(small.width() <= 640 && small.height() <= 640 && small.width() > 300);
    }
    let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 11, "nothing else stays: {left:?}");
}

#[test]
fn a_map_in_its_own_metres_names_no_reference_system() {
    let folder = tempfile::tempdir().unwrap();
    write(&grid(Crs::local(), [300.0, 200.0], 0.25), folder.path());
    let mut tif = Decoder::new(File::open(folder.path().join("dsm.tif")).unwrap()).unwrap();
    assert_eq!(tif.get_tag_f64_vec(Tag::ModelPixelScaleTag).unwrap()[..2], [0.25, 0.25]);
    let keys = tif.get_tag_u16_vec(Tag::GeoKeyDirectoryTag).unwrap_or_default();
    assert!(!keys.chunks(4).any(|k| k[0] == 3072), "{keys:?}");
}

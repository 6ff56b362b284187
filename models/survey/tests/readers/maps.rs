//! What maps are measured against: surveyed points and rasters of heights.

use std::io::Cursor;

use geometry::geodesy::Geodetic;
use glam::DVec2;
use survey::ortho;
use tiff::encoder::colortype::Gray32Float;
use tiff::encoder::{Compression, TiffEncoder};
use tiff::tags::Tag;

use crate::driver::{Read, Reader, line, survive};

#[test]
fn check_points() {
    let origin = Geodetic { lat_deg: 28.04, lon_deg: -82.7, alt_m: 3.0 };
    let seeds = [
        "WGS84 UTM 17N\n333158.20 3102916.18 3 2699.43 1668.72 a.jpg\n333100.5 3102900 4.5 1 1 b.jpg first\n",
        "+proj=utm +zone=17 +datum=WGS84 +units=m +no_defs\n333158.20 3102916.18 3\n",
        "EPSG:4326\n-82.7 28.04 3\n-82.701 28.041 5\n",
        "name,lat,lon,alt\na,28.04,-82.7,3\nb,28.041,-82.701,4\n",
        "x y z\n1 2 3\n4 5 6\n",
    ];
    survive(&Reader {
        name: "check points",
        seeds: seeds.map(|s| s.as_bytes().to_vec()).into(),
        text: true,
        shell: None,
        memory: (64 << 10, 256),
        read: Read::File("gcp_list.txt", &|path| {
            line(ortho::check_points::read(path, Some(origin)), |points| points.iter().all(|p| p.is_finite()))
        }),
    });
}

/// A raster of 3 × 2 heights in UTM zone 17, at pixels of 1 m.
fn heights(compressed: Compression) -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let mut tiff = TiffEncoder::new(&mut file).expect("an encoder").with_compression(compressed);
    let mut image = tiff.new_image::<Gray32Float>(3, 2).expect("an image");
    let tags = image.encoder();
    tags.write_tag(Tag::ModelPixelScaleTag, &[1.0, 1.0, 0.0][..]).expect("a tag");
    tags.write_tag(Tag::ModelTiepointTag, &[0.0, 0.0, 0.0, 333_158.0, 3_102_916.0, 0.0][..]).expect("a tag");
    tags.write_tag(Tag::GdalNodata, "-9999").expect("a tag");
    let keys = [1u16, 1, 0, 2, 1025, 0, 1, 1, 3072, 0, 1, 32_617];
    tags.write_tag(Tag::GeoKeyDirectoryTag, &keys[..]).expect("a tag");
    image.write_data(&[1.0, 2.0, -9999.0, 4.0, 5.0, 6.5]).expect("pixels");
    file.into_inner()
}

#[test]
fn rasters_of_heights() {
    let origin = Geodetic { lat_deg: 28.04, lon_deg: -82.7, alt_m: 3.0 };
    let bounds = [DVec2::splat(-1e6), DVec2::splat(1e6)];
    survive(&Reader {
        name: "height raster",
        seeds: [Compression::Uncompressed, Compression::Lzw, Compression::Deflate(Default::default())]
            .map(heights)
            .into(),
        text: false,
        shell: None,
        memory: (2 << 20, 4096),
        read: Read::File("dsm.tif", &|path| {
            line(ortho::height_raster::read(path, Some(origin), bounds), |points| points.iter().all(|p| p.is_finite()))
        }),
    });
}

//! The map as a GIS shows it: a GeoTIFF of four bands, a pixel per square of ground.

use std::io::Cursor;

use geometry::geodesy::Geodetic;
use geotiff_writer::{Compression, GeoTiffBuilder, PlanarConfiguration};
use ndarray::Array3;

use super::CoverageMap;
use crate::ortho::OrthoError;
use crate::ortho::crs::Crs;
use crate::ortho::files::NO_HEIGHT;

/// What is not known, in all bands.
const NOTHING: f32 = NO_HEIGHT;
/// Number of pictures, widest angle between two of them in degrees, finest ground sampling distance in metres, expected
/// standard deviation of a height in metres.
const BANDS: usize = 4;

/// The file's bytes; squares outside of the region hold nothing. In the UTM zone of `origin`, the squares turned by the
/// meridian's convergence as they lie; without one in the map's own metres.
///
/// # Errors
/// The reference system ends inside of the map, or the writer's.
pub fn encode(map: &CoverageMap, origin: Option<Geodetic>) -> Result<Vec<u8>, OrthoError> {
    let crs = origin.map_or_else(|| Ok(Crs::local()), Crs::utm)?;
    let grid = map.grid();
    let (columns, rows) = (grid.columns, grid.rows);
    // Rows of the file go south, those of the map north.
    let at = |column: usize, row: usize| map.cell(column, rows - 1 - row);
    let bands = Array3::from_shape_fn((rows, columns, BANDS), |(row, column, band)| {
        let Some(cell) = at(column, row) else { return NOTHING };
        match band {
            0 => f32::from(cell.pictures),
            1 => cell.angle_deg as f32,
            2 => cell.gsd_m.map_or(NOTHING, |m| m as f32),
            _ => cell.sigma_z_m.map_or(NOTHING, |m| m as f32),
        }
    });
    let corner = |x: usize, y: usize| {
        let place = grid.corner + grid.side_m * glam::DVec2::new(x as f64, y as f64);
        crs.to_map(place.extend(map.base_m()))
    };
    let (north_west, north_east, south_west) = (corner(0, rows)?, corner(columns, rows)?, corner(0, 0)?);
    let (east, south) = ((north_east - north_west) / columns as f64, (south_west - north_west) / rows as f64);
    let matrix =
        [[east.x, south.x, 0.0, north_west.x], [east.y, south.y, 0.0, north_west.y], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
    let mut builder = GeoTiffBuilder::new(columns as u32, rows as u32)
        .bands(BANDS as u32)
        .planar_configuration(PlanarConfiguration::Planar)
        .transformation_matrix(matrix.as_flattened().try_into().unwrap_or_default())
        .compression(Compression::Deflate)
        .nodata(&NOTHING.to_string());
    if let Some(code) = crs.epsg() {
        builder = builder.projected_epsg(code);
    }
    let mut bytes = Cursor::new(Vec::new());
    let failed = |source| OrthoError::Tiff { path: "coverage.tif".into(), source };
    builder.write_3d_to(&mut bytes, bands.view()).map_err(failed)?;
    Ok(bytes.into_inner())
}

#[cfg(test)]
mod tests {
    use config::coverage::CoverageSettings;
    use glam::{DMat3, DQuat, DVec2, DVec3};
    use tiff::decoder::{Decoder, DecodingResult};
    use tiff::tags::Tag;

    use super::super::CoverageRegion;
    use super::*;
    use models::camera::{Intrinsics, Pose, View};

    #[test]
    fn another_program_finds_each_square_where_it_lies() {
        let origin = Geodetic { lat_deg: 53.38, lon_deg: -1.47, alt_m: 60.0 };
        let square = [[0.0, 0.0], [80.0, 0.0], [80.0, 60.0], [0.0, 60.0]];
        let region = CoverageRegion::new(square.map(DVec2::from).to_vec()).unwrap();
        let mut map = CoverageMap::new(&region, 0.0, CoverageSettings::default()).unwrap();
        let down = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z));
        let intrinsics = Intrinsics { width: 640, height: 480, fx: 480.0, fy: 480.0, cx: 320.0, cy: 240.0 };
        let pose = Pose { rotation: down, center: DVec3::new(10.0, 50.0, 20.0) };
        map.add(&View { intrinsics, pose });
        let bytes = encode(&map, Some(origin)).unwrap();
        let mut file = Decoder::new(Cursor::new(&bytes)).unwrap();
        let (columns, rows) = file.dimensions().unwrap();
        assert_eq!((columns as usize, rows as usize), (map.grid().columns, map.grid().rows));
        let keys = file.get_tag_u16_vec(Tag::GeoKeyDirectoryTag).unwrap();
        assert!(keys.chunks(4).any(|k| k == [3072, 0, 1, 32_630]), "{keys:?}");
        let m = file.get_tag_f64_vec(Tag::ModelTransformationTag).unwrap();
        let crs = Crs::utm(origin).unwrap();
        // A square in the north-west, where the picture was taken.
        let (column, row) = (1, map.grid().rows - 2);
        let (u, v) = (column as f64 + 0.5, (map.grid().rows - 1 - row) as f64 + 0.5);
        let place = DVec2::new(m[0] * u + m[1] * v + m[3], m[4] * u + m[5] * v + m[7]);
        let middle = crs.to_map(map.grid().middle(column, row).extend(0.0)).unwrap().truncate();
        assert!((place - middle).length() < 1e-3, "{place} {middle}");
        let DecodingResult::F32(pictures) = file.read_image().unwrap() else { panic!("not floats") };
        assert_eq!(pictures[(map.grid().rows - 1 - row) * map.grid().columns + column], 1.0);
        assert_eq!(pictures[(map.grid().rows - 1) * map.grid().columns + map.grid().columns - 1], 0.0);
    }
}

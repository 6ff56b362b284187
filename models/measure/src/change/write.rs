//! What changed, as files for other programs: polygons as GeoJSON (RFC 7946) and KML, and a table.

use std::io::{self, Cursor, Write};

use geotiff_writer::{Compression, GeoTiffBuilder, Predictor, RasterType};
use glam::DVec2;
use ndarray::Array3;
use serde_json::json;
use survey::coordinates::Reference;

use super::compare::Difference;
use super::spots::Spot;
use crate::MeasureError;
use crate::written::{collection, place};

/// Side of a tile, pixels.
const TILE: u32 = 256;

/// The differences as a GeoTIFF of two channels: metres, and standard deviations of each difference that those are. NaN where one of
/// the two maps saw nothing.
///
/// # Errors
/// The raster cannot be encoded.
pub fn raster(difference: &Difference, epsg: Option<u16>) -> Result<Vec<u8>, MeasureError> {
    let [w, h] = difference.grid.size();
    let (corner, pixel) = difference.grid.corner();
    let failed = |e: &dyn std::fmt::Display| MeasureError::Request(format!("the differences make no GeoTIFF ({e})"));
    let channel = |y: usize, x: usize, c: usize| {
        let metres = difference.metres[y * w + x];
        if c == 0 { metres } else { metres / difference.sigma[y * w + x] }
    };
    let values = Array3::from_shape_fn((h, w, 2), |(y, x, c)| channel(y, x, c));
    let size = |n: usize| u32::try_from(n).map_err(|e| failed(&e));
    let builder = GeoTiffBuilder::new(size(w)?, size(h)?)
        .bands(2)
        .pixel_scale(pixel.x, pixel.y)
        .origin(corner.x, corner.y)
        .raster_type(RasterType::PixelIsArea)
        .tile_size(TILE, TILE)
        .compression(Compression::Deflate)
        .predictor(Predictor::FloatingPoint)
        .nodata("nan");
    let builder = epsg.map_or(builder.clone(), |code| builder.projected_epsg(code));
    let mut file = Cursor::new(Vec::new());
    builder.write_3d_to(&mut file, values.view()).map_err(|e| failed(&e))?;
    Ok(file.into_inner())
}

/// Its rings, each ending with the corner it begins with.
fn rings(spot: &Spot, reference: Option<&Reference>) -> io::Result<Vec<Vec<[f64; 2]>>> {
    let ring = |corners: &Vec<DVec2>| corners.iter().chain(corners.first()).map(|p| place(p, reference)).collect();
    spot.rings.iter().map(ring).collect()
}

/// Writes the spots as a FeatureCollection.
///
/// # Errors
/// Errors of `out`, or a place outside of the reference system.
pub fn geojson(out: &mut dyn Write, spots: &[Spot], reference: Option<&Reference>) -> io::Result<()> {
    write!(out, "{}", collection(reference))?;
    for (k, spot) in spots.iter().enumerate() {
        let feature = json!({
            "type": "Feature",
            "geometry": { "type": "Polygon", "coordinates": rings(spot, reference)? },
            "properties": {
                "name": (k + 1).to_string(),
                "area_m2": spot.area_m2,
                "height_m": spot.height_m.value,
                "height_sigma_m": spot.height_m.sigma,
                "most_m": spot.most_m,
                "volume_m3": spot.volume_m3.value,
                "volume_sigma_m3": spot.volume_m3.sigma,
            },
        });
        write!(out, "{}{feature}", if k > 0 { ",\n" } else { "\n" })?;
    }
    writeln!(out, "\n]}}")
}

/// Writes the spots as KML; it has degrees alone.
///
/// # Errors
/// Errors of `out`, or a place outside of the reference system.
pub fn kml(out: &mut dyn Write, spots: &[Spot], reference: &Reference) -> io::Result<()> {
    writeln!(
        out,
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<kml xmlns=\"http://www.opengis.net/kml/2.2\"><Document>"
    )?;
    for (k, spot) in spots.iter().enumerate() {
        let (height, volume) = (spot.height_m, spot.volume_m3);
        write!(
            out,
            "<Placemark><name>{}</name><description>{:.2} m2, {:+.2} ± {:.2} m, {:+.2} ± {:.2} m3</description><Polygon>",
            k + 1,
            spot.area_m2,
            height.value,
            height.sigma,
            volume.value,
            volume.sigma
        )?;
        for (k, ring) in rings(spot, Some(reference))?.iter().enumerate() {
            let kind = if k == 0 { "outer" } else { "inner" };
            let corners: Vec<String> = ring.iter().map(|[lon, lat]| format!("{lon},{lat}")).collect();
            let corners = corners.join(" ");
            write!(
                out,
                "<{kind}BoundaryIs><LinearRing><coordinates>{corners}</coordinates></LinearRing></{kind}BoundaryIs>"
            )?;
        }
        writeln!(out, "</Polygon></Placemark>")?;
    }
    writeln!(out, "</Document></kml>")
}

/// Writes the spots as a table with commas between its cells.
///
/// # Errors
/// Errors of `out`.
pub fn table(out: &mut dyn Write, spots: &[Spot]) -> io::Result<()> {
    writeln!(out, "name,east_m,north_m,area_m2,height_m,height_sigma_m,most_m,volume_m3,volume_sigma_m3")?;
    for (k, s) in spots.iter().enumerate() {
        let [h, v] = [s.height_m, s.volume_m3].map(|m| (m.value, m.sigma));
        writeln!(
            out,
            "{},{:.2},{:.2},{:.2},{:.3},{:.3},{:.3},{:.3},{:.3}",
            k + 1,
            s.middle.x,
            s.middle.y,
            s.area_m2,
            h.0,
            h.1,
            s.most_m,
            v.0,
            v.1
        )?;
    }
    Ok(())
}

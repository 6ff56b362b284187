//! The files of a map: `ortho.tif` (8-bit RGBA) and `dsm.tif` (heights, f32 metres) as Cloud-Optimised GeoTIFF, a world file
//! and a small picture beside each, and `map.georef.json`. Blocks go to scratch files as they come, so that memory does not
//! grow with the map. The TIFF writer keeps its own in the system's temporary folder (`tempfile::env`).

use std::fs::File;
use std::io::{Seek, SeekFrom, Write, copy};
use std::path::{Path, PathBuf};

use disk::Disk;
use geometry::geodesy::Geodetic;
use geotiff_writer::{
    CogBuilder, CogTileWriter, Compression, ExtraSample, GeoTiffBuilder, NumericSample, PhotometricInterpretation,
    Predictor, RasterType, Resampling,
};
use ndarray::{ArrayView2, ArrayView3};
use serde::Serialize;

use super::OrthoError;
use super::georef::VERTICAL;
use super::grid::{BLOCK, Block, Grid};
use super::preview::Preview;
pub use super::preview::preview_step;
use models::formats::FormatError;

/// Height where there is none.
pub const NO_HEIGHT: f32 = -9999.0;
/// Deflate's level, 1 to 9.
const DEFLATE: u32 = 4;
/// A map that is being written.
pub struct MapFiles<'a> {
    folder: PathBuf,
    grid: &'a Grid,
    colors: CogTileWriter<u8, File>,
    heights: CogTileWriter<f32, File>,
    preview: Preview,
    covered: u64,
    blocks: Vec<Block>,
}

/// What was written.
#[derive(Clone, Debug, PartialEq)]
pub struct Written {
    /// The files, the two maps first.
    pub files: Vec<PathBuf>,
    /// Pixels that hold ground.
    pub covered: u64,
}

/// What `map.georef.json` says.
#[derive(Serialize)]
struct Georef {
    files: [&'static str; 2],
    /// `None`: the scene's own metres.
    crs: Option<String>,
    /// Easting and northing of the north-western corner, and the side of a pixel; pixels are areas, rows go south.
    west: f64,
    north: f64,
    gsd_m: f64,
    columns: u32,
    rows: u32,
    covered_pixels: u64,
    origin: Option<Geodetic>,
    vertical: &'static str,
    no_height: f32,
}

impl<'a> MapFiles<'a> {
    /// Makes the folder and the scratch files in it.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn begin(folder: &Path, grid: &'a Grid) -> Result<Self, OrthoError> {
        std::fs::create_dir_all(folder).map_err(|e| FormatError::io(folder, "making the folder", e))?;
        let scratch = || tempfile::tempfile_in(folder).map_err(|e| FormatError::io(folder, "making a scratch file", e));
        let [columns, rows] = grid.size();
        let levels: Vec<u32> = (1..16).map(|k| 1 << k).take_while(|l| columns.max(rows) > BLOCK * l / 2).collect();
        let build = |bands: u32, predictor| {
            let [west, north] = grid.corner();
            // Not sparse: only GDAL reads files whose empty tiles are not there.
            let builder = GeoTiffBuilder::new(columns, rows)
                .bands(bands)
                .pixel_scale(grid.gsd(), grid.gsd())
                .origin(west, north)
                .raster_type(RasterType::PixelIsArea)
                .tile_size(BLOCK, BLOCK)
                .compression(Compression::Deflate)
                .deflate_level(DEFLATE)
                .predictor(predictor);
            match grid.crs().epsg() {
                Some(code) => builder.projected_epsg(code),
                None => builder,
            }
        };
        let rgba = build(4, Predictor::Horizontal)
            .photometric(PhotometricInterpretation::Rgb)
            .extra_samples(vec![ExtraSample::UnassociatedAlpha]);
        let dsm = build(1, Predictor::FloatingPoint).nodata(&NO_HEIGHT.to_string());
        let of = |b| CogBuilder::new(b).overview_levels(levels.clone()).resampling(Resampling::Average);
        let refused = |name: &str| {
            let path = folder.join(name);
            move |source| OrthoError::Tiff { path, source }
        };
        Ok(Self {
            colors: of(rgba).tile_writer(scratch()?).map_err(refused("ortho.tif"))?,
            heights: of(dsm).tile_writer(scratch()?).map_err(refused("dsm.tif"))?,
            preview: Preview::of(grid),
            folder: folder.to_owned(),
            grid,
            covered: 0,
            blocks: grid.blocks().collect(),
        })
    }

    /// The blocks to write, each once or, where no ground is, not at all.
    pub fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    /// Writes a block: colours (alpha 0 where there is no ground) and heights ([`NO_HEIGHT`] there), row by row.
    ///
    /// # Errors
    /// Sizes that are not the block's, a block written twice, a full disk.
    pub fn write(&mut self, block: Block, rgba: &mut [u8], heights: &[f32]) -> Result<(), OrthoError> {
        let size = (block.height as usize, block.width as usize);
        let wrong = || OrthoError::Request(format!("a block of {} × {} pixels has other data", size.1, size.0));
        let covered = rgba.chunks_exact(4).filter(|p| p[3] > 0).count();
        if rgba.len() != 4 * size.0 * size.1 || heights.len() != size.0 * size.1 {
            return Err(wrong());
        }
        if covered == 0 {
            return Ok(());
        }
        self.preview.add(block, rgba, heights);
        fill_uncovered(rgba, covered);
        let at = (block.x as usize, block.y as usize);
        let colors = ArrayView3::from_shape((size.0, size.1, 4), &*rgba).map_err(|_| wrong())?;
        self.colors.write_tile_3d(at.0, at.1, &colors).map_err(self.tiff("ortho.tif"))?;
        let heights = ArrayView2::from_shape(size, heights).map_err(|_| wrong())?;
        self.heights.write_tile(at.0, at.1, &heights).map_err(self.tiff("dsm.tif"))?;
        self.covered += covered as u64;
        Ok(())
    }

    /// Makes the overviews and puts all files in place through `disk`. `origin` is the model's.
    ///
    /// # Errors
    /// A full disk; the files of an earlier map stay then.
    pub fn finish(self, disk: &Disk, origin: Option<Geodetic>) -> Result<Written, OrthoError> {
        let path = |name: &str| self.folder.join(name);
        let mut files = vec![path("ortho.tif"), path("dsm.tif")];
        finish(self.colors, disk, &files[0])?;
        finish(self.heights, disk, &files[1])?;
        let ([west, north], gsd, [columns, rows]) = (self.grid.corner(), self.grid.gsd(), self.grid.size());
        for name in ["ortho.tfw", "dsm.tfw"] {
            files.push(path(name));
            // The middle of the north-western pixel, as ESRI defined it.
            let text = format!("{gsd}\n0\n0\n{}\n{}\n{}\n", -gsd, west + 0.5 * gsd, north - 0.5 * gsd);
            replace(disk, &path(name), |out| out.write_all(text.as_bytes()))?;
        }
        let georef = Georef {
            files: ["ortho.tif", "dsm.tif"],
            crs: self.grid.crs().epsg().map(|code| format!("EPSG:{code}")),
            west,
            north,
            gsd_m: gsd,
            columns,
            rows,
            covered_pixels: self.covered,
            origin,
            vertical: VERTICAL,
            no_height: NO_HEIGHT,
        };
        files.push(path("map.georef.json"));
        replace(disk, &path("map.georef.json"), |out| Ok(serde_json::to_writer_pretty(out, &georef)?))?;
        files.extend([path("ortho.png"), path("dsm.png")]);
        self.preview.write(disk, &path("ortho.png"), &path("dsm.png"))?;
        Ok(Written { files, covered: self.covered })
    }

    fn tiff(&self, name: &str) -> impl FnOnce(geotiff_writer::Error) -> OrthoError + use<> {
        let path = self.folder.join(name);
        move |source| OrthoError::Tiff { path, source }
    }
}

/// Pixels without ground take the mean colour of those with it, still transparent: the means that overviews are made of
/// would else be darkened along every edge.
fn fill_uncovered(rgba: &mut [u8], covered: usize) {
    let mut sums = [0u64; 3];
    for p in rgba.chunks_exact(4).filter(|p| p[3] > 0) {
        (0..3).for_each(|c| sums[c] += u64::from(p[c]));
    }
    let mean = sums.map(|s| (s / covered as u64) as u8);
    rgba.chunks_exact_mut(4).filter(|p| p[3] == 0).for_each(|p| p[..3].copy_from_slice(&mean));
}

/// From scratch to its place, synced and renamed.
fn finish<T: NumericSample>(tiles: CogTileWriter<T, File>, disk: &Disk, path: &Path) -> Result<(), OrthoError> {
    let mut whole = tiles.finish().map_err(|source| OrthoError::Tiff { path: path.to_owned(), source })?;
    whole.seek(SeekFrom::Start(0)).map_err(|e| FormatError::io(path, "reading its scratch file", e))?;
    Ok(replace(disk, path, |out| copy(&mut whole, out).map(|_| ()))?)
}

/// Writes a whole file.
fn replace(
    disk: &Disk,
    path: &Path,
    fill: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> Result<(), FormatError> {
    disk.replace(path, fill).map_err(|e| FormatError::disk(path, e))
}

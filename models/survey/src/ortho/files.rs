//! The files of a map: `ortho.tif` (8-bit RGBA), `dsm.tif` (heights, f32 metres) and the standard deviations of both (`ortho_sigma.tif`,
//! `dsm_sigma.tif`, f32 metres) as Cloud-Optimised GeoTIFF, world files, a small picture of the first two, and `map.georef.json`. Blocks go to scratch files as they come, so that memory does not
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

/// Height, or standard deviation, where there is none.
pub const NO_HEIGHT: f32 = -9999.0;
/// Rasters of a map: colours, heights, and what both are worth.
const RASTERS: [&str; 4] = ["ortho.tif", "dsm.tif", "dsm_sigma.tif", "ortho_sigma.tif"];
/// Deflate's level, 1 to 9.
const DEFLATE: u32 = 4;
/// A map that is being written.
pub struct MapFiles<'a> {
    folder: PathBuf,
    grid: &'a Grid,
    colors: CogTileWriter<u8, File>,
    /// Heights, their standard deviations, and those of places.
    metres: [CogTileWriter<f32, File>; 3],
    preview: Preview,
    covered: u64,
    sigmas: [Sigmas; 2],
    blocks: Vec<Block>,
}

/// A block's pixels, row by row.
pub struct Pixels<'a> {
    /// Red, green, blue, and alpha: 0 where there is no ground. Its colours are overwritten there.
    pub rgba: &'a mut [u8],
    /// Metres, or [`NO_HEIGHT`].
    pub heights: &'a [f32],
    /// Their standard deviations, metres; [`NO_HEIGHT`] where nothing vouches for a height.
    pub height_sigmas: &'a [f32],
    /// Standard deviations of where a pixel's ground lies along an axis of the plane, metres, or [`NO_HEIGHT`].
    pub plane_sigmas: &'a [f32],
}

/// What was written.
#[derive(Clone, Debug, PartialEq)]
pub struct Written {
    /// The files, the two maps first.
    pub files: Vec<PathBuf>,
    /// Pixels that hold ground.
    pub covered: u64,
    /// Medians of the standard deviations of heights, and of places along an axis of the plane, metres. None: nothing vouches for any.
    pub sigma_m: [Option<f64>; 2],
}

/// Counts of standard deviations, in steps of a 32nd of a power of two from a micrometre on.
struct Sigmas([u64; 1024]);

impl Sigmas {
    const LEAST: f32 = 1e-6;

    fn new() -> Self {
        Self([0; 1024])
    }

    fn add(&mut self, sigma: f32) {
        if sigma > 0.0 {
            let step = (32.0 * (sigma / Self::LEAST).log2()).clamp(0.0, 1023.0);
            self.0[step as usize] += 1;
        }
    }

    fn median(&self) -> Option<f64> {
        let all = self.0.iter().sum::<u64>();
        let mut below = 0;
        let step = self.0.iter().position(|n| {
            below += n;
            2 * below > all
        })?;
        Some(f64::from(Self::LEAST) * ((step as f64 + 0.5) / 32.0).exp2())
    }
}

/// What `map.georef.json` says.
#[derive(Serialize)]
struct Georef {
    files: [&'static str; 4],
    /// `None`: the scene's own metres.
    crs: Option<String>,
    /// Easting and northing of the north-western corner, and the side of a pixel; pixels are areas, rows go south.
    west: f64,
    north: f64,
    gsd_m: f64,
    columns: u32,
    rows: u32,
    covered_pixels: u64,
    /// Medians of `dsm_sigma.tif` and `ortho_sigma.tif`, metres.
    height_sigma_m: Option<f64>,
    plane_sigma_m: Option<f64>,
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
        let metres = || build(1, Predictor::FloatingPoint).nodata(&NO_HEIGHT.to_string());
        let of = |b| CogBuilder::new(b).overview_levels(levels.clone()).resampling(Resampling::Average);
        let refused = |name: &str| {
            let path = folder.join(name);
            move |source| OrthoError::Tiff { path, source }
        };
        Ok(Self {
            colors: of(rgba).tile_writer(scratch()?).map_err(refused(RASTERS[0]))?,
            metres: [
                of(metres()).tile_writer(scratch()?).map_err(refused(RASTERS[1]))?,
                of(metres()).tile_writer(scratch()?).map_err(refused(RASTERS[2]))?,
                of(metres()).tile_writer(scratch()?).map_err(refused(RASTERS[3]))?,
            ],
            preview: Preview::of(grid),
            folder: folder.to_owned(),
            grid,
            covered: 0,
            sigmas: [Sigmas::new(), Sigmas::new()],
            blocks: grid.blocks().collect(),
        })
    }

    /// The blocks to write, each once or, where no ground is, not at all.
    pub fn blocks(&self) -> &[Block] {
        &self.blocks
    }

    /// Writes a block.
    ///
    /// # Errors
    /// Sizes that are not the block's, a block written twice, a full disk.
    pub fn write(&mut self, block: Block, pixels: Pixels<'_>) -> Result<(), OrthoError> {
        let size = (block.height as usize, block.width as usize);
        let wrong = || OrthoError::Request(format!("a block of {} × {} pixels has other data", size.1, size.0));
        let Pixels { rgba, heights, height_sigmas, plane_sigmas } = pixels;
        let metres = [heights, height_sigmas, plane_sigmas];
        let covered = rgba.chunks_exact(4).filter(|p| p[3] > 0).count();
        if rgba.len() != 4 * size.0 * size.1 || metres.iter().any(|m| m.len() != size.0 * size.1) {
            return Err(wrong());
        }
        if covered == 0 {
            return Ok(());
        }
        self.preview.add(block, rgba, heights);
        for (sigmas, of) in self.sigmas.iter_mut().zip([height_sigmas, plane_sigmas]) {
            of.iter().for_each(|sigma| sigmas.add(*sigma));
        }
        fill_uncovered(rgba, covered);
        let at = (block.x as usize, block.y as usize);
        let refused = |name: &str| {
            let path = self.folder.join(name);
            move |source| OrthoError::Tiff { path, source }
        };
        let colors = ArrayView3::from_shape((size.0, size.1, 4), &*rgba).map_err(|_| wrong())?;
        self.colors.write_tile_3d(at.0, at.1, &colors).map_err(refused(RASTERS[0]))?;
        for ((raster, values), name) in self.metres.iter_mut().zip(metres).zip(&RASTERS[1..]) {
            let values = ArrayView2::from_shape(size, values).map_err(|_| wrong())?;
            raster.write_tile(at.0, at.1, &values).map_err(refused(name))?;
        }
        self.covered += covered as u64;
        Ok(())
    }

    /// Makes the overviews and puts all files in place through `disk`. `origin` is the model's.
    ///
    /// # Errors
    /// A full disk; the files of an earlier map stay then.
    pub fn finish(self, disk: &Disk, origin: Option<Geodetic>) -> Result<Written, OrthoError> {
        let path = |name: &str| self.folder.join(name);
        let mut files: Vec<PathBuf> = RASTERS.map(path).to_vec();
        finish(self.colors, disk, &files[0])?;
        for (raster, path) in self.metres.into_iter().zip(&files[1..]) {
            finish(raster, disk, path)?;
        }
        let sigma_m = self.sigmas.map(|sigmas| sigmas.median());
        let ([west, north], gsd, [columns, rows]) = (self.grid.corner(), self.grid.gsd(), self.grid.size());
        // The middle of the north-western pixel, as ESRI defined it.
        let text = format!("{gsd}\n0\n0\n{}\n{}\n{}\n", -gsd, west + 0.5 * gsd, north - 0.5 * gsd);
        for name in RASTERS {
            let world = path(name).with_extension("tfw");
            replace(disk, &world, |out| out.write_all(text.as_bytes()))?;
            files.push(world);
        }
        let georef = Georef {
            files: RASTERS,
            crs: self.grid.crs().epsg().map(|code| format!("EPSG:{code}")),
            west,
            north,
            gsd_m: gsd,
            columns,
            rows,
            covered_pixels: self.covered,
            height_sigma_m: sigma_m[0],
            plane_sigma_m: sigma_m[1],
            origin,
            vertical: VERTICAL,
            no_height: NO_HEIGHT,
        };
        files.push(path("map.georef.json"));
        replace(disk, &path("map.georef.json"), |out| Ok(serde_json::to_writer_pretty(out, &georef)?))?;
        files.extend([path("ortho.png"), path("dsm.png")]);
        self.preview.write(disk, &path("ortho.png"), &path("dsm.png"))?;
        Ok(Written { files, covered: self.covered, sigma_m })
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

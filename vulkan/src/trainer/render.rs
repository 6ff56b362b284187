//! Rendering any camera at any size, in windows when it is larger than planned and in bands when it is too crowded.

use super::bands::COUNTS;
use super::frame::Window;
use super::views::is_usable;
use super::{TrainError, Trainer};
use crate::constants::TILE_HEIGHT;
use crate::layout::Frame;
use models::camera::{OrthographicView, View};

/// A rendering on the host; reused from call to call.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rendering {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// r, g, b per pixel over black; not clamped above.
    pub rgb: Vec<f32>,
    /// Alpha-blended depth along the optical axis (paper, depth equation), per pixel; of an orthographic view the median.
    pub depth: Vec<f32>,
    /// What remains of the light behind all Gaussians, per pixel, 0…1.
    pub transmittance: Vec<f32>,
}

impl Trainer {
    /// Renders the present Gaussians with all trained SH degrees, without exposure, over black.
    ///
    /// # Errors
    /// [`TrainError::BadView`] for a camera that is not finite, [`TrainError::TooWide`], [`TrainError::Gpu`].
    pub fn render(&mut self, view: &View, into: &mut Rendering) -> Result<(), TrainError> {
        let lens = view.intrinsics;
        let numbers = [lens.fx, lens.fy, lens.cx, lens.cy];
        let whole = lens.width > 0 && lens.height > 0 && lens.fx > 0.0 && lens.fy > 0.0;
        if !whole || !is_usable(&view.pose) || numbers.iter().any(|v| !v.is_finite()) {
            let why = "size, lens and pose of the camera must be finite and positive".to_owned();
            return Err(TrainError::BadView { name: "rendering".into(), why });
        }
        self.draw((lens.width, lens.height), into, |frame| frame.look(view))
    }

    /// As [`Trainer::render`], with parallel rays. Depth is the distance from the view's plane to where half of the light is
    /// gone (the median, not the mean; 0 where less than half goes): what floats thinly above the ground does not raise it.
    ///
    /// # Errors
    /// Those of [`Trainer::render`].
    pub fn render_orthographic(&mut self, view: &OrthographicView, into: &mut Rendering) -> Result<(), TrainError> {
        let whole = view.width > 0 && view.height > 0;
        if !whole || !is_usable(&view.pose) || view.pixels_per_metre.iter().any(|f| !(f.is_finite() && *f > 0.0)) {
            let why = "size, scale and pose of the orthographic camera must be finite and positive".to_owned();
            return Err(TrainError::BadView { name: "rendering".into(), why });
        }
        self.draw((view.width, view.height), into, |frame| frame.look_orthographic(view))
    }

    fn draw(
        &mut self,
        (width, height): (u32, u32),
        into: &mut Rendering,
        look: impl FnOnce(&mut Frame),
    ) -> Result<(), TrainError> {
        self.flush()?;
        (into.width, into.height) = (width, height);
        let pixels = width as usize * height as usize;
        into.rgb.resize(3 * pixels, 0.0);
        into.depth.resize(pixels, 0.0);
        into.transmittance.resize(pixels, 1.0);
        let f = &mut *self.frame;
        f.plain();
        let degree = self.settings.sh.degree_at(1.0).min(self.plan.sh_degree);
        (f.gaussians, f.sh_degree, f.divisor) = (self.gaussians as u32, degree.into(), 1);
        f.step = self.updates + 1;
        look(f);
        let whole = Window::whole(width, height);
        let rows = self.rows_per_window(&whole, width)?;
        let mut row = 0;
        while row < whole.rows {
            let window = Window { row, rows: rows.min(whole.rows - row), ..whole };
            self.draw_window(window, into)?;
            row += window.rows;
        }
        Ok(())
    }

    /// Draws a window whose cells the device holds at once, or one half of it after the other.
    fn draw_window(&mut self, window: Window, into: &mut Rendering) -> Result<(), TrainError> {
        self.frame.show(window);
        if self.scene.is_paged()
            && let Some(needed) = self.hold_region()?
        {
            let too_crowded = TrainError::TooCrowded { needed, gaussians: self.plan.gaussians };
            return window.halves().ok_or(too_crowded)?.into_iter().try_for_each(|half| self.draw_window(half, into));
        }
        self.frame.gaussians = self.gaussians as u32;
        self.write_frame();
        self.render_window()?;
        self.copy_out(into);
        Ok(self.arena.failure()?)
    }

    fn rows_per_window(&self, whole: &Window, width: u32) -> Result<u32, TrainError> {
        let by_pixels = self.plan.pixels as u64 / (u64::from(width) * u64::from(TILE_HEIGHT));
        let by_tiles = self.plan.tiles as u64 / u64::from(whole.columns);
        // A picture no higher than planned may end inside its last row of tiles.
        if u64::from(width) * u64::from(self.frame.size[1]) <= self.plan.pixels as u64 && by_tiles >= whole.rows.into()
        {
            return Ok(whole.rows);
        }
        match by_pixels.min(by_tiles) {
            0 => Err(TrainError::TooWide { width, pixels: self.plan.pixels }),
            rows => Ok(rows as u32),
        }
    }

    fn render_window(&mut self) -> Result<(), TrainError> {
        let r = self.take_recording()?;
        self.record_counting(&r);
        r.submit_and_read(&COUNTS)?;
        self.cut_bands()?;
        let single = self.bands.len() == 1;
        for band in &self.bands {
            let r = self.take_recording()?;
            self.record_emit(&r, *band, single);
            self.record_blend(&r, *band);
            r.submit_and_read(&["image", "transmittance"])?;
        }
        Ok(())
    }

    fn copy_out(&self, into: &mut Rendering) {
        let ([x, y], [width, height]) = (self.frame.region_origin, self.frame.region.map(|side| side as usize));
        let pixels = width * height;
        let image = &self.arena.slice::<[f32; 4]>(self.arena.section("image"))[..pixels];
        let left = &self.arena.slice::<f32>(self.arena.section("transmittance"))[..pixels];
        for (row, (image, left)) in image.chunks_exact(width).zip(left.chunks_exact(width)).enumerate() {
            let first = (y as usize + row) * into.width as usize + x as usize;
            for (i, p) in image.iter().enumerate() {
                into.rgb[3 * (first + i)..3 * (first + i) + 3].copy_from_slice(&p[..3]);
                into.depth[first + i] = p[3];
            }
            into.transmittance[first..first + width].copy_from_slice(left);
        }
    }
}

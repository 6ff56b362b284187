//! Rendering any camera at any size, in windows when it is larger than planned and in bands when it is too crowded.

use super::TrainError;
use crate::constants::TILE_HEIGHT;
use crate::device::Device;
use crate::device::frame::Window;
use crate::layout::Frame;
use crate::model::Model;
use crate::pictures::is_usable;
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

/// Refuses a camera that cannot be rendered.
pub(super) fn check(view: &View) -> Result<(), TrainError> {
    let lens = view.intrinsics;
    let numbers = [lens.fx, lens.fy, lens.cx, lens.cy];
    let whole = lens.width > 0 && lens.height > 0 && lens.fx > 0.0 && lens.fy > 0.0;
    if !whole || !is_usable(&view.pose) || numbers.iter().any(|v| !v.is_finite()) {
        let why = "size, lens and pose of the camera must be finite and positive".to_owned();
        return Err(TrainError::BadView { name: "rendering".into(), why });
    }
    Ok(())
}

/// Refuses an orthographic camera that cannot be rendered.
pub(super) fn check_orthographic(view: &OrthographicView) -> Result<(), TrainError> {
    let whole = view.width > 0 && view.height > 0;
    if !whole || !is_usable(&view.pose) || view.pixels_per_metre.iter().any(|f| !(f.is_finite() && *f > 0.0)) {
        let why = "size, scale and pose of the orthographic camera must be finite and positive".to_owned();
        return Err(TrainError::BadView { name: "rendering".into(), why });
    }
    Ok(())
}

/// A rendering at work.
pub(super) struct Drawing<'a> {
    pub device: &'a mut Device,
    pub model: &'a mut Model,
    pub into: &'a mut Rendering,
}

impl Drawing<'_> {
    /// Draws what `look` sees, a picture of that size.
    pub fn draw(
        &mut self,
        (width, height): (u32, u32),
        sh_degree: u8,
        look: impl FnOnce(&mut Frame),
    ) -> Result<(), TrainError> {
        self.model.flush(self.device)?;
        let into = &mut *self.into;
        (into.width, into.height) = (width, height);
        let pixels = width as usize * height as usize;
        into.rgb.resize(3 * pixels, 0.0);
        into.depth.resize(pixels, 0.0);
        into.transmittance.resize(pixels, 1.0);
        let f = &mut *self.device.frame;
        f.plain();
        (f.gaussians, f.sh_degree, f.divisor) = (self.model.gaussians as u32, sh_degree.into(), 1);
        f.step = self.model.updates + 1;
        look(f);
        let whole = Window::whole(width, height);
        let rows = self.rows_per_window(&whole, width)?;
        let mut row = 0;
        while row < whole.rows {
            let window = Window { row, rows: rows.min(whole.rows - row), ..whole };
            self.draw_window(window)?;
            row += window.rows;
        }
        Ok(())
    }

    /// Draws a window whose cells the device holds at once, or one half of it after the other.
    fn draw_window(&mut self, window: Window) -> Result<(), TrainError> {
        self.device.frame.show(window);
        if self.model.scene.is_paged()
            && let Some(needed) = self.model.hold_region(self.device)?
        {
            let too_crowded = TrainError::TooCrowded { needed, gaussians: self.device.plan().gaussians };
            return window.halves().ok_or(too_crowded)?.into_iter().try_for_each(|half| self.draw_window(half));
        }
        self.device.frame.gaussians = self.model.gaussians as u32;
        self.device.write_frame();
        self.device.draw()?;
        self.copy_out();
        Ok(self.device.arena.failure()?)
    }

    fn rows_per_window(&self, whole: &Window, width: u32) -> Result<u32, TrainError> {
        let plan = self.device.plan();
        let by_pixels = plan.pixels as u64 / (u64::from(width) * u64::from(TILE_HEIGHT));
        let by_tiles = plan.tiles as u64 / u64::from(whole.columns);
        let pixels = u64::from(width) * u64::from(self.device.frame.size[1]);
        // A picture no higher than planned may end inside its last row of tiles.
        if pixels <= plan.pixels as u64 && by_tiles >= whole.rows.into() {
            return Ok(whole.rows);
        }
        match by_pixels.min(by_tiles) {
            0 => Err(TrainError::TooWide { width, pixels: plan.pixels }),
            rows => Ok(rows as u32),
        }
    }

    fn copy_out(&mut self) {
        let Self { device, into, .. } = self;
        let ([x, y], [width, height]) = (device.frame.region_origin, device.frame.region.map(|side| side as usize));
        let pixels = width * height;
        let image = &device.arena.slice::<[f32; 4]>(device.arena.section("image"))[..pixels];
        let left = &device.arena.slice::<f32>(device.arena.section("transmittance"))[..pixels];
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

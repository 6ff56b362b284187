//! How a camera fills the uniform block of a step.

use super::bands::Band;
use crate::constants::{BLOCK, FRUSTUM_MARGIN, NEAR, TILE_HEIGHT, TILE_WIDTH};
use crate::layout::{
    FLAG_KEEP_FAINT, FLAG_KEEP_OUTSIDE, FLAG_NO_EARLY_END, FLAG_ORTHOGRAPHIC, FLAG_WHOLE_BOXES, Frame,
};
use config::training::SkipSettings;
use models::camera::{OrthographicView, Pose, View};

/// The flags of the skips that are switched off.
pub(crate) fn flags_of(skips: &SkipSettings) -> u32 {
    let off = |on: bool, flag: u32| if on { 0 } else { flag };
    off(skips.frustum, FLAG_KEEP_OUTSIDE)
        | off(skips.opacity, FLAG_KEEP_FAINT)
        | off(skips.exact_tiles, FLAG_WHOLE_BOXES)
        | off(skips.early_end, FLAG_NO_EARLY_END)
}

/// A rectangle of tiles that is rendered at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Window {
    pub column: u32,
    pub row: u32,
    pub columns: u32,
    pub rows: u32,
}

impl Window {
    pub fn whole(width: u32, height: u32) -> Self {
        Self { column: 0, row: 0, columns: width.div_ceil(TILE_WIDTH), rows: height.div_ceil(TILE_HEIGHT) }
    }

    pub fn tiles(&self) -> u32 {
        self.columns * self.rows
    }

    /// The window cut across its longer side; `None` of a single tile.
    pub fn halves(&self) -> Option<[Self; 2]> {
        let (columns, rows) = (self.columns / 2, self.rows / 2);
        if self.tiles() <= 1 {
            None
        } else if self.columns > self.rows {
            let right = Self { column: self.column + columns, columns: self.columns - columns, ..*self };
            Some([Self { columns, ..*self }, right])
        } else {
            let below = Self { row: self.row + rows, rows: self.rows - rows, ..*self };
            Some([Self { rows, ..*self }, below])
        }
    }
}

impl Frame {
    /// Sets camera and picture size.
    pub fn look(&mut self, view: &View) {
        let lens = view.intrinsics;
        self.place_camera(&view.pose);
        self.focal = [lens.fx, lens.fy];
        self.principal_point = [lens.cx, lens.cy];
        let (width, height) = (lens.width as f32, lens.height as f32);
        let margin_x = FRUSTUM_MARGIN * 0.5 * width / lens.fx;
        let margin_y = FRUSTUM_MARGIN * 0.5 * height / lens.fy;
        self.min_ratio = [-lens.cx / lens.fx - margin_x, -lens.cy / lens.fy - margin_y];
        self.max_ratio = [(width - lens.cx) / lens.fx + margin_x, (height - lens.cy) / lens.fy + margin_y];
        self.size = [lens.width, lens.height];
        self.show(Window::whole(lens.width, lens.height));
    }

    /// Sets an orthographic camera and its picture's size.
    pub fn look_orthographic(&mut self, view: &OrthographicView) {
        self.flags |= FLAG_ORTHOGRAPHIC;
        self.place_camera(&view.pose);
        self.focal = view.pixels_per_metre.map(|f| f as f32);
        self.principal_point = [0.5 * view.width as f32, 0.5 * view.height as f32];
        (self.min_ratio, self.max_ratio) = ([0.0; 2], [0.0; 2]);
        self.size = [view.width, view.height];
        self.show(Window::whole(view.width, view.height));
    }

    fn place_camera(&mut self, pose: &Pose) {
        let rotation = glam::DMat3::from_quat(pose.rotation.normalize()).transpose();
        let translation = -(rotation * pose.center);
        for (i, row) in self.view_rows.iter_mut().enumerate() {
            let r = rotation.row(i);
            *row = [r.x as f32, r.y as f32, r.z as f32, translation[i] as f32];
        }
        self.camera_center = pose.center.as_vec3().to_array();
        self.near = NEAR;
    }

    /// Renders only `window`.
    pub fn show(&mut self, window: Window) {
        let origin = [window.column * TILE_WIDTH, window.row * TILE_HEIGHT];
        let [width, height] = [window.columns * TILE_WIDTH, window.rows * TILE_HEIGHT];
        self.window = [window.columns, window.rows];
        self.region_origin = origin;
        self.region = [width.min(self.size[0] - origin[0]), height.min(self.size[1] - origin[1])];
    }

    /// Places in the order in which the tiles of `band` are blended: whole blocks of the whole window, or tiles in rows
    /// (`shaders/tile.glsl`).
    pub fn places(&self, band: Band) -> usize {
        let [across, down] = [0, 1].map(|k| self.window[k].next_multiple_of(BLOCK[k]));
        let whole = band.first == 0 && band.last == self.tiles();
        if whole { (across * down) as usize } else { (band.last - band.first) as usize }
    }

    /// Tiles of the window.
    pub fn tiles(&self) -> u32 {
        self.window[0] * self.window[1]
    }

    /// Pixels of the picture.
    pub fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    pub fn has(&self, flag: u32) -> bool {
        self.flags & flag != 0
    }

    /// Back to no loss, no regulariser, black background: what an evaluation renders with.
    pub fn plain(&mut self) {
        (self.background, self.drop_share) = ([0.0; 3], 0.0);
        self.flags = 0;
        (self.exposure_gain, self.exposure_offset) = ([1.0; 3], [0.0; 3]);
    }
}

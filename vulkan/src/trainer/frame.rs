//! The uniform block of a step, field by field what `shaders/frame.glsl` declares, and how a camera fills it.

use crate::constants::{FRUSTUM_MARGIN, NEAR, TILE_HEIGHT, TILE_WIDTH};
use config::training::SkipSettings;
use models::camera::View;

/// Steps in the table of deferred moments; no Gaussian is left behind for longer.
pub(crate) const DEFERRED_STEPS: usize = 512;

/// Bits of `counts[2]`.
pub(crate) const FLAG_FREEZE_SHAPE: u32 = 1;
pub(crate) const FLAG_DEPTH: u32 = 4;
const FLAG_KEEP_OUTSIDE: u32 = 8;
const FLAG_KEEP_FAINT: u32 = 16;
const FLAG_WHOLE_BOXES: u32 = 32;
const FLAG_NO_EARLY_END: u32 = 64;

/// The flags of the skips that are switched off.
pub(crate) fn flags_of(skips: &SkipSettings) -> u32 {
    let off = |on: bool, flag: u32| if on { 0 } else { flag };
    off(skips.frustum, FLAG_KEEP_OUTSIDE)
        | off(skips.opacity, FLAG_KEEP_FAINT)
        | off(skips.exact_tiles, FLAG_WHOLE_BOXES)
        | off(skips.early_end, FLAG_NO_EARLY_END)
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Frame {
    /// First on purpose: see `frame.glsl`.
    pub adam: [f32; 4],
    pub view_row: [[f32; 4]; 3],
    pub lens: [f32; 4],
    pub camera: [f32; 4],
    pub clamp_ratio: [f32; 4],
    pub size: [u32; 4],
    pub window: [u32; 4],
    pub region: [u32; 4],
    pub counts: [u32; 4],
    pub background: [f32; 4],
    pub exposure_gain: [f32; 4],
    pub exposure_offset: [f32; 4],
    pub rates: [f32; 4],
    pub rates_more: [f32; 4],
    pub bias: [f32; 4],
    pub step: [u32; 4],
    pub loss: [f32; 4],
    pub source: [u32; 4],
    pub deferred: [[f32; 4]; DEFERRED_STEPS],
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
}

impl Frame {
    /// Sets camera and picture size.
    pub fn look(&mut self, view: &View) {
        let lens = view.intrinsics;
        let rotation = glam::DMat3::from_quat(view.pose.rotation.normalize()).transpose();
        let translation = -(rotation * view.pose.center);
        for (i, row) in self.view_row.iter_mut().enumerate() {
            let r = rotation.row(i);
            *row = [r.x as f32, r.y as f32, r.z as f32, translation[i] as f32];
        }
        let centre = view.pose.center.as_vec3();
        self.lens = [lens.fx, lens.fy, lens.cx, lens.cy];
        self.camera = [centre.x, centre.y, centre.z, NEAR];
        let (width, height) = (lens.width as f32, lens.height as f32);
        let margin_x = FRUSTUM_MARGIN * 0.5 * width / lens.fx;
        let margin_y = FRUSTUM_MARGIN * 0.5 * height / lens.fy;
        self.clamp_ratio = [
            -lens.cx / lens.fx - margin_x,
            (width - lens.cx) / lens.fx + margin_x,
            -lens.cy / lens.fy - margin_y,
            (height - lens.cy) / lens.fy + margin_y,
        ];
        self.size = [lens.width, lens.height, lens.width.div_ceil(TILE_WIDTH), lens.height.div_ceil(TILE_HEIGHT)];
        self.show(Window::whole(lens.width, lens.height));
    }

    /// Renders only `window`.
    pub fn show(&mut self, window: Window) {
        self.window = [window.column, window.row, window.columns, window.rows];
        let (x, y) = (window.column * TILE_WIDTH, window.row * TILE_HEIGHT);
        let width = (window.columns * TILE_WIDTH).min(self.size[0] - x);
        let height = (window.rows * TILE_HEIGHT).min(self.size[1] - y);
        self.region = [x, y, width, height];
    }

    pub fn tiles(&self) -> u32 {
        self.window[2] * self.window[3]
    }

    /// Back to no loss, no regulariser, black background: what an evaluation renders with.
    pub fn plain(&mut self) {
        self.background = [0.0; 4];
        self.counts[2] = 0;
        self.exposure_gain = [1.0; 4];
        self.exposure_offset = [0.0; 4];
    }
}

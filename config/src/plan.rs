//! The fixed memory plan of the device: one number of MiB in, every capacity and every byte out.
//!
//! This file is the only place that knows how large a section is; the arena allocates exactly these sections, so what
//! `dgtr plan` prints is what the device holds, to the byte.

use serde::Serialize;

mod lanes;
mod mirror;
mod request;
mod scene;

pub use lanes::Lanes;
pub use request::PlanRequest;
pub use scene::BLOCK_GAUSSIANS;

/// Bytes of the status section: 4 KiB of counters, and a cursor of 16 bytes for each sorting lane there may be.
pub const STATUS_BYTES: u64 = (4 << 10) + 16 * Lanes::CARD.sort as u64;
/// Bytes of the partial sum that each lane of a loop leaves.
pub const LANE_SUM_BYTES: u64 = 32;
/// Every binding stays below this (lavapipe's and older V3DV's `maxStorageBufferRange`).
pub const BINDING_LIMIT: u64 = 128 << 20;
/// Sections start at multiples of this, the largest `minStorageBufferOffsetAlignment` Vulkan allows.
pub const SECTION_ALIGNMENT: u64 = 256;
/// The whole is a multiple of this.
pub const TOTAL_ALIGNMENT: u64 = 64 << 10;
/// What a driver may want beyond the bytes of the one buffer (V3DV: 256 more for storage and uniform buffers; others round up).
pub const DRIVER_ROOM: u64 = 64 << 10;
/// Longer side of pictures where nobody says another, pixels: what the networks see, and what is measured here.
pub const WORKING_SIDE: u32 = 640;
/// Width of a tile, pixels.
pub const TILE_WIDTH: u64 = 8;
/// Height of a tile, pixels.
pub const TILE_HEIGHT: u64 = 4;

/// Capacities and the size of every section.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Plan {
    /// N, Gaussians on the device.
    pub gaussians: usize,
    /// Gaussians of the whole scene; those beyond N wait in a file.
    pub scene: usize,
    /// M, Gaussian–tile instances held at once; more are rendered in several bands.
    pub instances: usize,
    /// P, pixels rendered at once; larger renderings are done in several windows.
    pub pixels: usize,
    /// Tiles rendered at once.
    pub tiles: usize,
    /// Training views.
    pub views: usize,
    /// Crops of larger pictures.
    pub crops: usize,
    /// Views and crops on the device at once; the others wait in a file.
    pub view_slots: usize,
    /// Highest SH degree.
    pub sh_degree: u8,
    /// Adam's moments of SH take 16 bits each instead of 32.
    pub half_moments: bool,
    /// Lanes that share the work.
    pub lanes: Lanes,
    /// Name and bytes of every section, in the order in which they lie in memory.
    pub sections: Vec<(&'static str, u64)>,
    /// Bytes of the one device allocation.
    pub total_bytes: u64,
}

/// Why no plan could be made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// Pictures and views alone exceed the budget.
    #[error(
        "memory plan: {device_mib} MiB of device memory are too few for {views} views of {width}x{height} at once; \
         at least {needed_mib} MiB are needed (raise memory.device_mib, or use fewer or smaller views)"
    )]
    TooSmall {
        /// What was allowed.
        device_mib: u32,
        /// Views on the device at once.
        views: u32,
        /// Picture width.
        width: u32,
        /// Picture height.
        height: u32,
        /// What the smallest plan takes.
        needed_mib: u64,
    },
    /// A number that makes no sense.
    #[error("memory plan: {what} = {value} is outside {low}…{high}")]
    OutOfRange {
        /// Which number.
        what: &'static str,
        /// Its value.
        value: u64,
        /// Least allowed.
        low: u64,
        /// Greatest allowed.
        high: u64,
    },
}

/// vec4 columns that one Gaussian's SH coefficients fill.
pub const fn sh_columns(degree: u8) -> u64 {
    let d = (degree as u64 + 1) * (degree as u64 + 1);
    (3 * d).div_ceil(4)
}

/// Bytes of one resident view: RGBA8 (alpha is the depth prior's confidence) and a 16-bit depth prior, aligned so that
/// every view can be bound on its own.
pub const fn view_bytes(pixels: u64) -> u64 {
    (4 * pixels + 4 * pixels.div_ceil(2)).next_multiple_of(SECTION_ALIGNMENT)
}

/// Bytes of one crop in the file of views: RGBA8.
pub const fn crop_bytes(pixels: u64) -> u64 {
    (4 * pixels).next_multiple_of(SECTION_ALIGNMENT)
}

fn within(what: &'static str, value: u64, low: u64, high: u64) -> Result<(), PlanError> {
    if (low..=high).contains(&value) { Ok(()) } else { Err(PlanError::OutOfRange { what, value, low, high }) }
}

impl Plan {
    /// The least number of Gaussians a plan is worth making for.
    pub const LEAST_GAUSSIANS: usize = 256;

    /// As many Gaussians and instances as the budget holds.
    ///
    /// # Errors
    /// [`PlanError::TooSmall`] with the MiB that would do; [`PlanError::OutOfRange`].
    pub fn new(request: &PlanRequest) -> Result<Self, PlanError> {
        let r = request;
        within("width", r.width.into(), 1, 1 << 15)?;
        within("height", r.height.into(), 1, 1 << 15)?;
        within("pixels", u64::from(r.width) * u64::from(r.height), 1, BINDING_LIMIT / 48)?;
        within("views", r.views.into(), 0, 1 << 20)?;
        within("crops", r.crops.into(), 0, 1 << 20)?;
        within("sh_degree", r.sh_degree.into(), 0, 3)?;
        let (least, most) = (Lanes::SOFTWARE, Lanes::CARD);
        within("lanes.sort", r.lanes.sort.into(), least.sort.into(), most.sort.into())?;
        within("lanes.loops", r.lanes.loops.into(), least.loops.into(), most.loops.into())?;
        let most_gaussians = u64::from(u32::MAX) >> 4;
        within("max_gaussians", r.max_gaussians.unwrap_or(Self::LEAST_GAUSSIANS) as u64, 1, most_gaussians)?;
        within("scene_gaussians", r.scene_gaussians.unwrap_or(1) as u64, 1, most_gaussians)?;
        let (budget, slots, most) = (u64::from(r.device_mib) << 20, r.slots(), r.most_gaussians());
        let least = most.min(Self::LEAST_GAUSSIANS);
        let pixels = r.width as usize * r.height as usize;
        // A picture of ordinary content needs about 2 instances per pixel in tiles of 8 × 4, twice that at first (measured on fox).
        let made = |n: usize, per_pixel: usize| Self::laid_out(r, slots, n, n + per_pixel * pixels);
        let smallest = Self::smallest(r, slots);
        if smallest.total_bytes > budget {
            return Err(PlanError::TooSmall {
                device_mib: r.device_mib,
                views: slots,
                width: r.width,
                height: r.height,
                needed_mib: smallest.total_bytes.div_ceil(1 << 20),
            });
        }
        let (mut low, mut high) = (least, most);
        while low < high {
            let middle = low + (high - low).div_ceil(2);
            if made(middle, 4).total_bytes <= budget { low = middle } else { high = middle - 1 }
        }
        let fits = |per_pixel: &usize| made(low, *per_pixel).total_bytes <= budget;
        // What is left goes to instances, so that few frames need bands.
        let per_pixel = [6, 4, 3].into_iter().find(fits).unwrap_or(2);
        Ok(made(low, per_pixel))
    }

    /// A plan with given capacities instead of a budget (tests, benchmarks). `instances` is raised to `gaussians`, so
    /// that one tile always fits. All views are on the device where the request does not say how many.
    pub fn with_capacities(request: &PlanRequest, gaussians: usize, instances: usize) -> Self {
        let slots = if request.view_slots.is_some() { request.slots() } else { request.views + request.crops };
        Self::laid_out(request, slots, gaussians.max(1), instances)
    }

    /// The least that is worth making with so many views on the device.
    fn smallest(r: &PlanRequest, slots: u32) -> Self {
        let n = r.most_gaussians().min(Self::LEAST_GAUSSIANS);
        Self::laid_out(r, slots, n, n + 2 * r.width as usize * r.height as usize)
    }

    fn laid_out(r: &PlanRequest, slots: u32, gaussians: usize, instances: usize) -> Self {
        let most_instances = (BINDING_LIMIT / 48) as usize;
        let instances = instances.clamp(gaussians.min(most_instances), most_instances);
        let (n, m) = (gaussians as u64, instances as u64);
        let p = r.padded_pixels();
        let (width, height) = (u64::from(r.width), u64::from(r.height));
        // As do pictures in portrait or cropped ones.
        let tiles = width.div_ceil(TILE_WIDTH) * height.div_ceil(TILE_HEIGHT) + (width + height) / TILE_HEIGHT + 64;
        let sh = 16 * sh_columns(r.sh_degree) * n;
        let lanes = u64::from(r.lanes.sort);
        let moment = if r.half_moments { sh / 2 } else { sh };
        let sections: Vec<(&'static str, u64)> = [
            ("frame", 16 << 10),      // uniforms and the table of deferred moments
            ("status", STATUS_BYTES), // counters read back after every step, cursors of the sorting lanes
            ("lane_sums", LANE_SUM_BYTES * u64::from(r.lanes.loops)),
            ("strip_sums", 32 * (p.div_ceil(8) + u64::from(r.width) + u64::from(r.height) + 64)),
            ("geometry", 144 * n), // mean+opacity, log scale+state, rotation; each with two Adam moments
            ("sh", sh),
            ("sh_first_moment", moment),
            ("sh_second_moment", moment),
            ("projected", 48 * n), // centre, conic, span data
            ("shaded", 48 * n),    // the visible ones in depth order, with colour
            ("keys", 4 * n),       // depths of all, and of the visible ones while sorting
            ("order", 4 * n),      // the visible ones in depth order
            ("keys_other", 4 * n),
            ("order_other", 4 * n),
            ("digits", 4 * 256 * lanes), // per sorting lane: digits of the sort's present pass
            ("reduced", 48 * n),         // summed gradient slots
            ("slot_ranges", 8 * n),      // first slot and number of slots
            ("tiles", 4 * tiles * lanes), // per sorting lane and tile: instances
            ("tile_starts", 8 * tiles + 16), // first instance; Gaussians blended (work counter)
            ("instances", 8 * m),        // Gaussian and slot
            ("slots", (48 * m).max(96 * p)), // gradient slots; SSIM's intermediate maps before those are needed
            ("image", 16 * p),           // RGB, depth
            ("transmittance", 4 * p),
            ("image_gradient", 16 * p),
            ("target", 8 * p), // the step's picture (RGBA8) and depth prior at working size
            ("views", view_bytes(p) * u64::from(slots)),
            ("driver_room", DRIVER_ROOM), // behind the buffer, for what the driver adds to it
        ]
        .into_iter()
        .map(|(name, bytes): (&'static str, u64)| (name, bytes.max(16).next_multiple_of(SECTION_ALIGNMENT)))
        .collect();
        let total: u64 = sections.iter().map(|s| s.1).sum();
        Self {
            gaussians,
            scene: r.scene_gaussians.unwrap_or(gaussians).max(gaussians),
            instances,
            pixels: p as usize,
            tiles: tiles as usize,
            views: r.views as usize,
            crops: r.crops as usize,
            view_slots: slots as usize,
            sh_degree: r.sh_degree,
            half_moments: r.half_moments,
            lanes: r.lanes,
            sections,
            total_bytes: total.next_multiple_of(TOTAL_ALIGNMENT),
        }
    }

    /// Bytes of the one buffer: all but the room that is left for the driver.
    pub fn buffer_bytes(&self) -> u64 {
        self.total_bytes - DRIVER_ROOM
    }

    /// What moments in 16 bits are multiplied by: gradients of a mean over the pixels of three channels come to the size of
    /// one pixel's. A power of two, so that nothing is rounded.
    pub fn moment_scale(&self) -> f32 {
        (3 * self.pixels as u64).next_power_of_two() as f32
    }

    /// Bytes of the section `name`; 0 when there is none.
    pub fn bytes(&self, name: &str) -> u64 {
        self.sections.iter().find(|s| s.0 == name).map_or(0, |s| s.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(device_mib: u32) -> PlanRequest {
        PlanRequest { device_mib, views: 50, ..Default::default() }
    }

    #[test]
    fn a_larger_budget_never_holds_fewer_gaussians_and_is_never_exceeded() {
        let mut last = 0;
        for mib in [200, 256, 384, 512, 1024, 4096] {
            let p = Plan::new(&request(mib)).unwrap();
            assert!(p.total_bytes <= u64::from(mib) << 20);
            assert!(p.gaussians >= last, "{mib}: {} < {last}", p.gaussians);
            assert!(p.instances >= p.gaussians);
            last = p.gaussians;
        }
    }

    #[test]
    fn plans_of_a_processor_a_board_and_a_card_differ_by_what_their_lanes_leave_alone() {
        let [few, board, card] = [Lanes::SOFTWARE, Lanes::BOARD, Lanes::CARD]
            .map(|lanes| Plan::with_capacities(&PlanRequest { lanes, ..request(512) }, 1000, 10_000));
        for ((a, b), c) in few.sections.iter().zip(&board.sections).zip(&card.sections) {
            assert_eq!(a.1 == b.1, !["digits", "tiles"].contains(&a.0), "{}", a.0);
            assert_eq!(b.1 == c.1, b.0 != "lane_sums", "{}", b.0);
        }
        for lanes in [Lanes { sort: 512, ..Lanes::BOARD }, Lanes { loops: 1 << 20, ..Lanes::BOARD }] {
            assert!(Plan::new(&PlanRequest { lanes, ..request(512) }).is_err());
        }
    }

    #[test]
    fn the_total_is_the_sum_of_the_sections_rounded_once() {
        let p = Plan::new(&request(512)).unwrap();
        let sum: u64 = p.sections.iter().map(|s| s.1).sum();
        assert_eq!(p.total_bytes, sum.next_multiple_of(TOTAL_ALIGNMENT));
        for (name, bytes) in &p.sections {
            assert!(*name == "views" || *bytes <= BINDING_LIMIT + (1 << 20), "{name}: {bytes}");
        }
    }

    #[test]
    fn every_section_lies_in_the_buffer_and_the_room_for_the_driver_behind_it() {
        for mib in [200, 333, 1024] {
            let p = Plan::new(&request(mib)).unwrap();
            let (last, bytes) = p.sections[p.sections.len() - 1];
            assert_eq!((last, bytes), ("driver_room", DRIVER_ROOM));
            let held: u64 = p.sections.iter().map(|s| s.1).sum::<u64>() - bytes;
            assert!(held <= p.buffer_bytes() && p.buffer_bytes() + DRIVER_ROOM == p.total_bytes);
        }
    }

    #[test]
    fn too_small_a_budget_says_how_much_would_do() {
        let error = Plan::new(&request(16)).unwrap_err();
        let PlanError::TooSmall { needed_mib, .. } = error else { panic!("{error}") };
        assert!(Plan::new(&request(needed_mib as u32)).is_ok());
        assert!(Plan::new(&request(needed_mib as u32 - 1)).is_err());
    }

    #[test]
    fn sizes_out_of_range_are_refused() {
        assert!(Plan::new(&PlanRequest { width: 0, ..request(512) }).is_err());
        assert!(Plan::new(&PlanRequest { sh_degree: 4, ..request(512) }).is_err());
        assert!(Plan::new(&PlanRequest { width: 1 << 15, height: 1 << 15, ..request(512) }).is_err());
    }
}

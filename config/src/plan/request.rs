//! What a job asks of the device, and which of its views find room there.

use super::{BINDING_LIMIT, Lanes, Plan, crop_bytes, sh_columns, view_bytes};

/// Views on the device at the least: the step's own, and the one that comes in.
const LEAST_SLOTS: u32 = 2;

/// What the job will ask of the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlanRequest {
    /// Device memory that may be used, MiB.
    pub device_mib: u32,
    /// Width of the largest training picture, pixels.
    pub width: u32,
    /// Height of the largest training picture, pixels.
    pub height: u32,
    /// Training views.
    pub views: u32,
    /// Crops of the pictures at a larger size than they are trained at, each of a training picture's pixels at most.
    pub crops: u32,
    /// How many views and crops are on the device at once, the others waiting in a file; `None`: all views and one crop where they take
    /// at most half of the memory, else as many as an eighth of it holds, and never more than leave room for a plan.
    pub view_slots: Option<u32>,
    /// Highest SH degree, 0…3.
    pub sh_degree: u8,
    /// Upper bound on Gaussians; `None` takes what the memory allows.
    pub max_gaussians: Option<usize>,
    /// Gaussians of the whole scene, in cells of ground of which those that the views at work see are on the device and the others
    /// wait in a file; `None`: all Gaussians are on the device.
    pub scene_gaussians: Option<usize>,
    /// Adam's moments of SH in 16 bits each.
    pub half_moments: bool,
    /// Lanes that share the work: the device's.
    pub lanes: Lanes,
}

impl Default for PlanRequest {
    /// A first guess for `dgtr plan`: 64 pictures of 640 × 480 in 512 MiB, on a processor.
    fn default() -> Self {
        Self {
            device_mib: 512,
            width: 640,
            height: 480,
            views: 64,
            crops: 0,
            view_slots: None,
            sh_degree: 3,
            max_gaussians: None,
            scene_gaussians: None,
            half_moments: false,
            lanes: Lanes::SOFTWARE,
        }
    }
}

impl PlanRequest {
    /// Pixels of a picture, padded: pictures of the same area in another shape need a few more tiles.
    pub(super) fn padded_pixels(&self) -> u64 {
        (u64::from(self.width) * u64::from(self.height)).next_multiple_of(64)
    }

    /// Views and crops, all of which are pictures of a step.
    fn pictures(&self) -> u32 {
        self.views.saturating_add(self.crops)
    }

    /// Views and crops on the device at once.
    pub fn slots(&self) -> u32 {
        let budget = u64::from(self.device_mib) << 20;
        let held_in = |bytes: u64| u32::try_from(bytes / view_bytes(self.padded_pixels())).unwrap_or(u32::MAX);
        let slots = match self.view_slots {
            Some(slots) => slots,
            None => {
                // A crop is read for its step: kept here, crops would take the room of Gaussians.
                let wanted = self.views.saturating_add(self.crops.min(1));
                let few = if held_in(budget / 2) >= wanted { wanted } else { held_in(budget / 8) };
                few.min(held_in(budget.saturating_sub(Plan::smallest(self, 0).total_bytes)))
            }
        };
        slots.max(LEAST_SLOTS).min(self.pictures())
    }

    /// Gaussians that bindings and request allow.
    pub(super) fn most_gaussians(&self) -> usize {
        // Widest column set in one binding: three vec4 of Adam state per geometry column, or all SH columns.
        let widest = 144.max(16 * sh_columns(self.sh_degree));
        let most = (BINDING_LIMIT / widest) as usize;
        self.max_gaussians.unwrap_or(most).min(most)
    }

    /// Bytes of the file of the cells that are not on the device; 0 when all are, or no plan can be made.
    pub fn scene_file_bytes(&self) -> u64 {
        Plan::new(self).map_or(0, |plan| plan.scene_file_bytes())
    }

    /// Bytes of the file that holds views and crops when not all of them are on the device; 0 when all are.
    pub fn view_file_bytes(&self) -> u64 {
        let pixels = self.padded_pixels();
        let all = u64::from(self.views) * view_bytes(pixels) + u64::from(self.crops) * crop_bytes(pixels);
        if self.slots() < self.pictures() { all } else { 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_stay_on_the_device_while_they_leave_half_of_it_and_wait_in_a_file_otherwise() {
        let of = |views: u32, width: u32, height: u32| PlanRequest { views, width, height, ..PlanRequest::default() };
        let few = of(50, 640, 480);
        assert_eq!((few.slots(), few.view_file_bytes()), (50, 0));
        let many = of(1000, 1280, 960);
        assert_eq!((many.slots(), many.view_file_bytes()), (9, 1000 * 6 * 1280 * 960));
        let plan = Plan::new(&many).unwrap();
        assert!(plan.total_bytes <= 512 << 20 && plan.gaussians > 100_000, "{} Gaussians", plan.gaussians);
        assert_eq!((plan.views, plan.view_slots, plan.bytes("views")), (1000, 9, 9 * 6 * 1280 * 960));
        assert_eq!(PlanRequest { view_slots: Some(0), ..many }.slots(), 2, "one in use, one coming in");
        assert_eq!(PlanRequest { view_slots: Some(2000), ..many }.slots(), 1000);
        assert_eq!(of(0, 640, 480).slots(), 0);
        // Crops wait as views do, without room for a depth prior.
        let cropped = PlanRequest { crops: 300, ..few };
        assert_eq!((cropped.slots(), cropped.view_file_bytes()), (51, 640 * 480 * (50 * 6 + 300 * 4)));
        assert_eq!(PlanRequest { crops: 3, ..few }.slots(), 51, "crops take no room of Gaussians");
        // Where pictures are large for the memory, fewer of them stay rather than that no plan can be made.
        let tight = PlanRequest { device_mib: 210, ..of(50, 1280, 960) };
        assert!(tight.slots() == 2 && Plan::new(&tight).is_ok(), "{}", tight.slots());
    }
}

//! Where the pixels of a view or a crop are: in a slot of the arena, or in a file until a step wants them.
//!
//! What a step computes does not depend on how many slots there are: a picture comes back as it was written, byte for byte. The
//! order of pictures follows from the seed, so that the next one is known while a step runs, and the system reads it ahead.

use super::{Picture, PictureStore};
use crate::device::Device;
use crate::error::TrainError;
use crate::layout::Section;
use config::plan::{Plan, crop_bytes, view_bytes};
use rustix::fs::{Advice, fadvise};
use std::fs::File;
use std::num::NonZeroU64;
use std::os::unix::fs::FileExt;

/// The slots and the file behind them.
pub(super) struct Slots {
    held: Vec<Held>,
    /// Uses of any slot so far.
    uses: u64,
    file: Option<File>,
    /// Views planned, which lie in the file before the crops.
    views: u64,
    /// Pixels of a picture in the file.
    pixels: u64,
    /// Views and crops read back since they were added.
    pub read_back: u64,
}

#[derive(Clone, Copy, Default)]
struct Held {
    picture: Option<Picture>,
    last_use: u64,
}

impl Slots {
    pub fn new(plan: &Plan) -> Self {
        let held = vec![Held::default(); plan.view_slots];
        Self { held, uses: 0, file: None, views: plan.views as u64, pixels: plan.pixels as u64, read_back: 0 }
    }

    /// The slot of `picture`, and whether its pixels are there; where they are not, the slot unused for longest is now its.
    pub fn claim(&mut self, picture: Picture) -> (usize, bool) {
        self.uses += 1;
        let there = self.held.iter().position(|held| held.picture == Some(picture));
        let oldest = || (0..self.held.len()).min_by_key(|&slot| self.held[slot].last_use).unwrap_or(0);
        let slot = there.unwrap_or_else(oldest);
        self.held[slot] = Held { picture: Some(picture), last_use: self.uses };
        (slot, there.is_some())
    }

    /// Where a picture lies in the file, and how many bytes it takes there at most.
    fn record(&self, picture: Picture) -> (u64, u64) {
        let (view, crop) = (view_bytes(self.pixels), crop_bytes(self.pixels));
        match picture {
            Picture::View(index) => (index as u64 * view, view),
            Picture::Crop(index) => (self.views * view + index as u64 * crop, crop),
        }
    }

    /// Nothing is in `slot` that could be used.
    fn vacate(&mut self, slot: usize) {
        self.held[slot] = Held::default();
    }

    fn file(&self) -> Result<&File, TrainError> {
        self.file.as_ref().ok_or_else(|| TrainError::ViewFile("none was given; call PictureStore::keep_in".into()))
    }
}

fn failed(picture: Picture, e: std::io::Error) -> TrainError {
    TrainError::ViewFile(format!("{picture}: {e}; see whether its disk fails"))
}

impl PictureStore {
    /// Keeps the views and crops that find no slot on the device in `file`, empty and with room for
    /// [`config::plan::PlanRequest::view_file_bytes`]. Call it before the first view where the plan holds fewer slots than those.
    pub fn keep_in(&mut self, file: File) {
        self.slots.file = Some(file);
    }

    /// Views and crops read back from the file so far.
    pub fn read_back(&self) -> u64 {
        self.slots.read_back
    }

    /// The slot of a picture, read back from the file when it is not on the device. The device must be idle.
    pub(crate) fn resident(&mut self, device: &mut Device, picture: Picture) -> Result<usize, TrainError> {
        let (slot, there) = self.slots.claim(picture);
        if !there {
            let _phase = tracing::trace_span!("read view", %picture).entered();
            let section = self.pixels_in(device, slot, picture);
            let (at, _) = self.slots.record(picture);
            let bytes = device.arena.slice_mut::<u8>(section);
            let read = self.slots.file().and_then(|f| f.read_exact_at(bytes, at).map_err(|e| failed(picture, e)));
            if let Err(e) = read {
                self.slots.vacate(slot);
                return Err(e);
            }
            self.slots.read_back += 1;
        }
        Ok(slot)
    }

    /// Writes a picture's slot to the file, where there is not a slot for every picture.
    pub(super) fn keep(&mut self, device: &Device, slot: usize, picture: Picture) -> Result<(), TrainError> {
        if self.plan.view_slots >= self.plan.views + self.plan.crops {
            return Ok(());
        }
        let (at, _) = self.slots.record(picture);
        let bytes = device.arena.slice::<u8>(self.pixels_in(device, slot, picture));
        let kept = self.slots.file().and_then(|f| f.write_all_at(bytes, at).map_err(|e| failed(picture, e)));
        kept.inspect_err(|_| self.slots.vacate(slot))
    }

    /// Has the system read the picture that comes next.
    pub(crate) fn read_ahead(&self, next: Option<Picture>) {
        let slots = &self.slots;
        if let (Some(file), Some(next)) = (&slots.file, next)
            && !slots.held.iter().any(|held| held.picture == Some(next))
        {
            let (at, bytes) = slots.record(next);
            // Advice that is not taken costs time, nothing else.
            _ = fadvise(file, at, NonZeroU64::new(bytes), Advice::WillNeed);
        }
    }

    /// What a picture takes of its slot.
    pub(super) fn pixels_in(&self, device: &Device, slot: usize, picture: Picture) -> Section {
        let of = |width: u32, height: u32| u64::from(width) * u64::from(height);
        let bytes = match picture {
            Picture::View(index) => view_bytes(of(self.views[index].width, self.views[index].height)),
            Picture::Crop(index) => crop_bytes(of(self.crops[index].width, self.crops[index].height)),
        };
        Section { bytes, ..device.arena.view_slot(&self.plan, slot) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_view_unused_for_longest_gives_way() {
        let mut slots =
            Slots { held: vec![Held::default(); 2], uses: 0, file: None, views: 9, pixels: 64, read_back: 0 };
        let (view, crop) = (Picture::View, Picture::Crop);
        assert_eq!(
            [view(0), view(1), view(0), crop(1), view(0), view(1)].map(|picture| slots.claim(picture)),
            [(0, false), (1, false), (0, true), (1, false), (0, true), (1, false)]
        );
        assert_eq!(
            [view(0), view(8), crop(0), crop(1)].map(|p| slots.record(p)),
            [(0, 512), (8 * 512, 512), (9 * 512, 256), (9 * 512 + 256, 256)]
        );
        slots.vacate(0);
        assert_eq!(
            (slots.claim(view(3)), slots.claim(view(1))),
            ((0, false), (1, true)),
            "what was vacated goes first"
        );
    }
}

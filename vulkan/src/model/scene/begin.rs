//! Where a window of cells begins: a part of a picture, as large as finds room, where little has to be moved for it.

use rand::Rng;

use super::Cell;
use super::cell::{Blocks, Frustum, SIDE};
use super::parts::grown_around;
use super::window::{BLOCKS, Choice, NEVER, Window};
use crate::error::TrainError;
use crate::pictures::Picture;

/// Places at which a window may begin: the one is taken of which the most is on the device.
const PLACES: usize = 32;

impl Window {
    /// The view, of those visited least, or while views come of the newest, that a window begins with, and which part of it, in which at
    /// most `first` Gaussians show, or, where a block alone shows more, as many as a window may hold.
    pub(super) fn begin_with_view(
        &mut self,
        cells: &[Cell],
        by: &mut Choice<'_>,
        first: usize,
    ) -> Result<(Picture, Blocks), TrainError> {
        let (views, mut fewest) = (by.pictures.len(), usize::MAX);
        loop {
            let mut best: Option<(f32, usize, (u8, u8))> = None;
            let newest = by.sampler.next_newest(views).map(|view| view..view + 1);
            let places = newest.and_then(|view| self.least_visited::<PLACES>(view, by.sampler.rng()));
            let places = places.or_else(|| self.least_visited(0..views, by.sampler.rng()));
            for (view, block) in places.into_iter().flatten() {
                let here = share_at_work(cells, &by.frustum_of(Picture::View(view)), block);
                if best.is_none_or(|(most, ..)| here > most) {
                    best = Some((here, view, block));
                }
            }
            let Some((_, view, block)) = best else {
                let least = TrainError::TooCrowded { needed: fewest, gaussians: by.capacity };
                return Err(if fewest == usize::MAX { TrainError::NothingInView } else { least });
            };
            let (picture, frustum) = (Picture::View(view), by.frustum_of(Picture::View(view)));
            match self
                .part_around(cells, &frustum, block, first)
                .or_else(|_| self.part_around(cells, &frustum, block, by.capacity))
            {
                Ok((part, needed)) if needed > 0 => return Ok((picture, part)),
                Ok(_) => {}
                Err(needed) => fewest = fewest.min(needed),
            }
            let (x, y) = block;
            self.visits[view * BLOCKS + usize::from(y) * usize::from(SIDE) + usize::from(x)] = NEVER;
        }
    }

    /// A crop that a window begins with, and which part of it; `None` when there is none, or none that shows what finds room.
    pub(super) fn begin_with_crop(
        &mut self,
        cells: &[Cell],
        by: &mut Choice<'_>,
        room: usize,
    ) -> Option<(Picture, Blocks)> {
        let (crops, mut best) = (by.pictures.crops(), None::<(f32, usize, (u8, u8))>);
        for _ in 0..if crops == 0 { 0 } else { PLACES } {
            let rng = by.sampler.rng();
            let (crop, block) = (rng.random_range(0..crops), (rng.random_range(0..SIDE), rng.random_range(0..SIDE)));
            let here = share_at_work(cells, &by.frustum_of(Picture::Crop(crop)), block);
            if best.is_none_or(|(most, ..)| here > most) {
                best = Some((here, crop, block));
            }
        }
        let (_, crop, block) = best?;
        let (part, needed) = self.part_around(cells, &by.frustum_of(Picture::Crop(crop)), block, room).ok()?;
        (needed > 0).then_some((Picture::Crop(crop), part))
    }

    /// The part around a block of a picture in which at most `room` Gaussians show, and how many do.
    fn part_around(
        &mut self,
        cells: &[Cell],
        frustum: &Frustum,
        block: (u8, u8),
        room: usize,
    ) -> Result<(Blocks, usize), usize> {
        let shown = &mut self.shown;
        shown.clear();
        for (i, cell) in cells.iter().enumerate().filter(|(_, cell)| cell.count > 0) {
            shown.extend(frustum.blocks(&cell.bounds).map(|blocks| (i as u32, blocks.mask())));
        }
        grown_around(block, room, |part| {
            let mask = part.mask();
            shown.iter().filter(|(_, shown)| shown & mask != 0).map(|(i, _)| cells[*i as usize].count).sum()
        })
    }
}

/// How much of what may show in a block of a picture is on the device, 0…1.
fn share_at_work(cells: &[Cell], frustum: &Frustum, (x, y): (u8, u8)) -> f32 {
    let block = Blocks { x: [x, x + 1], y: [y, y + 1] };
    let (mut all, mut here) = (0, 0);
    for cell in cells.iter().filter(|cell| cell.count > 0 && frustum.shows_in(block, &cell.bounds)) {
        all += cell.count;
        here += if cell.at_work { cell.count } else { 0 };
    }
    here as f32 / all.max(1) as f32
}

//! Which cells are on the device, for how long, and which parts of which pictures are trained meanwhile.
//!
//! A window begins with the block of a picture that was looked at least and takes the cells which a part around it sees, and the
//! nearest for as long as there is room: the same ground, seen from many places. What is trained is that part, and of every
//! picture the largest rectangle that sees no cell which is away meanwhile.

use config::plan::Plan;
use config::training::Strategy;
use glam::Vec2;
use rand::Rng;

use super::cell::{Blocks, SIDE, Sight};
use super::parts::{largest_rectangle, parts_around};
use super::{Cell, Scene};
use crate::trainer::slots::Picture;
use crate::trainer::{TrainError, Trainer};

/// Blocks of a picture.
const BLOCKS: usize = SIDE as usize * SIDE as usize;
/// A sixteenth of a picture is worth a step; what the window began with always is.
const LEAST_BLOCKS: u32 = 4;
/// The chance of a block that was looked at least.
const LEAST_SEEN: u64 = 1 << 20;
/// How much the chance of a block shrinks with each look more than that, in powers of two.
const SEEN_SHIFT: u32 = 3;
/// The part that a window begins with sees such a share of what the device holds.
const FIRST_SHARE: usize = 4;
/// A block that shows nothing, or more than the device holds.
const NEVER: u32 = u32::MAX;

/// A part of a picture that sees no Gaussian which is away.
#[derive(Clone, Copy, Debug)]
struct Item {
    picture: Picture,
    part: Blocks,
    /// Blocks in which something shows.
    weight: u32,
}

/// The cells at work and what is trained with them.
pub(crate) struct Window {
    /// By index, in order.
    cells: Vec<u32>,
    wanted: Vec<bool>,
    /// Gaussians of the cells wanted.
    held: usize,
    items: Vec<Item>,
    /// Nothing was trained yet: the part that the window began with comes first.
    first: bool,
    /// The fewest looks at any block.
    least_looks: u32,
    /// The step after which it ends.
    pub until: u32,
    /// Steps that looked at each block of each view.
    visits: Vec<u32>,
    sights: Vec<Sight>,
    by_distance: Vec<(f32, u32)>,
}

impl Window {
    pub fn new(plan: &Plan) -> Self {
        let (views, crops) = if plan.is_paged() { (plan.views, plan.crops) } else { (0, 0) };
        Self {
            cells: Vec::with_capacity(plan.cells()),
            wanted: Vec::with_capacity(plan.cells()),
            held: 0,
            items: Vec::with_capacity(views + crops + 1),
            first: false,
            least_looks: 0,
            until: 0,
            visits: vec![0; views * BLOCKS],
            sights: Vec::with_capacity(views + crops),
            by_distance: Vec::with_capacity(plan.cells()),
        }
    }

    pub fn close(&mut self) {
        self.cells.clear();
        self.items.clear();
        self.until = 0;
        self.visits.fill(0);
    }

    /// How likely an item is chosen: by its blocks, each the less the oftener it was looked at.
    fn chance(&self, item: &Item) -> u64 {
        let Picture::View(view) = item.picture else { return item.weight.into() };
        let visits = self.visits[view * BLOCKS..(view + 1) * BLOCKS].iter().enumerate();
        let part = visits.filter(|(block, visits)| item.part.mask() >> block & 1 == 1 && **visits != NEVER);
        let shift = |visits: u32| (SEEN_SHIFT * visits.saturating_sub(self.least_looks)).min(LEAST_SEEN.ilog2());
        // A step on a large part is worth more than one on each of its blocks.
        u64::from(item.part.count()) * part.map(|(_, visits)| LEAST_SEEN >> shift(*visits)).sum::<u64>()
    }

    /// The block of the first `views` views that was looked at least, one of several by chance; `None` when none can be.
    fn least_visited(&self, views: usize, rng: &mut impl Rng) -> Option<(usize, u8, u8)> {
        let visits = &self.visits[..views * BLOCKS];
        let least = visits.iter().copied().min().filter(|v| *v != NEVER)?;
        let those = || visits.iter().enumerate().filter(|(_, v)| **v == least);
        let (at, _) = those().nth(rng.random_range(0..those().count()))?;
        let (view, block) = (at / BLOCKS, (at % BLOCKS) as u8);
        Some((view, block % SIDE, block / SIDE))
    }
}

impl Trainer {
    /// Has the cells of a window on the device: the present one's, or those of the next when it is over.
    pub(in crate::trainer) fn hold_window(&mut self) -> Result<(), TrainError> {
        let over = self.steps >= self.scene.window.until;
        let away = |index: &u32| !self.scene.cells[*index as usize].on_device;
        if !over && !self.scene.window.cells.iter().any(away) {
            return Ok(());
        }
        self.end_window()?;
        self.page_out(false)?;
        if over {
            self.choose_cells()?;
        }
        let cells = std::mem::take(&mut self.scene.window.cells);
        let done = self.page_in(&cells);
        self.scene.window.cells = cells;
        done?;
        if over {
            self.scene.window.until = self.steps + self.settings.cells.steps;
            self.counters.windows += 1;
        }
        Ok(())
    }

    /// Takes the cells of a window that is over off the device.
    pub(super) fn end_window(&mut self) -> Result<(), TrainError> {
        if self.scene.window.cells.is_empty() || !self.window_ends() {
            return Ok(());
        }
        self.page_out(true)?;
        self.scene.window.cells.clear();
        Ok(())
    }

    /// What the next step looks at, and which part of it.
    pub(in crate::trainer) fn choose_part(&mut self, progress: f32) -> (Picture, Blocks) {
        let crops_due = self.settings.crops.is_due(self.steps, progress);
        let (window, rng) = (&mut self.scene.window, self.sampler.rng());
        let is_crop = |item: &Item| matches!(item.picture, Picture::Crop(_));
        let crops = crops_due && !window.first && window.items.iter().any(is_crop);
        let of_kind = || window.items.iter().filter(|item| is_crop(item) == crops);
        let all: u64 = of_kind().map(|item| window.chance(item)).sum();
        let mut drawn = if window.first { 0 } else { rng.random_range(0..all.max(1)) };
        let mut chosen = window.items[0];
        for item in of_kind() {
            chosen = *item;
            let chance = window.chance(item);
            if drawn < chance || window.first {
                break;
            }
            drawn -= chance;
        }
        window.first = false;
        if let Picture::View(view) = chosen.picture {
            window.look_at(view, chosen.part);
        }
        (chosen.picture, chosen.part)
    }

    /// Where each view, and behind them each crop, looks.
    fn look_around(&mut self) {
        self.frame.flags = 0;
        self.scene.window.sights.clear();
        for i in 0..self.views.len() + self.crops.len() {
            let view = match i.checked_sub(self.views.len()) {
                None => self.views[i].view,
                Some(crop) => self.crops[crop].seen_from(&self.views[self.crops[crop].view].view),
            };
            self.frame.look(&view);
            self.scene.window.sights.push(Sight::new(&self.frame, [0, 0], self.frame.size));
        }
    }

    /// Gaussians that a window begins with: all that the device holds, but for those that densification adds to them.
    fn window_capacity(&self) -> usize {
        let d = &self.settings.density;
        let grows = self.strategy == Strategy::Relocate && self.progress() < d.until;
        let most = self.plan.gaussians;
        if grows { (most as f32 / (1.0 + d.growth)) as usize } else { most }
    }

    /// The cells of the next window, while none is on the device, and what is trained with them.
    fn choose_cells(&mut self) -> Result<(), TrainError> {
        self.look_around();
        let (capacity, views) = (self.window_capacity(), self.views.len());
        let Scene { window, cells, .. } = &mut self.scene;
        let mut fewest = usize::MAX;
        let (view, part) = loop {
            let Some((view, x, y)) = window.least_visited(views, self.sampler.rng()) else {
                let least = TrainError::TooCrowded { needed: fewest, gaussians: capacity };
                return Err(if fewest == usize::MAX { TrainError::NothingInView } else { least });
            };
            let sight = window.sights[view];
            let seen = |part: Blocks| {
                let shows = |c: &&Cell| sight.blocks(&c.bounds).is_some_and(|b| b.mask() & part.mask() != 0);
                cells.iter().filter(shows).map(|c| c.count).sum::<usize>()
            };
            let mut needed = 0;
            // Most of the room is left to the ground around, which other pictures see from elsewhere.
            let fits = [capacity / FIRST_SHARE, capacity].into_iter().find_map(|room| {
                parts_around(x, y).find(|part| {
                    needed = seen(*part);
                    needed <= room
                })
            });
            match fits {
                Some(part) if needed > 0 => break (view, part),
                Some(_) => {}
                None => fewest = fewest.min(needed),
            }
            window.visits[view * BLOCKS + usize::from(y) * usize::from(SIDE) + usize::from(x)] = NEVER;
        };
        window.begin(cells.len());
        window.plan_part(cells, (view, part));
        window.fill_up(cells, capacity);
        window.choose_items(cells, views);
        let blocks: u32 = window.items.iter().map(|item| item.part.count()).sum();
        let (cells, parts) = (window.cells.len(), window.items.len());
        tracing::debug!(cells, gaussians = window.held, parts, blocks, "window of cells");
        Ok(())
    }
}

fn shows_in(cell: &Cell, sight: &Sight, part: Blocks) -> bool {
    cell.count > 0 && sight.blocks(&cell.bounds).is_some_and(|blocks| blocks.mask() & part.mask() != 0)
}

impl Window {
    /// Nothing is wanted of so many cells.
    fn begin(&mut self, cells: usize) {
        self.wanted.clear();
        self.wanted.resize(cells, false);
        self.items.clear();
        self.held = 0;
    }

    /// Wants the cells that show in a part of a view, which is then trained in this window.
    fn plan_part(&mut self, cells: &[Cell], (view, part): (usize, Blocks)) {
        for (wanted, cell) in self.wanted.iter_mut().zip(cells) {
            if !*wanted && shows_in(cell, &self.sights[view], part) {
                *wanted = true;
                self.held += cell.count;
            }
        }
        self.items.push(Item { picture: Picture::View(view), part, weight: part.count() });
        self.look_at(view, part);
    }

    /// Counts a look at a part of a view.
    fn look_at(&mut self, view: usize, part: Blocks) {
        let (mask, visits) = (part.mask(), &mut self.visits[view * BLOCKS..(view + 1) * BLOCKS]);
        let looked_at = visits.iter_mut().enumerate().filter(|(block, v)| mask >> block & 1 == 1 && **v != NEVER);
        looked_at.for_each(|(_, visits)| *visits += 1);
    }

    /// The nearest cells for as long as there is room, by their nearest edge: a rectangle of a picture needs the large Gaussians, too,
    /// that reach into it from afar.
    fn fill_up(&mut self, cells: &[Cell], capacity: usize) {
        let mut centre = Vec2::ZERO;
        for (cell, _) in cells.iter().zip(&self.wanted).filter(|(_, wanted)| **wanted) {
            centre += cell.count as f32 * cell.bounds.centre();
        }
        centre /= self.held.max(1) as f32;
        self.by_distance.clear();
        for (i, cell) in cells.iter().enumerate().filter(|(i, c)| !self.wanted[*i] && c.count > 0) {
            self.by_distance.push((cell.bounds.ground_distance(centre), i as u32));
        }
        self.by_distance.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for (_, i) in &self.by_distance {
            let more = cells[*i as usize].count;
            if self.held + more > capacity {
                break;
            }
            self.held += more;
            self.wanted[*i as usize] = true;
        }
        self.cells.clear();
        self.cells.extend((0..cells.len() as u32).filter(|i| self.wanted[*i as usize]));
    }

    /// Besides the first part, of every picture the largest rectangle that sees no cell which is away.
    fn choose_items(&mut self, cells: &[Cell], views: usize) {
        for (i, sight) in self.sights.iter().enumerate() {
            let (mut free, mut shown) = (u64::MAX, 0);
            for (cell, wanted) in cells.iter().zip(&self.wanted).filter(|(c, _)| c.count > 0) {
                let Some(blocks) = sight.blocks(&cell.bounds) else { continue };
                match wanted {
                    true => shown |= blocks.mask(),
                    false => free &= !blocks.mask(),
                }
            }
            let picture = i.checked_sub(views).map_or(Picture::View(i), Picture::Crop);
            // A crop is a part already.
            let part = match picture {
                Picture::View(_) => largest_rectangle(free).filter(|part| part.count() >= LEAST_BLOCKS),
                Picture::Crop(_) => (free == u64::MAX).then_some(Blocks::WHOLE),
            };
            let Some(part) = part else { continue };
            let weight = (part.mask() & shown).count_ones();
            if weight > 0 {
                self.items.push(Item { picture, part, weight });
            }
        }
        self.first = true;
        self.least_looks = self.visits[..views * BLOCKS].iter().copied().min().unwrap_or(0);
    }
}

#[cfg(test)]
mod tests {
    use config::plan::PlanRequest;
    use config::training::ResolutionSettings;

    use super::*;
    use crate::gpu::Gpu;
    use crate::synthetic::{cloud, photo, plain, posed, view};

    #[test]
    fn a_part_of_a_picture_is_compared_with_that_part_of_it_at_every_resolution() {
        let Ok(gpu) = Gpu::open(None) else { return println!("skipped: no Vulkan device") };
        let (v, part) = (view(70, 49), Blocks { x: [3, 6], y: [2, 7] });
        let picture = posed(&v, &photo(1, &v));
        for (divisor, half_until) in [(1, 0.0), (2, 1.0)] {
            let request =
                PlanRequest { width: 70, height: 49, views: 1, max_gaussians: Some(256), ..Default::default() };
            let mut settings = plain();
            settings.resolution =
                ResolutionSettings { quarter_until: 0.0, half_until, least_side: 1, ..Default::default() };
            let mut t = Trainer::new(&gpu, &Plan::new(&request).unwrap(), &settings).unwrap();
            t.load(&cloud(1, 64, 0)).unwrap();
            t.add_view(&picture, None).unwrap();
            let (chosen, first_pixel) = t.prepare_frame(Picture::View(0), part, 0.0);
            t.write_frame();
            t.forward_count(Picture::View(0), first_pixel).unwrap();
            let ((x, width), (y, height)) =
                (Blocks::pixels(part.x, 70 / divisor), Blocks::pixels(part.y, 49 / divisor));
            assert_eq!((chosen, t.frame.size), (divisor, [width, height]));
            assert_eq!(
                t.frame.principal_point,
                [v.intrinsics.cx / divisor as f32 - x as f32, v.intrinsics.cy / divisor as f32 - y as f32]
            );
            let words = t.arena.copied::<[u32; 2]>(t.arena.section("target"));
            for (i, [word, _]) in words[..(width * height) as usize].iter().enumerate() {
                let (left, top) = (divisor * (x + i as u32 % width), divisor * (y + i as u32 / width));
                let block =
                    (0..divisor * divisor).map(|k| picture.image.get_pixel(left + k % divisor, top + k / divisor).0);
                let mean = block.fold([0.0; 3], |sum: [f32; 3], p| std::array::from_fn(|c| sum[c] + f32::from(p[c])));
                let mean = mean.map(|c| c / (divisor * divisor) as f32);
                let [r, g, b, _] = word.to_le_bytes().map(f32::from);
                let off = [r, g, b].iter().zip(mean).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(off <= 0.51, "pixel {i} at 1/{divisor}: off by {off}");
            }
        }
    }
}

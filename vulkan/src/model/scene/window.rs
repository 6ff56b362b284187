//! Which cells are on the device, for how long, and which parts of which pictures are trained meanwhile.
//!
//! A window [begins](super::begin) with a part of a picture that was visited least, and the cells which that part sees. Where it lasts
//! for one update, cells stay beside those for as long as there is room, as the next window may want them. Where it lasts for several,
//! the nearest cells come, too: the same ground, seen from many places, and of every picture the largest rectangle is trained that sees
//! no cell which is away meanwhile.

use config::plan::Plan;
use glam::Vec2;
use rand::Rng;
use std::ops::Range;

use super::Cell;
use super::cell::{Blocks, Frustum, SIDE};
use super::parts::largest_rectangle;
use crate::error::TrainError;
use crate::pictures::sampler::Sampler;
use crate::pictures::{Picture, PictureStore};

/// Blocks of a picture.
pub(super) const BLOCKS: usize = SIDE as usize * SIDE as usize;
/// A sixteenth of a picture is worth an update; what the window began with always is.
const LEAST_BLOCKS: u32 = 4;
/// The chance of a block that was visited least.
const MOST_CHANCE: u64 = 1 << 20;
/// How much the chance of a block shrinks with each visit more than that, in powers of two.
const VISIT_SHIFT: u32 = 3;
/// Where several updates share a window, the part that it begins with sees such a share of what the device holds: most of the room is left
/// to the ground around, which other pictures see from elsewhere.
const FIRST_SHARE: usize = 4;
/// A block that shows nothing, or more than the device holds.
pub(super) const NEVER: u32 = u32::MAX;

/// A part of a picture that sees no Gaussian which is away.
#[derive(Clone, Copy, Debug)]
struct Item {
    picture: Picture,
    part: Blocks,
    /// Blocks in which something shows.
    weight: u32,
}

/// By what a window is chosen.
pub(crate) struct Choice<'a> {
    pub pictures: &'a PictureStore,
    pub sampler: &'a mut Sampler,
    /// Gaussians that a window may begin with.
    pub capacity: usize,
    /// Updates that it lasts.
    pub updates: u32,
    /// Whether the next update visits a crop.
    pub crops_due: bool,
}

impl Choice<'_> {
    pub(super) fn frustum_of(&self, picture: Picture) -> Frustum {
        Frustum::of(&self.pictures.camera(picture))
    }
}

/// The cells at work and what is trained with them.
pub(crate) struct Window {
    /// By index, in order.
    pub cells: Vec<u32>,
    wanted: Vec<bool>,
    /// Gaussians of the cells wanted.
    held: usize,
    items: Vec<Item>,
    /// Nothing was trained yet: the part that the window began with comes first.
    first: bool,
    /// The fewest visits to any block.
    least_visits: u32,
    /// The update after which it ends.
    pub until: u32,
    /// Updates that visited each block of each view.
    pub(super) visits: Vec<u32>,
    frusta: Vec<Frustum>,
    by_distance: Vec<(f32, u32)>,
    /// Of the picture that a window begins with: the cells that may show in it, and in which blocks.
    pub(super) shown: Vec<(u32, u64)>,
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
            least_visits: 0,
            until: 0,
            visits: vec![0; views * BLOCKS],
            frusta: Vec::with_capacity(views + crops),
            by_distance: Vec::with_capacity(plan.cells()),
            shown: Vec::with_capacity(plan.cells()),
        }
    }

    pub fn close(&mut self) {
        self.cells.clear();
        self.items.clear();
        self.until = 0;
        self.visits.fill(0);
    }

    /// Ends with the update `updates`. What showed nothing may show something afterwards.
    pub fn end_at(&mut self, updates: u32) {
        self.until = updates;
        self.visits.iter_mut().filter(|visits| **visits == NEVER).for_each(|visits| *visits = 0);
    }

    /// How likely an item is chosen: by its blocks, each the less the oftener it was visited.
    fn chance(&self, item: &Item) -> u64 {
        let Picture::View(view) = item.picture else { return item.weight.into() };
        let visits = self.visits[view * BLOCKS..(view + 1) * BLOCKS].iter().enumerate();
        let part = visits.filter(|(block, visits)| item.part.mask() >> block & 1 == 1 && **visits != NEVER);
        let shift = |visits: u32| (VISIT_SHIFT * visits.saturating_sub(self.least_visits)).min(MOST_CHANCE.ilog2());
        // An update on a large part is worth more than one on each of its blocks.
        u64::from(item.part.count()) * part.map(|(_, visits)| MOST_CHANCE >> shift(*visits)).sum::<u64>()
    }

    /// Blocks of `views`, of those that were visited least, by chance; `None` when none can be.
    pub(super) fn least_visited<const N: usize>(
        &self,
        views: Range<usize>,
        rng: &mut impl Rng,
    ) -> Option<[(usize, (u8, u8)); N]> {
        let visits = &self.visits[views.start * BLOCKS..views.end * BLOCKS];
        let least = visits.iter().copied().min().filter(|v| *v != NEVER)?;
        let those = || visits.iter().enumerate().filter(|(_, v)| **v == least).map(|(at, _)| at);
        let count = those().count();
        let mut drawn: [(usize, usize); N] = std::array::from_fn(|i| (rng.random_range(0..count), i));
        drawn.sort_unstable();
        let (mut found, mut left) = ([(0, (0, 0)); N], drawn.iter().peekable());
        for (ordinal, at) in those().enumerate() {
            while let Some((_, i)) = left.next_if(|(drawn, _)| *drawn == ordinal) {
                let block = (at % BLOCKS) as u8;
                found[*i] = (views.start + at / BLOCKS, (block % SIDE, block / SIDE));
            }
            if left.peek().is_none() {
                break;
            }
        }
        Some(found)
    }
}

impl Window {
    /// The cells of the next window, and what is trained with them.
    pub fn choose(&mut self, cells: &[Cell], mut by: Choice<'_>) -> Result<(), TrainError> {
        let (capacity, updates) = (by.capacity, by.updates as usize);
        let first = capacity / updates.clamp(1, FIRST_SHARE);
        let crop = if by.crops_due { self.begin_with_crop(cells, &mut by, first) } else { None };
        let (picture, part) = match crop {
            Some(first) => first,
            None => self.begin_with_view(cells, &mut by, first)?,
        };
        self.begin(cells, picture, part);
        self.fill_up(cells, capacity, updates > 1);
        if updates > 1 {
            self.frusta.clear();
            self.frusta.extend(by.pictures.all().map(|picture| by.frustum_of(picture)));
            self.choose_items(cells, by.pictures.len());
        }
        let blocks: u32 = self.items.iter().map(|item| item.part.count()).sum();
        let (cells, parts) = (self.cells.len(), self.items.len());
        tracing::debug!(cells, gaussians = self.held, parts, blocks, "window of cells");
        Ok(())
    }

    /// What the next update visits, and which part of it.
    pub fn next_part(&mut self, crops_due: bool, rng: &mut impl Rng) -> (Picture, Blocks) {
        let is_crop = |item: &Item| matches!(item.picture, Picture::Crop(_));
        let crops = crops_due && !self.first && self.items.iter().any(is_crop);
        let of_kind = || self.items.iter().filter(|item| is_crop(item) == crops);
        let all: u64 = of_kind().map(|item| self.chance(item)).sum();
        let mut drawn = if self.first { 0 } else { rng.random_range(0..all.max(1)) };
        let mut chosen = self.items[0];
        for item in of_kind() {
            chosen = *item;
            let chance = self.chance(item);
            if drawn < chance || self.first {
                break;
            }
            drawn -= chance;
        }
        self.first = false;
        if let Picture::View(view) = chosen.picture {
            self.count_visit(view, chosen.part);
        }
        (chosen.picture, chosen.part)
    }

    /// Wants the cells that show in a part of the picture that was [grown around](super::parts::grown_around) last: it is trained first.
    fn begin(&mut self, cells: &[Cell], picture: Picture, part: Blocks) {
        let Self { wanted, shown, items, held, .. } = self;
        wanted.clear();
        wanted.resize(cells.len(), false);
        *held = 0;
        for (i, _) in shown.iter().filter(|(_, shown)| shown & part.mask() != 0) {
            wanted[*i as usize] = true;
            *held += cells[*i as usize].count;
        }
        items.clear();
        items.push(Item { picture, part, weight: part.count() });
        self.first = true;
    }

    /// Counts a visit to a part of a view.
    fn count_visit(&mut self, view: usize, part: Blocks) {
        let (mask, visits) = (part.mask(), &mut self.visits[view * BLOCKS..(view + 1) * BLOCKS]);
        let visited = visits.iter_mut().enumerate().filter(|(block, v)| mask >> block & 1 == 1 && **v != NEVER);
        visited.for_each(|(_, visits)| *visits += 1);
    }

    /// The nearest cells for as long as there is room, by their nearest edge: a rectangle of a picture needs the large Gaussians, too,
    /// that reach into it from afar. Where `more` than the first part is not to be trained, of those that are at work already.
    fn fill_up(&mut self, cells: &[Cell], capacity: usize, more: bool) {
        let mut centre = Vec2::ZERO;
        for (cell, _) in cells.iter().zip(&self.wanted).filter(|(_, wanted)| **wanted) {
            centre += cell.count as f32 * cell.bounds.centre();
        }
        centre /= self.held.max(1) as f32;
        self.by_distance.clear();
        let of_use = |(i, c): &(usize, &Cell)| !self.wanted[*i] && c.count > 0 && (more || c.at_work);
        for (i, cell) in cells.iter().enumerate().filter(of_use) {
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
        for (i, frustum) in self.frusta.iter().enumerate() {
            let (mut free, mut shown) = (u64::MAX, 0);
            for (cell, wanted) in cells.iter().zip(&self.wanted).filter(|(c, _)| c.count > 0) {
                let Some(blocks) = frustum.blocks(&cell.bounds) else { continue };
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
        self.least_visits = self.visits[..views * BLOCKS].iter().copied().min().unwrap_or(0);
    }
}

#[cfg(test)]
mod tests {
    use config::plan::PlanRequest;
    use config::training::ResolutionSettings;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::fixture::Fixture;
    use crate::gpu::Gpu;
    use crate::synthetic::{cloud, photo, plain, posed, view};

    #[test]
    fn a_window_begins_where_pictures_were_visited_least() {
        let request =
            PlanRequest { views: 2, max_gaussians: Some(256), scene_gaussians: Some(1000), ..Default::default() };
        let mut window = Window::new(&Plan::new(&request).unwrap());
        window.visits.fill(3);
        (window.visits[5], window.visits[BLOCKS + 9], window.visits[20]) = (2, 2, NEVER);
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let found = window.least_visited::<16>(0..2, &mut rng).unwrap();
        let those = [(0, (5, 0)), (1, (1, 1))];
        assert!(found.iter().all(|place| those.contains(place)), "{found:?}");
        assert!(those.iter().all(|place| found.contains(place)), "{found:?}");
        let found = window.least_visited::<16>(1..2, &mut rng).unwrap();
        assert_eq!(found, [(1, (1, 1)); 16]);
        window.visits.fill(NEVER);
        assert_eq!(window.least_visited::<4>(0..2, &mut rng), None);
    }

    #[test]
    fn a_part_of_a_picture_is_compared_with_that_part_of_it_at_every_resolution() {
        let Ok(gpu) = Gpu::open(None) else { return needs::missing(needs::Need::Vulkan, "no Vulkan device") };
        let (v, part) = (view(70, 49), Blocks { x: [3, 6], y: [2, 7] });
        let picture = posed(&v, &photo(1, &v));
        for (divisor, half_until) in [(1, 0.0), (2, 1.0)] {
            let request =
                PlanRequest { width: 70, height: 49, views: 1, max_gaussians: Some(256), ..Default::default() };
            let mut settings = plain();
            settings.resolution =
                ResolutionSettings { quarter_until: 0.0, half_until, least_side: 1, ..Default::default() };
            let mut t = Fixture::new(&gpu, &Plan::new(&request).unwrap(), &settings).unwrap();
            t.load(&cloud(1, 64, 0)).unwrap();
            t.add_view(&picture, None).unwrap();
            let chosen = t.project_part(part);
            let ((x, width), (y, height)) =
                (Blocks::pixels(part.x, 70 / divisor), Blocks::pixels(part.y, 49 / divisor));
            assert_eq!((chosen, t.device.frame.size), (divisor, [width, height]));
            assert_eq!(
                t.device.frame.principal_point,
                [v.intrinsics.cx / divisor as f32 - x as f32, v.intrinsics.cy / divisor as f32 - y as f32]
            );
            let words = t.device.arena.copied::<[u32; 2]>(t.device.arena.section("target"));
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

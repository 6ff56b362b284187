//! Where each voxel is, by its Morton key: eight siblings side by side, and bricks of them near their neighbours, so that what a
//! picture shows side by side is found in memory that was read just before.

use hashbrown::HashTable;

/// Morton digits (bits) within a brick, and voxels of one: 2 × 2 × 2.
const DIGITS: u32 = 3;
const VOXELS: usize = 1 << DIGITS;
/// No voxel there yet.
const NONE: u32 = u32::MAX;
/// Bricks that there is room for, of each ten voxels. Level ground that one picture shows has two voxels in each; sheffield_cross
/// has 1.9 at the finest, 3.5 at twice their edge.
const BRICKS_OF_TEN: usize = 7;
/// Of the table: an index and a tag, with the most that it leaves empty.
const LOOKED_UP_BYTES: u64 = 12;
/// What the smallest table takes beyond that: a group of tags.
const TABLE_BYTES: u64 = 64;

/// Morton digits (bits) of a brick that stay beside each other in the table: sixteen bricks share a line or two of the cache.
const NEAR: u32 = 4;

/// Leaves neighbours neighbours and is the same on every run.
fn hash(key: u64) -> u64 {
    // The golden ratio's digits (Fibonacci hashing): their product's upper half depends on all of the key. The table tells
    // neighbours apart by the uppermost seven bits.
    let far = (key >> NEAR).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let near = key & ((1 << NEAR) - 1);
    (((far ^ far >> 32) >> NEAR << NEAR) | near) ^ near << (64 - NEAR)
}

/// Eight voxels.
#[derive(Debug)]
struct Brick {
    /// What their keys begin with.
    key: u64,
    voxels: [u32; VOXELS],
}

/// The index of each voxel that is known, in fixed memory.
#[derive(Debug)]
pub struct Bricks {
    /// Where each brick is, by its key.
    at: HashTable<u32>,
    bricks: Vec<Brick>,
    capacity: usize,
}

impl Bricks {
    /// For as many voxels; scattered ones fill them with fewer.
    pub fn for_voxels(voxels: usize) -> Self {
        let capacity = Self::count(voxels);
        Self { at: HashTable::with_capacity(capacity), bricks: Vec::with_capacity(capacity), capacity }
    }

    fn count(voxels: usize) -> usize {
        (voxels * BRICKS_OF_TEN).div_ceil(10)
    }

    /// Host bytes for as many voxels.
    pub fn planned_bytes(voxels: usize) -> u64 {
        TABLE_BYTES + Self::count(voxels) as u64 * (size_of::<Brick>() as u64 + LOOKED_UP_BYTES)
    }

    fn brick(&self, key: u64) -> Option<u32> {
        self.at.find(hash(key), |at| self.bricks[*at as usize].key == key).copied()
    }

    /// The index of a voxel. `last` is the brick of the search before it: a neighbour is often in the same one.
    pub fn find(&self, key: u64, last: &mut Option<u32>) -> Option<u32> {
        let (brick, voxel) = (key >> DIGITS, key as usize % VOXELS);
        let same = last.filter(|at| self.bricks[*at as usize].key == brick);
        let at = match same {
            Some(at) => at,
            None => self.brick(brick)?,
        };
        *last = Some(at);
        let index = self.bricks[at as usize].voxels[voxel];
        (index != NONE).then_some(index)
    }

    /// Remembers a voxel's index; whether there was room for it.
    #[must_use]
    pub fn insert(&mut self, key: u64, index: u32) -> bool {
        let (brick, voxel) = (key >> DIGITS, key as usize % VOXELS);
        let at = match self.brick(brick) {
            Some(at) => at as usize,
            None if self.bricks.len() >= self.capacity => return false,
            None => {
                let at = self.bricks.len();
                self.bricks.push(Brick { key: brick, voxels: [NONE; VOXELS] });
                self.at.insert_unique(hash(brick), at as u32, |other| hash(self.bricks[*other as usize].key));
                at
            }
        };
        self.bricks[at].voxels[voxel] = index;
        true
    }

    /// Forgets all.
    pub fn clear(&mut self) {
        self.at.clear();
        self.bricks.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_voxel_is_found_where_it_was_put_and_no_other() {
        let mut bricks = Bricks::for_voxels(1000);
        let keys: Vec<u64> = (0..1000).map(|k| k * 5).collect();
        for (index, key) in keys.iter().enumerate() {
            assert!(bricks.insert(*key, index as u32));
        }
        let mut last = None;
        for key in 0..6000 {
            let expected = keys.binary_search(&key).ok().map(|index| index as u32);
            assert_eq!(bricks.find(key, &mut last), expected, "{key}");
        }
        bricks.clear();
        assert_eq!(bricks.find(0, &mut None), None);
    }

    #[test]
    fn scattered_voxels_are_refused_once_the_memory_is_taken() {
        let mut bricks = Bricks::for_voxels(100);
        let room = (0..100u64).filter(|k| bricks.insert(k * 8, *k as u32)).count();
        assert_eq!(room, 70);
        assert!(bricks.insert(1, 100) && !bricks.insert(70 * 8, 101));
    }

    #[test]
    fn a_table_for_any_number_of_voxels_stays_within_its_plan() {
        for voxels in (1..200_000).step_by(977) {
            let bricks = Bricks::for_voxels(voxels);
            let held = bricks.at.allocation_size() + bricks.bricks.capacity() * size_of::<Brick>();
            assert!(held as u64 <= Bricks::planned_bytes(voxels), "{voxels}: {held}");
        }
    }
}

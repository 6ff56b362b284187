//! The file of the cells that are not on the device: blocks of records, each a Gaussian with its moments as the arena holds it.
//! It lives as long as the job: what survives a job is its model.

use std::fs::File;
use std::os::unix::fs::FileExt;

use config::plan::{BLOCK_GAUSSIANS, Plan};

use crate::error::TrainError;

/// No block.
const NONE: u32 = u32::MAX;

/// The blocks of one cell.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Chain {
    first: u32,
    last: u32,
    /// Gaussians.
    pub count: u32,
}

impl Chain {
    pub const EMPTY: Self = Self { first: NONE, last: NONE, count: 0 };
}

/// What becomes of a record that is visited.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Rewritten {
    /// Nothing.
    Stays,
    /// It was changed.
    Changes,
    /// It is taken out.
    Goes,
}

/// Blocks in a file, and a buffer of one.
pub(crate) struct Store {
    file: Option<File>,
    record: usize,
    /// The block behind each block.
    next: Vec<u32>,
    free: u32,
    buffer: Vec<u8>,
    /// Bytes read and written since it was cleared.
    pub moved: u64,
}

impl Store {
    pub fn new(plan: &Plan) -> Self {
        let mut store = Self {
            file: None,
            record: plan.record_bytes(),
            next: vec![NONE; plan.scene_blocks()],
            free: NONE,
            buffer: vec![0; if plan.is_paged() { BLOCK_GAUSSIANS * plan.record_bytes() } else { 0 }],
            moved: 0,
        };
        store.clear();
        store
    }

    pub fn keep_in(&mut self, file: File) {
        self.file = Some(file);
    }

    /// All blocks are free.
    pub fn clear(&mut self) {
        let blocks = self.next.len() as u32;
        self.next.iter_mut().zip(1..).for_each(|(next, after)| *next = if after < blocks { after } else { NONE });
        (self.free, self.moved) = (if blocks > 0 { 0 } else { NONE }, 0);
    }

    /// Gives the cell's blocks back; it is empty then.
    pub fn forget(&mut self, chain: &mut Chain) {
        if chain.last != NONE {
            self.next[chain.last as usize] = self.free;
            self.free = chain.first;
        }
        *chain = Chain::EMPTY;
    }

    /// Puts records behind those of the cell; `fill(i, record)` writes the i-th of `count`.
    ///
    /// # Errors
    /// [`TrainError::SceneFile`]: no file, no block left, or the disk.
    pub fn append(
        &mut self,
        chain: &mut Chain,
        count: usize,
        mut fill: impl FnMut(usize, &mut [u8]),
    ) -> Result<(), TrainError> {
        let mut done = 0;
        while done < count {
            let within = chain.count as usize % BLOCK_GAUSSIANS;
            if within == 0 && !self.steps_on(chain) {
                self.add_block(chain)?;
            }
            let records = (BLOCK_GAUSSIANS - within).min(count - done);
            let bytes = &mut self.buffer[..records * self.record];
            bytes.chunks_exact_mut(self.record).enumerate().for_each(|(i, record)| fill(done + i, record));
            let at = self.offset(chain.last, within);
            let bytes = &self.buffer[..records * self.record];
            let file = self.file.as_ref().ok_or_else(no_file)?;
            file.write_all_at(bytes, at).map_err(|e| failed("writing", &e))?;
            self.moved += bytes.len() as u64;
            chain.count += records as u32;
            done += records;
        }
        Ok(())
    }

    /// Sets blocks for so many records of an empty cell aside, one behind the other: what is appended by turns with other cells is read
    /// as one piece. They are the cell's for good once they are full; the file is cleared where they are not to be filled.
    ///
    /// # Errors
    /// [`TrainError::SceneFile`]: not enough blocks are left.
    pub fn set_aside(&mut self, chain: &mut Chain, records: usize) -> Result<(), TrainError> {
        for _ in 0..records.div_ceil(BLOCK_GAUSSIANS) {
            self.add_block(chain)?;
        }
        chain.last = NONE;
        Ok(())
    }

    /// Goes on to the next block that was set aside for the cell; false when there is none.
    fn steps_on(&self, chain: &mut Chain) -> bool {
        let next = if chain.last == NONE { chain.first } else { self.next[chain.last as usize] };
        if next != NONE {
            chain.last = next;
        }
        next != NONE
    }

    fn add_block(&mut self, chain: &mut Chain) -> Result<(), TrainError> {
        let block = self.free;
        if block == NONE {
            return Err(TrainError::SceneFile("it has no block left".into()));
        }
        self.free = std::mem::replace(&mut self.next[block as usize], NONE);
        match chain.last {
            NONE => chain.first = block,
            last => self.next[last as usize] = block,
        }
        chain.last = block;
        Ok(())
    }

    /// The cell's records in order.
    ///
    /// # Errors
    /// [`TrainError::SceneFile`], and those of `take`.
    pub fn read<E: From<TrainError>>(
        &mut self,
        chain: &Chain,
        mut take: impl FnMut(usize, &[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        let (mut block, mut done, count) = (chain.first, 0, chain.count as usize);
        while done < count && block != NONE {
            let records = BLOCK_GAUSSIANS.min(count - done);
            let at = self.offset(block, 0);
            let bytes = &mut self.buffer[..records * self.record];
            let file = self.file.as_ref().ok_or_else(no_file)?;
            file.read_exact_at(bytes, at).map_err(|e| failed("reading", &e))?;
            self.moved += bytes.len() as u64;
            bytes.chunks_exact(self.record).enumerate().try_for_each(|(i, record)| take(done + i, record))?;
            done += records;
            block = self.next[block as usize];
        }
        Ok(())
    }

    /// Rewrites the cell's records where they lie, as `revised` says of each; those behind one that goes move up, and blocks that become
    /// empty are free.
    ///
    /// # Errors
    /// [`TrainError::SceneFile`]: what was rewritten so far is, and what was not is not.
    pub fn rewrite(
        &mut self,
        chain: &mut Chain,
        mut revised: impl FnMut(&mut [u8]) -> Rewritten,
    ) -> Result<(), TrainError> {
        let (mut from, mut to, mut done, mut kept, count) = (chain.first, chain.first, 0, 0, chain.count as usize);
        while done < count && from != NONE {
            let records = BLOCK_GAUSSIANS.min(count - done);
            let at = self.offset(from, 0);
            let (bytes, record) = (&mut self.buffer[..records * self.record], self.record);
            self.file.as_ref().ok_or_else(no_file)?.read_exact_at(bytes, at).map_err(|e| failed("reading", &e))?;
            self.moved += bytes.len() as u64;
            let (mut changed, mut stay) = (kept < done, 0);
            for i in 0..records {
                let rewritten = revised(&mut bytes[i * record..(i + 1) * record]);
                changed |= rewritten != Rewritten::Stays;
                if rewritten != Rewritten::Goes {
                    bytes.copy_within(i * record..(i + 1) * record, stay * record);
                    stay += 1;
                }
            }
            let mut written = 0;
            while written < stay {
                let within = kept % BLOCK_GAUSSIANS;
                if within == 0 && kept > 0 {
                    to = self.next[to as usize];
                }
                let records = (BLOCK_GAUSSIANS - within).min(stay - written);
                if changed {
                    let at = self.offset(to, within);
                    let bytes = &self.buffer[written * record..(written + records) * record];
                    let file = self.file.as_ref().ok_or_else(no_file)?;
                    file.write_all_at(bytes, at).map_err(|e| failed("writing", &e))?;
                    self.moved += bytes.len() as u64;
                }
                (kept, written) = (kept + records, written + records);
            }
            done += records;
            from = self.next[from as usize];
        }
        if kept == 0 {
            self.forget(chain);
            return Ok(());
        }
        let behind = std::mem::replace(&mut self.next[to as usize], NONE);
        if behind != NONE {
            self.next[chain.last as usize] = self.free;
            self.free = behind;
        }
        (chain.last, chain.count) = (to, kept as u32);
        Ok(())
    }

    fn offset(&self, block: u32, record: usize) -> u64 {
        (block as u64 * BLOCK_GAUSSIANS as u64 + record as u64) * self.record as u64
    }
}

fn no_file() -> TrainError {
    TrainError::SceneFile("none was given; call Trainer::keep_scene_in".into())
}

fn failed(what: &str, e: &std::io::Error) -> TrainError {
    TrainError::SceneFile(format!("{what} it: {e}; see whether its disk fails"))
}

#[cfg(test)]
mod tests {
    use config::plan::PlanRequest;

    use super::*;

    fn store() -> Store {
        let request = PlanRequest { max_gaussians: Some(256), scene_gaussians: Some(1000), ..PlanRequest::default() };
        let mut store = Store::new(&Plan::new(&request).unwrap());
        store.keep_in(tempfile::tempfile().unwrap());
        store
    }

    fn read(store: &mut Store, chain: &Chain) -> Vec<u8> {
        let mut all = Vec::new();
        let mut take = |_: usize, record: &[u8]| {
            all.push(record[0]);
            Ok::<(), TrainError>(())
        };
        store.read(chain, &mut take).unwrap();
        all
    }

    #[test]
    fn cells_come_back_as_they_were_written_however_their_blocks_lie() {
        let mut store = store();
        let (mut a, mut b) = (Chain::EMPTY, Chain::EMPTY);
        for round in 0..3u8 {
            store.append(&mut a, 50, |i, r| r.fill(round * 50 + i as u8)).unwrap();
            store.append(&mut b, 1, |_, r| r.fill(200 + round)).unwrap();
        }
        assert_eq!(read(&mut store, &a), (0..150).collect::<Vec<u8>>());
        assert_eq!(read(&mut store, &b), [200, 201, 202]);
        store.forget(&mut a);
        assert_eq!((a.count, read(&mut store, &a)), (0, vec![]));
        store.append(&mut a, 100, |i, r| r.fill(i as u8)).unwrap();
        assert_eq!((read(&mut store, &a), read(&mut store, &b)), ((0..100).collect(), vec![200, 201, 202]));
    }

    #[test]
    fn cells_that_grow_by_turns_lie_one_behind_the_other_where_room_was_set_aside() {
        let mut store = store();
        let mut cells = [Chain::EMPTY; 2];
        // Blocks of 32: five and three of them.
        for (cell, records) in cells.iter_mut().zip([150, 65]) {
            store.set_aside(cell, records).unwrap();
        }
        for round in 0..15u8 {
            store.append(&mut cells[0], 10, |i, r| r.fill(10 * round + i as u8)).unwrap();
            store.append(&mut cells[1], if round < 13 { 5 } else { 0 }, |i, r| r.fill(5 * round + i as u8)).unwrap();
        }
        let [a, b] = cells;
        assert_eq!([a.first, a.last, b.first, b.last], [0, 4, 5, 7]);
        assert_eq!((read(&mut store, &a), read(&mut store, &b)), ((0..150).collect(), (0..65).collect()));
        // One more than was asked for comes to a block of its own, and all come back.
        cells.iter_mut().for_each(|c| store.append(c, BLOCK_GAUSSIANS, |_, r| r.fill(1)).unwrap());
        cells.iter_mut().for_each(|c| store.forget(c));
        assert!(store.append(&mut { Chain::EMPTY }, BLOCK_GAUSSIANS * store.next.len(), |_, _| {}).is_ok());
    }

    #[test]
    fn records_change_and_go_where_they_lie_and_blocks_that_become_empty_are_free() {
        let mut store = store();
        let (mut a, mut b) = (Chain::EMPTY, Chain::EMPTY);
        for round in 0..4u8 {
            store.append(&mut a, 40, |i, r| r.fill(round * 40 + i as u8)).unwrap();
            store.append(&mut b, 1, |_, r| r.fill(200 + round)).unwrap();
        }
        let free =
            |store: &Store| std::iter::successors(Some(store.free), |b| store.next.get(*b as usize).copied()).count();
        let before = free(&store);
        // What stays as it is is not written.
        let (read_before, mut looked_at) = (store.moved, 0);
        store
            .rewrite(&mut a, |_| {
                looked_at += 1;
                Rewritten::Stays
            })
            .unwrap();
        assert_eq!((looked_at, store.moved - read_before), (160, 160 * store.record as u64));
        store
            .rewrite(&mut a, |r| match r[0] {
                0..70 | 150.. => Rewritten::Goes,
                100 => {
                    r.fill(250);
                    Rewritten::Changes
                }
                _ => Rewritten::Stays,
            })
            .unwrap();
        let left: Vec<u8> = (70..150).map(|v| if v == 100 { 250 } else { v }).collect();
        assert_eq!((read(&mut store, &a), a.count), (left.clone(), 80));
        assert_eq!(
            (read(&mut store, &b), free(&store)),
            (vec![200, 201, 202, 203], before + 2),
            "five blocks, now three"
        );
        store.append(&mut a, 40, |i, r| r.fill(i as u8)).unwrap();
        assert_eq!(read(&mut store, &a), left.into_iter().chain(0..40).collect::<Vec<u8>>());
        store.rewrite(&mut a, |_| Rewritten::Goes).unwrap();
        assert_eq!((a.count, free(&store)), (0, before + 5));
    }

    #[test]
    fn every_block_is_used_before_the_file_is_full_and_all_come_back() {
        let mut store = store();
        for _ in 0..2 {
            let mut chains = vec![Chain::EMPTY; store.next.len()];
            chains.iter_mut().for_each(|c| store.append(c, BLOCK_GAUSSIANS, |_, r| r.fill(1)).unwrap());
            let error = store.append(&mut { Chain::EMPTY }, 1, |_, _| {}).unwrap_err();
            assert!(error.to_string().contains("no block left"), "{error}");
            chains.iter_mut().for_each(|c| store.forget(c));
        }
        store.clear();
        assert!(store.append(&mut { Chain::EMPTY }, BLOCK_GAUSSIANS * store.next.len(), |_, _| {}).is_ok());
    }

    #[test]
    fn without_a_file_the_error_says_what_to_call() {
        let request = PlanRequest { max_gaussians: Some(256), scene_gaussians: Some(1000), ..PlanRequest::default() };
        let mut store = Store::new(&Plan::new(&request).unwrap());
        let error = store.append(&mut { Chain::EMPTY }, 1, |_, _| {}).unwrap_err();
        assert!(error.to_string().contains("keep_scene_in"), "{error}");
    }
}

//! A fixed number of threads that do the parts of one task at a time. Nothing is allocated after they were started.
//!
//! Which thread does a part is left to chance; a task writes disjoint places, so that its result does not depend on it.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// What the parts of a task are done by: a function of the part and of the thread's number.
type Work = dyn Fn(usize, usize) + Sync + 'static;

/// A task that threads are told of.
#[derive(Clone, Copy)]
struct Task {
    /// Lives until [`Pool::each`] returns, which waits for every thread that took it.
    work: *const Work,
    parts: usize,
}

// SAFETY: the work is `Sync`, and `Pool::each` keeps it alive for as long as any thread has it.
unsafe impl Send for Task {}

/// What the threads and their owner tell each other.
struct State {
    task: Option<Task>,
    /// Counts the tasks, so that no thread takes one twice.
    number: u64,
    /// Threads that took the present one and have not finished it.
    busy: usize,
    closing: bool,
}

struct Shared {
    state: Mutex<State>,
    started: Condvar,
    finished: Condvar,
    /// The next part that nobody has taken.
    next: AtomicUsize,
    panicked: AtomicBool,
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take_parts(&self, work: &(dyn Fn(usize, usize) + Sync), parts: usize, thread: usize) {
        loop {
            let part = self.next.fetch_add(1, Ordering::Relaxed);
            if part >= parts {
                return;
            }
            work(part, thread);
        }
    }

    /// What each thread does from its start to the pool's end.
    fn serve(&self, thread: usize) {
        let mut seen = 0;
        loop {
            let mut state = self.state();
            let Task { work, parts } = loop {
                match state.task.filter(|_| state.number != seen) {
                    _ if state.closing => return,
                    Some(task) => break task,
                    None => state = self.started.wait(state).unwrap_or_else(PoisonError::into_inner),
                }
            };
            seen = state.number;
            state.busy += 1;
            drop(state);
            // SAFETY: `Pool::each` waits until `busy` is zero before it lets go of the work.
            let work = unsafe { &*work };
            if catch_unwind(AssertUnwindSafe(|| self.take_parts(work, parts, thread))).is_err() {
                self.panicked.store(true, Ordering::Relaxed);
            }
            let mut state = self.state();
            state.busy -= 1;
            if state.busy == 0 {
                self.finished.notify_one();
            }
        }
    }
}

/// Threads that wait for tasks; they end when the pool is dropped.
pub(super) struct Pool {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.shared.state().closing = true;
        self.shared.started.notify_all();
        for thread in self.threads.drain(..) {
            // A thread catches what panics in it.
            let _ = thread.join();
        }
    }
}

impl Pool {
    /// Starts `threads` less one: the caller of [`Pool::each`] is one itself. Where the system refuses a thread, those that it granted
    /// do the work.
    pub fn new(threads: usize) -> Self {
        let state = State { task: None, number: 0, busy: 0, closing: false };
        let shared = Arc::new(Shared {
            state: Mutex::new(state),
            started: Condvar::new(),
            finished: Condvar::new(),
            next: AtomicUsize::new(0),
            panicked: AtomicBool::new(false),
        });
        let spawn = |i: usize| {
            let own = shared.clone();
            std::thread::Builder::new().name(format!("kernels-{i}")).spawn(move || own.serve(i)).ok()
        };
        Self { threads: (1..threads).map_while(spawn).collect(), shared }
    }

    /// Calls `work` once for every part below `parts`, from all threads at once, and returns when all are done.
    pub fn each(&self, parts: usize, work: impl Fn(usize) + Sync) {
        self.share_out(parts, &|part, _| work(part));
    }

    /// Calls `work` with a part and a slot, that no other part has at the same time: one below both the parts and the threads.
    pub fn each_with_slot(&self, parts: usize, work: impl Fn(usize, usize) + Sync) {
        let by_part = parts <= self.threads.len();
        self.share_out(parts, &|part, thread| work(part, if by_part { part } else { thread }));
    }

    fn share_out(&self, parts: usize, work: &(dyn Fn(usize, usize) + Sync)) {
        if self.threads.is_empty() || parts < 2 {
            (0..parts).for_each(|part| work(part, 0));
            return;
        }
        // SAFETY: only the lifetime changes; the threads are waited for below, also where this thread's share panics.
        let lasting = unsafe { std::mem::transmute::<&(dyn Fn(usize, usize) + Sync), &'static Work>(work) };
        self.shared.next.store(0, Ordering::Relaxed);
        let mut state = self.shared.state();
        state.task = Some(Task { work: lasting, parts });
        state.number += 1;
        drop(state);
        self.shared.started.notify_all();
        let own = catch_unwind(AssertUnwindSafe(|| self.shared.take_parts(work, parts, 0)));
        // A thread that has not woken by now is not waited for: the parts are all taken.
        let mut state = self.shared.state();
        state.task = None;
        while state.busy > 0 {
            state = self.shared.finished.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        drop(state);
        if let Err(panic) = own {
            resume_unwind(panic);
        }
        if self.shared.panicked.swap(false, Ordering::Relaxed) {
            resume_unwind(Box::new("a kernel panicked in another thread"));
        }
    }
}

/// A slice whose disjoint ranges several threads write.
pub(super) struct Parts<'a, T> {
    first: *mut T,
    len: usize,
    borrowed: std::marker::PhantomData<&'a mut [T]>,
}

// SAFETY: ranges are handed out by an unsafe function, whose callers see to it that none is handed out twice.
unsafe impl<T: Send> Sync for Parts<'_, T> {}

impl<'a, T> Parts<'a, T> {
    /// The parts of `whole`.
    pub fn of(whole: &'a mut [T]) -> Self {
        Self { first: whole.as_mut_ptr(), len: whole.len(), borrowed: std::marker::PhantomData }
    }

    /// `count` elements from `start` on, cut at the end.
    ///
    /// # Safety
    /// Nobody else has one of these elements for as long as the result is used.
    #[expect(clippy::mut_from_ref, reason = "the contract keeps the ranges apart")]
    pub unsafe fn range(&self, start: usize, count: usize) -> &mut [T] {
        let start = start.min(self.len);
        // SAFETY: inside the slice that this was made of, which is borrowed for as long as this lives; apart from others by contract.
        unsafe { std::slice::from_raw_parts_mut(self.first.add(start), count.min(self.len - start)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_is_done_once_by_any_number_of_threads_task_after_task() {
        for threads in [0, 1, 2, 3, 8] {
            let pool = Pool::new(threads);
            for parts in [0, 1, 2, 7, 1000] {
                let done: Vec<AtomicUsize> = (0..parts).map(|_| AtomicUsize::new(0)).collect();
                pool.each(parts, |i| {
                    done[i].fetch_add(1, Ordering::Relaxed);
                });
                assert!(done.iter().all(|n| n.load(Ordering::Relaxed) == 1), "{threads} threads, {parts} parts");
            }
        }
    }

    #[test]
    fn no_two_parts_have_a_slot_at_the_same_time_and_slots_are_no_more_than_parts_or_threads() {
        for threads in [1, 2, 3, 8] {
            let pool = Pool::new(threads);
            for parts in [1, 2, 3, 500] {
                let taken: Vec<AtomicBool> = (0..threads.min(parts)).map(|_| AtomicBool::new(false)).collect();
                pool.each_with_slot(parts, |_, slot| {
                    assert!(!taken[slot].swap(true, Ordering::SeqCst), "{threads} threads, {parts} parts");
                    std::thread::yield_now();
                    taken[slot].store(false, Ordering::SeqCst);
                });
            }
        }
    }

    #[test]
    fn a_panic_in_any_thread_reaches_the_caller_and_the_pool_goes_on() {
        let pool = Pool::new(3);
        for bad in [0, 50, 99] {
            let run = catch_unwind(AssertUnwindSafe(|| pool.each(100, |i| assert_ne!(i, bad))));
            assert!(run.is_err());
            let sum = AtomicUsize::new(0);
            pool.each(100, |i| {
                sum.fetch_add(i, Ordering::Relaxed);
            });
            assert_eq!(sum.into_inner(), 4950);
        }
    }

    #[test]
    fn parts_are_cut_at_the_end() {
        let mut whole = [0u8; 10];
        let parts = Parts::of(&mut whole);
        // SAFETY: one after the other.
        unsafe {
            parts.range(8, 4).fill(1);
            assert!(parts.range(12, 4).is_empty());
        }
        assert_eq!(whole, [0, 0, 0, 0, 0, 0, 0, 0, 1, 1]);
    }
}

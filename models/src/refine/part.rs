//! Which key frames an adjustment works on.

use std::collections::HashMap;

/// The key frames that an adjustment works on.
pub(super) struct Part {
    /// Those that move first.
    pub frames: Vec<u32>,
    /// How many.
    pub moving: usize,
    place: HashMap<u32, u32>,
}

impl Part {
    /// The first `moving` of `frames` move.
    pub fn new(frames: Vec<u32>, moving: usize) -> Self {
        let place = frames.iter().enumerate().map(|(at, f)| (*f, at as u32)).collect();
        Self { frames, moving, place }
    }

    /// All of them, and all move.
    pub fn whole(frames: usize) -> Self {
        Self { frames: (0..frames as u32).collect(), moving: frames, place: HashMap::new() }
    }

    /// Where among them a key frame is.
    pub fn at(&self, frame: u32) -> Option<u32> {
        if self.place.is_empty() { Some(frame) } else { self.place.get(&frame).copied() }
    }
}

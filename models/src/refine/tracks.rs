//! Matches of many pairs joined into tracks: one track is one point of the scene seen in several key frames.

use super::keyframe::KeyFrame;

/// Union–find over all key points ever added, with path halving. A set never holds two key points of one picture:
/// a match that would make it so is wrong, or an earlier one is, and is refused.
pub(crate) struct Union {
    parent: Vec<u32>,
    /// Next member of the same set, around in a circle.
    next: Vec<u32>,
    /// KeyFrame of each node.
    frame: Vec<u32>,
}

impl Union {
    /// Takes its memory from the system at once.
    pub fn with_capacity(nodes: usize) -> Self {
        let empty = || {
            let mut list = Vec::with_capacity(nodes);
            list.resize(nodes, 1);
            list.clear();
            list
        };
        Self { parent: empty(), next: empty(), frame: empty() }
    }

    /// Adds `count` single nodes of `frame` and returns the first.
    pub fn grow(&mut self, frame: u32, count: usize) -> u32 {
        let first = self.parent.len() as u32;
        self.parent.extend(first..first + count as u32);
        self.next.extend(first..first + count as u32);
        self.frame.extend(std::iter::repeat_n(frame, count));
        first
    }

    /// Takes back the nodes from `first` on; none of them may have been joined.
    pub fn shrink(&mut self, first: u32) {
        self.parent.truncate(first as usize);
        self.next.truncate(first as usize);
        self.frame.truncate(first as usize);
    }

    pub fn bytes(&self) -> usize {
        3 * self.parent.capacity() * size_of::<u32>()
    }

    pub fn find(&mut self, mut node: u32) -> u32 {
        while self.parent[node as usize] != node {
            let above = self.parent[self.parent[node as usize] as usize];
            self.parent[node as usize] = above;
            node = above;
        }
        node
    }

    /// Whether nothing was joined to `node`.
    pub fn is_single(&self, node: u32) -> bool {
        self.next[node as usize] == node
    }

    /// The nodes of the set of `node`, each with its key frame.
    pub fn members(&self, node: u32) -> impl Iterator<Item = (u32, u32)> + '_ {
        let after = move |at: &u32| Some(self.next[*at as usize]).filter(|next| *next != node);
        std::iter::successors(Some(node), after).map(|at| (self.frame[at as usize], at))
    }

    /// Joins the sets of `a` and `b`; false when they already hold a picture in common at different places.
    pub fn join(&mut self, a: u32, b: u32) -> bool {
        let (root_a, root_b) = (self.find(a), self.find(b));
        if root_a == root_b {
            return true;
        }
        let mut x = a;
        loop {
            let mut y = b;
            loop {
                if self.frame[x as usize] == self.frame[y as usize] {
                    return false;
                }
                y = self.next[y as usize];
                if y == b {
                    break;
                }
            }
            x = self.next[x as usize];
            if x == a {
                break;
            }
        }
        // The older node becomes the root, so that tracks keep the order in which frames came.
        self.parent[root_a.max(root_b) as usize] = root_a.min(root_b);
        self.next.swap(a as usize, b as usize);
        true
    }
}

/// One sighting of a track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sighting {
    pub frame: u32,
    pub feature: u32,
}

/// All tracks, longest first.
#[derive(Debug, Default)]
pub(crate) struct Tracks {
    starts: Vec<u32>,
    sightings: Vec<Sighting>,
    /// Sightings that did not fit under the cap.
    pub over_cap: usize,
}

impl Tracks {
    /// These, longest first; among equals in the order given.
    pub fn of(mut tracks: Vec<Vec<Sighting>>) -> Self {
        tracks.sort_by_key(|t| std::cmp::Reverse(t.len()));
        let mut out = Self { starts: vec![0], ..Self::default() };
        for track in tracks {
            out.sightings.extend(track);
            out.starts.push(out.sightings.len() as u32);
        }
        out
    }

    /// Groups the key points of `frames` by their root.
    pub fn build(union: &mut Union, frames: &[KeyFrame], max_observations: usize) -> Self {
        let nodes = union.parent.len();
        let mut size = vec![0u32; nodes];
        for node in 0..nodes as u32 {
            let root = union.find(node);
            size[root as usize] += 1;
        }
        // Where each root's sightings start, single nodes left out.
        let mut place = vec![u32::MAX; nodes];
        let mut roots: Vec<u32> = (0..nodes as u32).filter(|r| size[*r as usize] >= 2).collect();
        roots.sort_by_key(|r| (std::cmp::Reverse(size[*r as usize]), *r));
        let mut total = 0u32;
        for r in &roots {
            place[*r as usize] = total;
            total += size[*r as usize];
        }
        let mut all = vec![Sighting { frame: 0, feature: 0 }; total as usize];
        let mut next = place.clone();
        for (f, frame) in frames.iter().enumerate() {
            for feature in 0..frame.keypoints().len() as u32 {
                let root = union.find(frame.first_node + feature) as usize;
                if next[root] != u32::MAX {
                    all[next[root] as usize] = Sighting { frame: f as u32, feature };
                    next[root] += 1;
                }
            }
        }
        let mut tracks = Self { starts: vec![0], ..Self::default() };
        for r in roots {
            let from = place[r as usize] as usize;
            let track = &all[from..from + size[r as usize] as usize];
            if tracks.sightings.len() + track.len() > max_observations {
                tracks.over_cap += track.len();
            } else {
                tracks.sightings.extend_from_slice(track);
                tracks.starts.push(tracks.sightings.len() as u32);
            }
        }
        tracks
    }

    pub fn len(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    pub fn get(&self, i: usize) -> &[Sighting] {
        &self.sightings[self.starts[i] as usize..self.starts[i + 1] as usize]
    }

    /// At most `max` tracks such that every frame gets its share of long ones: first those that help a frame
    /// which still has fewer than the quota, then the longest.
    pub fn select(&self, frames: usize, max: usize) -> Vec<u32> {
        self.select_of((0..self.len() as u32).collect(), frames, max)
    }

    /// At most `max` of the tracks `among`, chosen as [`Tracks::select`] does.
    pub fn select_of(&self, among: Vec<u32>, frames: usize, max: usize) -> Vec<u32> {
        if among.len() <= max {
            return among;
        }
        // Each track has at least two sightings, so this quota can be met within half the cap.
        let quota = (max / frames.max(1)).max(1) as u32;
        let mut held = vec![0u32; frames];
        let mut out = Vec::with_capacity(max);
        let mut rest = Vec::new();
        for i in among {
            let sightings = self.get(i as usize);
            if out.len() < max && sightings.iter().any(|s| held[s.frame as usize] < quota) {
                sightings.iter().for_each(|s| held[s.frame as usize] += 1);
                out.push(i);
            } else {
                rest.push(i);
            }
        }
        rest.truncate(max - out.len());
        out.extend(rest);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_match_that_puts_two_places_of_one_picture_into_a_track_is_refused() {
        let mut u = Union::with_capacity(6);
        let (a, b, c) = (u.grow(0, 2), u.grow(1, 2), u.grow(2, 2));
        assert!(u.join(a, b) && u.join(b, c) && u.join(a, c));
        assert!(!u.join(c, a + 1), "picture 0 would be in the track twice");
        assert!(u.join(a + 1, b + 1));
        assert!(!u.join(a + 1, c));
        assert_eq!((u.find(c), u.find(b + 1)), (u.find(a), u.find(a + 1)));
    }
}

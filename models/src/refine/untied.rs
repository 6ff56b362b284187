//! Which pictures the scene is made of, and why the others are none of it.

use std::fmt;

use super::Refiner;
use super::keyframe::belongs;

/// Why a picture is not part of the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Untied {
    /// No other picture shows enough of what it shows.
    Alone,
    /// Too few points of it agree with those of others.
    Weak,
    /// Its place is known too badly: halves of what it shows put it far apart, or rays hardly cross.
    Loose,
    /// It is joined to a smaller group of pictures, which nothing joins to the scene.
    Apart,
}

impl Untied {
    /// Every reason.
    pub const ALL: [Self; 4] = [Self::Alone, Self::Weak, Self::Loose, Self::Apart];
}

impl fmt::Display for Untied {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Alone => "no other picture shows enough of what they show",
            Self::Weak => "too few of their points agree with those of others",
            Self::Loose => "what they show places them too loosely (too few points, or too little parallax)",
            Self::Apart => "they overlap each other, but not the rest",
        })
    }
}

/// The key frames that are not part of the scene, in the order they were added.
pub(super) fn untied(refiner: &Refiner) -> Vec<(&str, Untied)> {
    let n = refiner.frames.len();
    let (mut matched, mut reaches, mut with_others) = (vec![false; n], vec![false; n], vec![false; n]);
    for p in &refiner.pairs {
        let (a, b) = (p.a as usize, p.b as usize);
        for (i, other) in [(a, &refiner.frames[b]), (b, &refiner.frames[a])] {
            matched[i] = true;
            reaches[i] |= belongs(other);
            with_others[i] |= other.known.apart;
        }
    }
    let why = |i: usize| {
        let known = &refiner.frames[i].known;
        match (refiner.frames[i].tied, matched[i]) {
            _ if belongs(&refiner.frames[i]) => None,
            (true, _) if known.loose => Some(Untied::Loose),
            _ if known.apart => Some(if with_others[i] { Untied::Apart } else { Untied::Weak }),
            (_, true) => Some(if reaches[i] { Untied::Weak } else { Untied::Apart }),
            (_, false) => Some(Untied::Alone),
        }
    };
    (0..n).filter_map(|i| Some((refiner.frames[i].name.as_str(), why(i)?))).collect()
}

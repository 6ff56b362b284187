//! Which picture a name means: descriptions, splits and models name the same picture with more or fewer of its folders, and
//! with another extension where it was stored anew.

use std::borrow::Cow;
use std::collections::HashMap;

use icu_normalizer::ComposingNormalizerBorrowed;

/// Pictures by name.
#[derive(Clone, Debug, Default)]
pub struct PictureNames {
    whole: HashMap<String, usize>,
    by_stem: HashMap<String, Vec<(Vec<String>, usize)>>,
}

impl PictureNames {
    /// Of pictures numbered in this order.
    pub fn of<'a>(names: impl IntoIterator<Item = &'a str>) -> Self {
        let mut all = Self::default();
        for (i, name) in names.into_iter().enumerate() {
            let name = composed(name);
            all.whole.entry(parts(&name).join("/")).or_insert(i);
            let bare = bare(&name);
            all.by_stem.entry(bare.last().cloned().unwrap_or_default()).or_default().push((bare, i));
        }
        all
    }

    /// The picture called `name`: exactly so, else the only one whose folders, as far as both have any, and file name without
    /// its extension are those of `name`. `None` where there is none, or where it could be one of several.
    pub fn find(&self, name: &str) -> Option<usize> {
        let name = composed(name);
        if let Some(i) = self.whole.get(&parts(&name).join("/")) {
            return Some(*i);
        }
        let wanted = bare(&name);
        let alike = self.by_stem.get(wanted.last()?)?;
        let only = |fits: &dyn Fn(&[String]) -> bool| {
            let mut fitting = alike.iter().filter(|(bare, _)| fits(bare));
            let first = fitting.next()?;
            fitting.next().is_none().then_some(first.1)
        };
        only(&|bare| bare == wanted).or_else(|| only(&|bare| bare.ends_with(&wanted) || wanted.ends_with(bare)))
    }

    /// For each of `names` the picture it means; a picture that several of them could mean belongs to the one that names it
    /// exactly, else to none.
    pub fn pair<'a>(&self, names: impl IntoIterator<Item = &'a str>) -> Vec<Option<usize>> {
        let names: Vec<&str> = names.into_iter().collect();
        let mut found: Vec<Option<usize>> = names.iter().map(|name| self.find(name)).collect();
        let mut takers: HashMap<usize, Vec<usize>> = HashMap::new();
        for (k, i) in found.iter().enumerate() {
            if let Some(i) = i {
                takers.entry(*i).or_default().push(k);
            }
        }
        for (i, takers) in takers.into_iter().filter(|(_, takers)| takers.len() > 1) {
            let exact = |k: &usize| self.whole.get(&parts(&composed(names[*k])).join("/")) == Some(&i);
            let keeps = takers.iter().copied().find(exact);
            takers.iter().filter(|k| Some(**k) != keeps).for_each(|k| found[*k] = None);
        }
        found
    }
}

/// Letters with their accents in one character (NFC): Apple's file systems write two.
pub(crate) fn composed(name: &str) -> Cow<'_, str> {
    ComposingNormalizerBorrowed::new_nfc().normalize(name)
}

/// Folders and file name.
fn parts(name: &str) -> Vec<&str> {
    name.split(['/', '\\']).filter(|part| !part.is_empty() && *part != ".").collect()
}

/// Returns the name without its extension.
fn bare(name: &str) -> Vec<String> {
    let mut bare: Vec<String> = parts(name).into_iter().map(str::to_owned).collect();
    if let Some(last) = bare.last_mut()
        && let Some(end) = last.rfind('.').filter(|end| *end > 0)
    {
        last.truncate(end);
    }
    bare
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn like_names_in_two_folders_are_two_pictures() {
        let names = PictureNames::of(["train/r_0.png", "test/r_0.png", "a/DJI_1.JPG", "b/DJI_1.JPG", "b/DJI_2.JPG"]);
        let found = |name| names.find(name);
        assert_eq!((found("test/r_0.png"), found("train/r_0")), (Some(1), Some(0)));
        assert_eq!((found("r_0.png"), found("DJI_1.png")), (None, None), "either could be meant");
        assert_eq!((found("card/b/DJI_1.png"), found(r"card\a\DJI_1.JPG")), (Some(3), Some(2)));
        assert_eq!((found("DJI_2.png"), found("./b/DJI_2.JPG"), found("c/DJI_2.JPG")), (Some(4), Some(4), None));
    }

    #[test]
    fn an_accent_is_the_same_in_one_character_and_in_two() {
        let names = PictureNames::of(["H\u{f6}he/DJI_1.JPG"]);
        assert_eq!((names.find("Ho\u{308}he/DJI_1.png"), names.find("Hohe/DJI_1.JPG")), (Some(0), None));
    }

    #[test]
    fn a_picture_that_two_names_could_mean_belongs_to_the_exact_one_or_to_none() {
        let names = PictureNames::of(["r_0.png", "r_1.png"]);
        assert_eq!(names.pair(["train/r_0.png", "r_0.png", "r_1.jpg"]), [None, Some(0), Some(1)]);
        assert_eq!(names.pair(["train/r_0.png", "test/r_0.png"]), [None, None]);
    }
}

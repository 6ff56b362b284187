//! Whose turn it is: views, and among them crops where they are due.

use crate::pictures::sampler::Sampler;
use crate::pictures::{Picture, PictureStore};
use config::training::TrainSettings;

/// The order in which pictures are visited.
pub(crate) struct Turns {
    /// Its generator serves what else needs chance, too.
    pub views: Sampler,
    crops: Sampler,
}

impl Turns {
    pub fn new(seed: u64, views: usize, crops: usize) -> Self {
        Self { views: Sampler::new(seed, views), crops: Sampler::new(seed, crops) }
    }

    /// Back to the first epoch.
    pub fn restart(&mut self) {
        self.views.prefer_newest(false);
        self.views.reset();
        self.crops.reset();
    }

    /// What update `update` visits.
    pub fn next(&mut self, pictures: &PictureStore, s: &TrainSettings, update: u32, progress: f32) -> Picture {
        let (share, crops) = (s.views.residual_share, pictures.crops());
        let loss = |picture| pictures.last_loss(picture);
        if crops > 0 && s.crops.is_due(update, progress) {
            Picture::Crop(self.crops.next(crops, share, |i| loss(Picture::Crop(i))))
        } else {
            Picture::View(self.views.next(pictures.len(), share, |i| loss(Picture::View(i))))
        }
    }

    /// What [`Self::next`] will give for `update`, as far as that is known.
    pub fn peek(&self, pictures: &PictureStore, s: &TrainSettings, update: u32, progress: f32) -> Option<Picture> {
        if pictures.crops() > 0 && s.crops.is_due(update, progress) {
            self.crops.peek().map(Picture::Crop)
        } else {
            self.views.peek().map(Picture::View)
        }
    }
}

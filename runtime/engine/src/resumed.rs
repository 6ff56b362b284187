//! The model of an earlier run, which is continued.

use std::collections::HashMap;

use models::camera::View;
use models::formats::model::ModelHeader;
use models::light::PictureLight;

use super::poses::Poses;

/// What it says of its pictures; nothing where a run begins anew.
#[derive(Debug, Default)]
pub(super) struct Resumed {
    pub views: HashMap<String, View>,
    pub lights: HashMap<String, PictureLight>,
}

impl Resumed {
    pub fn of(header: ModelHeader) -> Self {
        let names = header.views.iter().map(|(name, _)| name.clone());
        Self { lights: names.zip(header.lights).collect(), views: header.views.into_iter().collect() }
    }

    /// Whether it was trained on exactly the pictures of `poses`.
    pub fn is_of(&self, poses: &Poses) -> bool {
        self.views.len() == poses.len() && poses.views().iter().all(|(name, _)| self.views.contains_key(name))
    }
}

//! Surveys: a card of pictures or another program's data set as posed pictures, what they cover, and maps of the result.

pub mod card;
pub mod coordinates;
pub mod coverage;
pub mod dataset;
pub mod names;
pub mod ortho;
mod projects;
pub mod settling;
pub mod xml;

//! What is done with the algorithms: a merge in one process ([`aggregate`]), or planned ([`planning`]) and made cell by cell
//! ([`make`]) by many machines and joined ([`join`]); and the ground station, which receives first ([`serve`]).

pub mod aggregate;
pub mod cell;
pub mod join;
pub mod make;
pub mod planning;
pub mod serve;
pub mod summary;
pub mod tally;

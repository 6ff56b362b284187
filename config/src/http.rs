//! `[http]` of the mission file: who may look at the live page.

use std::path::PathBuf;

use crate::settings::table;

table! {
    /// Who may look at the live page of `dgtr fly --http` and `dgtr serve --http`.
    pub struct HttpSettings {
        /// File of a token that a browser must show, 16 to 256 letters, digits, `-`, `.`, `_` or `~`; without one the page is only
        /// served on this machine's own addresses.
        pub token_file: Option<PathBuf> = None;
    }
}

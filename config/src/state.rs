//! Where is kept what must not go back from one start to the next: numbers of flights, time stamps of signing, orders received.
//! Keys often lie where a service may not write.

use std::path::{Path, PathBuf};

/// The state folder that the service manager gives (`STATE_DIRECTORY`, systemd.exec(5)); `beside` without one.
pub fn folder(beside: &Path) -> PathBuf {
    named(std::env::var("STATE_DIRECTORY").ok().as_deref(), beside)
}

fn named(given: Option<&str>, beside: &Path) -> PathBuf {
    // Several are separated by colons.
    let first = given.and_then(|all| all.split(':').next()).map(Path::new);
    first.filter(|p| p.is_absolute()).unwrap_or(beside).to_path_buf()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_go_where_the_service_manager_says_and_else_beside_the_keys() {
        let keys = Path::new("/etc/dgtr/keys");
        assert_eq!(named(Some("/var/lib/dgtr"), keys), Path::new("/var/lib/dgtr"));
        assert_eq!(named(Some("/var/lib/dgtr:/var/lib/other"), keys), Path::new("/var/lib/dgtr"));
        for none in [None, Some(""), Some("relative")] {
            assert_eq!(named(none, keys), keys);
        }
    }
}

//! What a person can do about what the system says of a file.

use std::fmt;
use std::io::{self, ErrorKind};

use crate::is_full;

/// What the system said and how to mend it, in one line.
#[derive(Clone, Copy, Debug)]
pub struct Told<'a>(&'a io::Error);

/// `e` and its remedy; the caller names the file.
pub fn told(e: &io::Error) -> Told<'_> {
    Told(e)
}

impl fmt::Display for Told<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)?;
        // Words of our own say it themselves.
        if self.0.get_ref().is_some() { Ok(()) } else { write!(f, "; {}", remedy(self.0)) }
    }
}

fn remedy(e: &io::Error) -> &'static str {
    match e.kind() {
        _ if is_full(e) => "make room on its disk or quota, or name another place",
        ErrorKind::ReadOnlyFilesystem => "mount its disk for writing, or name another place",
        ErrorKind::PermissionDenied => "give this user the rights to it, or name another place",
        ErrorKind::NotFound | ErrorKind::NotADirectory | ErrorKind::IsADirectory => "check the path",
        // EIO; EMFILE and ENFILE, which have no kinds of their own either.
        _ if e.raw_os_error() == Some(5) => "its medium fails: save what is there and use another",
        _ if matches!(e.raw_os_error(), Some(23 | 24)) => "raise the limit of open files (ulimit -n)",
        _ => "check the path, its permissions and the free space",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_thing_that_the_system_says_of_a_file_comes_with_its_own_remedy_in_one_line() {
        let mended = [
            (28, "make room"),
            (122, "quota"),
            (27, "make room"),
            (30, "for writing"),
            (13, "rights"),
            (2, "check the path"),
            (20, "check the path"),
            (5, "use another"),
            (24, "ulimit -n"),
            (16, "its permissions"),
        ];
        for (number, remedy) in mended {
            let e = io::Error::from_raw_os_error(number);
            let line = told(&e).to_string();
            assert!(line.starts_with(&format!("{e}; ")) && line.contains(remedy) && !line.contains('\n'), "{line}");
        }
        let own = io::Error::new(ErrorKind::PermissionDenied, "is a link; name the file it leads to");
        assert_eq!(told(&own).to_string(), own.to_string());
    }
}

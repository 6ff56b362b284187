//! Who may look: anybody on this machine, elsewhere whoever shows the token.

use std::io::Read;
use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use super::HttpError;
use super::request::Asked;

/// Characters of a token: the least that cannot be guessed, the most that fits an address.
const LENGTH: std::ops::RangeInclusive<usize> = 16..=256;
/// Bound on its file: the token and what an editor may leave around it.
const FILE_BYTES: u64 = 1024;

/// What a browser must show, as its hash: comparing two of those takes the same time wherever they differ.
#[derive(Clone)]
pub struct Token {
    hash: blake3::Hash,
    text: String,
}

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token")
    }
}

impl Token {
    /// Reads it from a file; blanks around it do not count.
    ///
    /// # Errors
    /// The file cannot be read, or what it holds is no token.
    pub fn read(path: &Path) -> Result<Self, HttpError> {
        let refused = |what: String| HttpError::Token { path: path.into(), what };
        let mut bytes = Vec::new();
        let read = disk::regular::open_secret(path).and_then(|file| file.take(FILE_BYTES).read_to_end(&mut bytes));
        read.map_err(|e| refused(disk::told(&e).to_string()))?;
        let text = std::str::from_utf8(&bytes).unwrap_or_default().trim();
        let fits = |c: char| c.is_ascii_alphanumeric() || "-._~".contains(c);
        if !LENGTH.contains(&text.len()) || !text.chars().all(fits) {
            let (least, most) = LENGTH.into_inner();
            let what = format!("must hold {least} to {most} letters, digits, `-`, `.`, `_` or `~`");
            return Err(refused(what));
        }
        Ok(Self { hash: blake3::hash(text.as_bytes()), text: text.to_owned() })
    }

    fn is(&self, shown: &str) -> bool {
        blake3::hash(shown.as_bytes()) == self.hash
    }

    /// For the cookie that stands for it.
    pub(super) fn text(&self) -> &str {
        &self.text
    }
}

/// Whether a request may be answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    Welcome,
    /// The token came with the address: the browser is told to keep it, and to ask again without.
    Keep,
    /// No token, or a wrong one.
    Stranger,
    /// On this machine, but under a name that is not this machine's: a page from elsewhere whose name leads here.
    Rebound,
}

/// Judges by the token where there is one; else by the name that this machine was called.
pub(super) fn judge(asked: &Asked, token: Option<&Token>) -> Verdict {
    match token {
        Some(token) if asked.in_address.as_deref().is_some_and(|t| token.is(t)) => Verdict::Keep,
        Some(token) if asked.shown.iter().any(|t| token.is(t)) => Verdict::Welcome,
        Some(_) => Verdict::Stranger,
        None if asked.host.as_deref().is_some_and(is_this_machine) => Verdict::Welcome,
        None => Verdict::Rebound,
    }
}

/// Whether `HOST[:PORT]` is a name of this machine that no name server is asked for.
fn is_this_machine(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => {
            let is_port = |p: &str| p.strip_prefix(':').is_some_and(|p| p.bytes().all(|b| b.is_ascii_digit()));
            rest.split_once(']').filter(|(_, port)| port.is_empty() || is_port(port)).map_or("", |r| r.0)
        }
        None => host.rsplit_once(':').map_or(host, |h| h.0),
    };
    name.eq_ignore_ascii_case("localhost") || name.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

/// The address to listen on.
///
/// # Errors
/// It is none, or it is not this machine's own and there is no token.
pub(super) fn address(text: &str, token: Option<&Token>) -> Result<SocketAddr, HttpError> {
    let numbers = text.strip_prefix("localhost:").map(|port| format!("127.0.0.1:{port}"));
    let address: SocketAddr =
        numbers.as_deref().unwrap_or(text).parse().map_err(|_| HttpError::Address(text.to_owned()))?;
    match token {
        None if !address.ip().is_loopback() => Err(HttpError::Exposed(address)),
        _ => Ok(address),
    }
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn only_names_that_nobody_else_can_give_away_are_this_machine() {
        for name in ["localhost", "LOCALHOST:80", "127.0.0.1:8080", "127.8.9.1", "[::1]:8080", "[::1]"] {
            assert!(is_this_machine(name), "{name}");
        }
        for name in [
            "",
            "evil.example",
            "localhost.evil.example:80",
            "127.0.0.1.evil.example",
            "10.0.0.2:80",
            "[::2]",
            "[::1",
            "[::1]evil.example",
            "[::1]:80:80",
        ] {
            assert!(!is_this_machine(name), "{name}");
        }
    }

    #[test]
    fn without_a_token_only_this_machines_addresses_are_listened_on() {
        for text in ["127.0.0.1:0", "[::1]:8080", "localhost:8080"] {
            assert!(address(text, None).is_ok(), "{text}");
        }
        for text in ["0.0.0.0:8080", "[::]:8080", "10.0.0.2:80", "[::ffff:127.0.0.1]:80"] {
            assert!(matches!(address(text, None), Err(HttpError::Exposed(_))), "{text}");
        }
        for text in ["8080", "localhost", "ground.local:80", "127.0.0.1", ""] {
            assert!(matches!(address(text, None), Err(HttpError::Address(_))), "{text}");
        }
    }

    #[test]
    fn a_token_is_long_enough_and_fits_an_address() {
        let dir = tempfile::tempdir().expect("tempdir");
        let read = |text: &[u8]| {
            let path = dir.path().join("token");
            std::fs::write(&path, text).expect("write");
            std::fs::set_permissions(&path, Permissions::from_mode(0o600)).expect("its own");
            Token::read(&path)
        };
        let token = read(b" 0123456789abcdef\n").expect("a token");
        assert!(token.is("0123456789abcdef") && !token.is("0123456789abcdeF") && !token.is(""));
        assert!(address("0.0.0.0:80", Some(&token)).is_ok());
        assert_eq!(format!("{token:?}"), "Token");
        for bad in [&b"short"[..], b"0123456789abcde;", b"0123456789 abcdef", &[b'a'; 257], &[0xff; 20], &[b'a'; 2000]]
        {
            assert!(matches!(read(bad), Err(HttpError::Token { .. })));
        }
        read(b"0123456789abcdef").expect("a token");
        let path = dir.path().join("token");
        std::fs::set_permissions(&path, Permissions::from_mode(0o644)).expect("its own");
        assert!(Token::read(&path).is_err_and(|e| e.to_string().contains("chmod 600")));
    }
}

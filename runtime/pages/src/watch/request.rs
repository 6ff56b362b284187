//! The head of a request, and what it asks for. There is a fixed list of what can be asked for: no path ever becomes a file's.

/// Headers of a request at most (browsers send some twenty).
const HEADERS: usize = 64;
/// Cookie and query under which the token is shown.
pub(super) const COOKIE: &str = "dgtr";
const QUERY: &str = "token";

/// What can be fetched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Route {
    /// The page.
    Page,
    /// Its style.
    Style,
    /// What draws it.
    Script,
    /// The state, once.
    State,
    /// The state, whenever it changes.
    Events,
    /// Pictures and coverage on the map.
    Ground,
    /// The small orthophoto.
    Ortho,
    /// What a flight did not cover.
    Coverage,
    /// The last key frame of an aircraft.
    Thumbnail(usize),
}

/// A request that can be understood.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Asked {
    /// What for; `None`: nothing there is.
    pub route: Option<Route>,
    /// What this machine was called.
    pub host: Option<String>,
    /// Tokens that it carries in its head.
    pub shown: Vec<String>,
    /// The token that its address carries.
    pub in_address: Option<String>,
}

/// A request that is not answered, and its status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// Not HTTP.
    Garbled,
    /// Something else than GET.
    Method,
    /// More than is read of a head.
    TooLarge,
}

/// The request whose head begins `bytes`; `None` while its end has not come.
///
/// # Errors
/// What is never answered.
pub fn parse(bytes: &[u8]) -> Result<Option<Asked>, Refusal> {
    let mut headers = [httparse::EMPTY_HEADER; HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    match request.parse(bytes) {
        Ok(httparse::Status::Partial) => return Ok(None),
        Ok(httparse::Status::Complete(_)) => {}
        Err(httparse::Error::TooManyHeaders) => return Err(Refusal::TooLarge),
        Err(_) => return Err(Refusal::Garbled),
    }
    if request.method != Some("GET") {
        return Err(Refusal::Method);
    }
    let (path, query) = request.path.map_or(("", ""), |p| p.split_once('?').unwrap_or((p, "")));
    let parameter = |name: &str| query.split('&').filter_map(|p| p.split_once('=')).find(|p| p.0 == name).map(|p| p.1);
    let route = match path {
        "/" => Some(Route::Page),
        "/page.css" => Some(Route::Style),
        "/page.js" => Some(Route::Script),
        "/state.json" => Some(Route::State),
        "/events" => Some(Route::Events),
        "/ground.json" => Some(Route::Ground),
        "/map/ortho.png" => Some(Route::Ortho),
        "/coverage.geojson" => Some(Route::Coverage),
        "/thumbnail" => parameter("of").and_then(|of| of.parse().ok()).map(Route::Thumbnail),
        _ => None,
    };
    let mut asked = Asked { route, in_address: parameter(QUERY).map(str::to_owned), ..Asked::default() };
    for header in request.headers.iter() {
        let Ok(value) = std::str::from_utf8(header.value) else { continue };
        if header.name.eq_ignore_ascii_case("host") {
            // Two names are none: whoever is in between may have believed the other.
            if asked.host.is_some() {
                return Err(Refusal::Garbled);
            }
            asked.host = Some(value.to_owned());
        } else if header.name.eq_ignore_ascii_case("authorization") {
            asked.shown.extend(value.strip_prefix("Bearer ").map(|t| t.trim().to_owned()));
        } else if header.name.eq_ignore_ascii_case("cookie") {
            let pairs = value.split(';').filter_map(|p| p.trim().split_once('='));
            asked.shown.extend(pairs.filter(|p| p.0 == COOKIE).map(|p| p.1.to_owned()));
        }
    }
    Ok(Some(asked))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(text: &str) -> Asked {
        parse(text.as_bytes()).expect("understood").expect("whole")
    }

    #[test]
    fn what_is_asked_for_and_shown_is_read_from_the_head() {
        let whole = asked(
            "GET /thumbnail?of=3&token=abc HTTP/1.1\r\nHOST: localhost:1\r\nAuthorization: Bearer xyz\r\nCookie: a=b; dgtr=uvw\r\n\r\n",
        );
        assert_eq!((whole.route, whole.host.as_deref()), (Some(Route::Thumbnail(3)), Some("localhost:1")));
        assert_eq!((whole.shown, whole.in_address.as_deref()), (vec!["xyz".into(), "uvw".into()], Some("abc")));
    }

    #[test]
    fn no_path_leads_out_of_the_list() {
        for path in
            ["/../etc/passwd", "/map/../../x", "//", "/map/ortho.tif", "/thumbnail", "/thumbnail?of=-1", "/%2e%2e/"]
        {
            assert_eq!(asked(&format!("GET {path} HTTP/1.1\r\n\r\n")).route, None, "{path}");
        }
    }

    #[test]
    fn half_a_head_is_waited_for_and_what_is_none_is_refused() {
        assert_eq!(parse(b"GET / HTTP/1.1\r\nHost: l"), Ok(None));
        assert_eq!(parse(b"POST / HTTP/1.1\r\n\r\n"), Err(Refusal::Method));
        assert_eq!(parse(b"\x16\x03\x01\x02\x00\x01\x00"), Err(Refusal::Garbled));
        assert_eq!(parse(b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n"), Err(Refusal::Garbled));
        let many = format!("GET / HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(HEADERS + 1));
        assert_eq!(parse(many.as_bytes()), Err(Refusal::TooLarge));
    }
}

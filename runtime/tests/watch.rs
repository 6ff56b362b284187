//! Promises of the live page, over real sockets.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test may

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::time::{Duration, Instant};

use geometry::geodesy::Geodetic;
use pages::report::{Craft, ReportData};
use pages::watch::{Server, Token, Watch, parse};

const PATIENCE: Duration = Duration::from_secs(20);
const TOKEN: &str = "a-token-of-32-characters-or-so~~";

fn watch(out: &Path) -> Watch {
    let origin = Geodetic { lat_deg: 47.4, lon_deg: 8.5, alt_m: 430.0 };
    let aircraft = vec![Craft::new("west", "listening"), Craft::new("east", "listening")];
    Watch::new(ReportData { title: "park".into(), aircraft, ..ReportData::default() }, out, origin)
}

fn open(at: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(at).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

/// Status line, head and body of an answer.
fn answer(mut stream: TcpStream) -> (String, String, Vec<u8>) {
    let mut all = Vec::new();
    stream.read_to_end(&mut all).expect("an answer");
    let end = all.windows(4).position(|w| w == b"\r\n\r\n").expect("a head");
    let head = String::from_utf8(all[..end].to_vec()).expect("text");
    (head.lines().next().unwrap().to_owned(), head, all[end + 4..].to_vec())
}

fn ask(at: SocketAddr, head: &str) -> (String, String, Vec<u8>) {
    let mut stream = open(at);
    stream.write_all(format!("{head}\r\n\r\n").as_bytes()).unwrap();
    answer(stream)
}

fn get(at: SocketAddr, path: &str) -> (String, String, Vec<u8>) {
    ask(at, &format!("GET {path} HTTP/1.1\r\nHost: {at}"))
}

/// Who hears of changes.
struct Listener(BufReader<TcpStream>);

impl Listener {
    fn new(at: SocketAddr) -> Self {
        let mut stream = open(at);
        stream.write_all(format!("GET /events HTTP/1.1\r\nHost: {at}\r\n\r\n").as_bytes()).unwrap();
        Self(BufReader::new(stream))
    }

    /// The next state; `None` when there are no more.
    fn next(&mut self) -> Option<serde_json::Value> {
        loop {
            let mut line = String::new();
            if self.0.read_line(&mut line).expect("a line in time") == 0 {
                return None;
            }
            if let Some(state) = line.strip_prefix("data: ") {
                return Some(serde_json::from_str(state).expect("JSON"));
            }
        }
    }
}

#[test]
fn who_listens_hears_of_a_change_and_of_the_end() {
    let dir = tempfile::tempdir().unwrap();
    let watch = watch(dir.path());
    let server = Server::start("127.0.0.1:0", None, watch.clone()).expect("listens");
    let mut listener = Listener::new(server.address());
    assert_eq!(listener.next().expect("a state")["aircraft"][1]["state"], "listening");
    watch.craft(1, |craft| craft.state = "training");
    let from = Instant::now();
    let now = listener.next().expect("a change");
    assert!(from.elapsed() < Duration::from_secs(5), "{:?}", from.elapsed());
    assert_eq!((&now["aircraft"][1]["state"], &now["over"]), (&"training".into(), &false.into()));
    drop(server);
    assert_eq!(listener.next().expect("the last state")["over"], true);
    assert_eq!(listener.next(), None);
}

#[test]
fn all_parts_of_the_page_are_there_and_nothing_else_is() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("coverage.geojson"), "{}").unwrap();
    std::fs::write(dir.path().join("model.dgtr"), "secret").unwrap();
    std::fs::create_dir(dir.path().join("map")).unwrap();
    std::fs::write(dir.path().join("map/ortho.png"), vec![7; 100_000]).unwrap();
    let watch = watch(dir.path());
    watch.craft(0, |craft| craft.thumbnail.take(&image::RgbImage::new(400, 300)));
    let server = Server::start("127.0.0.1:0", None, watch).expect("listens");
    let at = server.address();
    for (path, kind) in [
        ("/", "text/html"),
        ("/page.css", "text/css"),
        ("/page.js", "text/javascript"),
        ("/state.json", "application/json"),
        ("/ground.json", "application/json"),
        ("/map/ortho.png", "image/png"),
        ("/coverage.geojson", "application/geo+json"),
        ("/thumbnail?of=0&serial=1", "image/"),
    ] {
        let (status, head, body) = get(at, path);
        assert!(status == "HTTP/1.1 200 OK" && !body.is_empty(), "{path}: {status}");
        assert!(head.contains(&format!("Content-Type: {kind}")), "{path}: {head}");
        assert!(head.contains(&format!("Content-Length: {}", body.len())), "{path}: {head}");
        assert!(head.contains("default-src 'none'") && !head.contains("unsafe"), "{path}: {head}");
    }
    for path in
        ["/model.dgtr", "/../model.dgtr", "/map/../model.dgtr", "/map/ortho.tif", "/thumbnail?of=1", "/thumbnail?of=9"]
    {
        let (status, _, body) = get(at, path);
        assert!(status.contains("404") && !body.windows(6).any(|w| w == b"secret"), "{path}: {status}");
    }
    assert!(ask(at, &format!("POST / HTTP/1.1\r\nHost: {at}")).0.contains("405"));
    let long = format!("GET /{} HTTP/1.1\r\nHost: {at}", "a".repeat(9000));
    assert!(ask(at, &long).0.contains("431"));
}

#[test]
fn a_page_under_a_foreign_name_that_leads_here_is_not_served() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", None, watch(dir.path())).expect("listens");
    let at = server.address();
    for host in ["evil.example", "evil.example:80", "localhost.evil.example"] {
        assert!(ask(at, &format!("GET /state.json HTTP/1.1\r\nHost: {host}")).0.contains("403"), "{host}");
    }
    assert!(ask(at, "GET /state.json HTTP/1.1\r\nAccept: */*").0.contains("403"));
    assert!(ask(at, &format!("GET / HTTP/1.1\r\nHost: localhost:{}", at.port())).0.contains("200"));
}

#[test]
fn without_the_token_nothing_is_told_and_with_it_in_the_address_it_becomes_a_cookie() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("token");
    std::fs::write(&file, format!("{TOKEN}\n")).unwrap();
    std::fs::set_permissions(&file, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("its own");
    let token = Token::read(&file).expect("a token");
    let server = Server::start("127.0.0.1:0", Some(token), watch(dir.path())).expect("listens");
    let at = server.address();
    let with = |more: &str| ask(at, &format!("GET /state.json HTTP/1.1\r\nHost: {at}{more}"));
    for stranger in [
        "",
        "\r\nAuthorization: Bearer wrong",
        "\r\nAuthorization: Basic a-token-of-32-characters-or-so~~",
        "\r\nCookie: dgtr=a-token-of-32-characters-or-so~",
        "\r\nCookie: other=a-token-of-32-characters-or-so~~",
    ] {
        let (status, head, body) = with(stranger);
        assert!(status.contains("401") && !head.contains("Set-Cookie"), "{stranger}: {status}");
        assert!(!String::from_utf8_lossy(&body).contains("park"), "{stranger}");
    }
    assert!(with(&format!("\r\nAuthorization: Bearer {TOKEN}")).0.contains("200"));
    assert!(with(&format!("\r\nCookie: a=b; dgtr={TOKEN}")).0.contains("200"));
    assert!(get(at, "/?token=wrong").0.contains("401"));
    let (status, head, _) = get(at, &format!("/?token={TOKEN}"));
    assert!(status.contains("303") && head.contains("\r\nLocation: /\r\n"), "{head}");
    assert!(head.contains(&format!("Set-Cookie: dgtr={TOKEN}; HttpOnly; SameSite=Strict; Path=/")), "{head}");
}

#[test]
fn connections_that_say_nothing_starve_nobody_and_are_ended_oldest_first() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", None, watch(dir.path())).expect("listens");
    let at = server.address();
    // Half of them have said half a word.
    let mut sitting: Vec<TcpStream> = (0..100)
        .map(|i| {
            let mut stream = open(at);
            if i % 2 == 0 {
                // The oldest may be gone already.
                let _ = stream.write_all(b"GET / HT");
            }
            stream
        })
        .collect();
    for _ in 0..20 {
        assert!(get(at, "/").0.contains("200"));
    }
    sitting[0].set_read_timeout(Some(PATIENCE)).unwrap();
    assert!(matches!(sitting[0].read(&mut [0; 16]), Ok(0) | Err(_)), "the oldest has been ended");
    let newest = sitting.last_mut().unwrap();
    newest.write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut answer = [0; 12];
    newest.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 200");
}

#[test]
fn no_other_site_can_embed_what_the_page_shows() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", None, watch(dir.path())).expect("listens");
    for path in ["/", "/page.js", "/state.json", "/ground.json", "/nothing"] {
        let head = get(server.address(), path).1;
        assert!(head.contains("\r\nCross-Origin-Resource-Policy: same-origin\r\n"), "{path}: {head}");
    }
}

#[test]
fn who_hears_of_changes_leaves_room_for_the_page() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start("127.0.0.1:0", None, watch(dir.path())).expect("listens");
    let mut listeners: Vec<Listener> = (0..5).map(|_| Listener::new(server.address())).collect();
    listeners.iter_mut().for_each(|l| assert!(l.next().is_some()));
    for turn in 0..30 {
        assert!(get(server.address(), "/events").0.contains("503"), "{turn}: who is refused frees nobody's place");
    }
    assert!(get(server.address(), "/").0.contains("200"));
}

#[test]
fn who_trickles_is_cut_off_in_time_and_holds_up_neither_the_others_nor_the_job() {
    let dir = tempfile::tempdir().unwrap();
    let watch = watch(dir.path());
    let server = Server::start("127.0.0.1:0", None, watch.clone()).expect("listens");
    let at = server.address();
    let (from, mut slow) = (Instant::now(), open(at));
    let trickle = std::thread::spawn(move || {
        for byte in b"GET / HTTP/1.1\r\nX: ".iter().chain(std::iter::repeat(&b'a')) {
            if from.elapsed() > PATIENCE || slow.write_all(&[*byte]).is_err() {
                break;
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        from.elapsed()
    });
    // One that hears of changes and never reads.
    let mut deaf = open(at);
    deaf.write_all(format!("GET /events HTTP/1.1\r\nHost: {at}\r\n\r\n").as_bytes()).unwrap();
    let mut longest = Duration::ZERO;
    for i in 0..100_000u32 {
        let before = Instant::now();
        watch.craft(0, |craft| craft.plot.curve.push(f64::from(i), 1.0));
        longest = longest.max(before.elapsed());
    }
    assert!(get(at, "/").0.contains("200"));
    // Nothing was sent under the lock; a busy machine may take the thread away for a while.
    assert!(longest < Duration::from_millis(500), "{longest:?}");
    let cut_off = trickle.join().unwrap();
    assert!(cut_off < Duration::from_secs(12), "{cut_off:?}");
}

#[test]
fn an_address_that_others_reach_is_refused_without_a_token() {
    let dir = tempfile::tempdir().unwrap();
    let refused = Server::start("0.0.0.0:0", None, watch(dir.path())).expect_err("exposed");
    assert_eq!(config::error::Error::kind(&refused), config::error::ErrorKind::Input);
    assert!(refused.to_string().contains("token"), "{refused}");
}

/// 100,000 requests, each of them wrong in another way.
#[test]
fn no_garbage_makes_the_reader_of_requests_panic() {
    let seeds: [&[u8]; 4] = [
        b"GET /thumbnail?of=3&serial=9&token=abc HTTP/1.1\r\nHost: localhost:8080\r\nAuthorization: Bearer x\r\n\r\n",
        b"GET /events HTTP/1.0\r\nHost: [::1]:8080\r\nCookie: a=b; dgtr=token; c\r\nAccept: text/event-stream\r\n\r\n",
        b"POST /?a=%00&&=&token HTTP/1.1\r\nHost:\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello",
        b"GET / HTTP/1.1\nhost: a\n folded\n\n",
    ];
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut random = move |below: usize| {
        // xorshift64
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state % below as u64) as usize
    };
    let (mut whole, mut refused) = (0, 0);
    for i in 0..100_000 {
        let mut bytes = seeds[i % seeds.len()].to_vec();
        for _ in 0..=random(6) {
            let at = random(bytes.len());
            match random(4) {
                0 => bytes[at] = random(256) as u8,
                1 => drop(bytes.remove(at)),
                2 => bytes.insert(at, b"\r\n\0 :?=&%;\xff"[random(11)]),
                _ => bytes.truncate(at.max(1)),
            }
            if bytes.is_empty() {
                bytes.push(0);
            }
        }
        match parse(&bytes) {
            Ok(Some(_)) => whole += 1,
            Ok(None) => {}
            Err(_) => refused += 1,
        }
    }
    assert!(whole > 1000 && refused > 1000, "{whole} were still whole, {refused} refused");
}

//! Bad links and strangers for tests: a TCP proxy that is slow, late, lossy or cut, and certificates made anew.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Bytes that do not compress and follow from their seed.
pub fn noise(n: usize, seed: u8) -> Vec<u8> {
    let mut bytes = vec![0; n];
    blake3::Hasher::new_keyed(&[seed; 32]).finalize_xof().fill(&mut bytes);
    bytes
}

/// A model of 12,000 Gaussians in cells; `corner` is the colour of those in one corner.
pub fn write_in_cells(path: &Path, corner: f32) {
    let mut cloud = models::cloud::GaussianCloud::with_capacity(0, 12_000);
    let mut dice = Dice(7);
    for _ in 0..12_000 {
        let mut metres = |side: u64| dice.roll(side * 1000) as f32 / 1000.0;
        let place = [metres(100), metres(100), metres(4)];
        let color = if place[0] > 80.0 && place[1] > 80.0 { corner } else { metres(1) };
        cloud.push(place, [-2.0, -2.5, -3.0], [1.0, 0.0, 0.0, 0.0], 1.0, &[color; 3]);
    }
    let header = models::formats::model::ModelHeader::default();
    models::formats::model::write_rounded(&Default::default(), path, &header, &cloud, &Default::default())
        .expect("written");
}

/// Small and seeded (xorshift64).
pub struct Dice(pub u64);

impl Dice {
    /// Evenly within 0..below.
    pub fn roll(&mut self, below: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) % below
    }
}

/// How bad a link is.
#[derive(Clone, Copy)]
pub struct Weather {
    /// Bytes per second each way.
    pub rate: f64,
    /// One way.
    pub delay: Duration,
    /// Segments lost, in percent: each costs the time until TCP sends it again.
    pub loss_pct: u64,
    pub seed: u64,
}

/// Bytes at a time.
const SEGMENT: usize = 4096;
/// What a lost segment costs: TCP's least retransmission timeout (Linux).
const RETRANSMISSION: Duration = Duration::from_millis(200);

/// A TCP link between the aircraft and the ground. Dropped, it lets go of its port and its connections.
pub struct Proxy {
    pub port: u16,
    shared: Arc<Shared>,
}

struct Shared {
    weather: Weather,
    is_cut: AtomicBool,
    stop: AtomicBool,
    /// Bytes from the side that connects.
    sent: AtomicU64,
    connections: Mutex<Vec<TcpStream>>,
}

impl Proxy {
    pub fn to(ground: u16, weather: Weather) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("bind");
        listener.set_nonblocking(true).expect("non-blocking");
        let port = listener.local_addr().expect("address").port();
        let shared = Arc::new(Shared {
            weather,
            is_cut: AtomicBool::new(false),
            stop: AtomicBool::new(false),
            sent: AtomicU64::new(0),
            connections: Mutex::default(),
        });
        let state = shared.clone();
        std::thread::spawn(move || {
            while !state.stop.load(Ordering::Relaxed) {
                let Ok((near, _)) = listener.accept() else {
                    std::thread::sleep(Duration::from_millis(5));
                    continue;
                };
                let far = TcpStream::connect(SocketAddr::from(([127, 0, 0, 1], ground)));
                // Nobody there, or a cut line: the connection ends at once.
                let (Ok(far), false) = (far, state.is_cut.load(Ordering::Relaxed)) else { continue };
                for (from, to, up) in [(&near, &far, true), (&far, &near, false)] {
                    let (from, to) = (from.try_clone().expect("clone"), to.try_clone().expect("clone"));
                    let (queue, segments) = sync_channel(4096);
                    let (reading, writing) = (state.clone(), state.clone());
                    std::thread::spawn(move || read(&reading, from, &queue, up));
                    std::thread::spawn(move || write(&writing, to, &segments));
                }
                state.connections.lock().expect("lock").extend([near, far]);
            }
        });
        Self { port, shared }
    }

    /// Cuts the line, or mends it: what is under way stands still.
    pub fn cut(&self, cut: bool) {
        self.shared.is_cut.store(cut, Ordering::Relaxed);
    }

    /// Ends every connection.
    pub fn reset(&self) {
        for connection in self.shared.connections.lock().expect("lock").drain(..) {
            let _ = connection.shutdown(Shutdown::Both);
        }
    }

    /// Bytes that the aircraft sent so far.
    pub fn sent(&self) -> u64 {
        self.shared.sent.load(Ordering::Relaxed)
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.reset();
    }
}

fn read(shared: &Shared, mut from: TcpStream, queue: &SyncSender<(Instant, Vec<u8>)>, up: bool) {
    let Weather { rate, delay, loss_pct, seed } = shared.weather;
    let mut dice = Dice(seed.wrapping_mul(2) + 1 + u64::from(up));
    let mut free = Instant::now();
    let mut buffer = [0; SEGMENT];
    while let Ok(n @ 1..) = from.read(&mut buffer) {
        if up {
            shared.sent.fetch_add(n as u64, Ordering::Relaxed);
        }
        free = free.max(Instant::now()) + Duration::from_secs_f64(n as f64 / rate);
        while dice.roll(100) < loss_pct {
            free += RETRANSMISSION;
        }
        // The link is busy until then; the sender must notice.
        std::thread::sleep(free.saturating_duration_since(Instant::now()));
        if queue.send((free + delay, buffer[..n].to_vec())).is_err() {
            break;
        }
    }
}

fn write(shared: &Shared, mut to: TcpStream, segments: &Receiver<(Instant, Vec<u8>)>) {
    while let Ok((at, bytes)) = segments.recv() {
        std::thread::sleep(at.saturating_duration_since(Instant::now()));
        while shared.is_cut.load(Ordering::Relaxed) && !shared.stop.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(5));
        }
        if to.write_all(&bytes).is_err() {
            break;
        }
    }
    let _ = to.shutdown(Shutdown::Both);
}

/// A port that was free a moment ago.
pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").expect("bind").local_addr().expect("address").port()
}

/// Writes a certificate authority, once, and one certificate for `localhost` under the name `name` signed by it; returns
/// the settings that use them.
pub fn certificates(dir: &Path, name: &str) -> config::upload::TlsSettings {
    use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
    std::fs::create_dir_all(dir).expect("folder");
    let ca_path = dir.join("ca.pem");
    let ca_key_path = dir.join("ca.key");
    let mut ca = CertificateParams::new(vec![]).expect("parameters");
    ca.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let ca_key = match std::fs::read_to_string(&ca_key_path) {
        Ok(pem) => KeyPair::from_pem(&pem).expect("key"),
        Err(_) => {
            let key = KeyPair::generate().expect("key");
            std::fs::write(&ca_key_path, key.serialize_pem()).expect("write");
            std::fs::write(&ca_path, ca.self_signed(&key).expect("sign").pem()).expect("write");
            key
        }
    };
    let key = KeyPair::generate().expect("key");
    let mut own = CertificateParams::new(vec!["localhost".to_owned()]).expect("parameters");
    own.distinguished_name.push(DnType::CommonName, name);
    let signed = own.signed_by(&key, &Issuer::from_params(&ca, &ca_key)).expect("sign");
    let (certificate, key_path) = (dir.join(format!("{name}.pem")), dir.join(format!("{name}.key")));
    std::fs::write(&certificate, signed.pem()).expect("write");
    std::fs::write(&key_path, key.serialize_pem()).expect("write");
    // As it is to be kept.
    std::fs::set_permissions(&key_path, std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("its own");
    config::upload::TlsSettings { authority: ca_path, certificate, key: key_path }
}

/// Whether the name that the certificates are for is known here; an empty container may not know it.
pub fn knows_localhost() -> bool {
    let known = std::net::ToSocketAddrs::to_socket_addrs(&("localhost", 0)).is_ok();
    if !known {
        needs::missing(needs::Need::Localhost, "this machine does not know the name localhost (no /etc/hosts?)");
    }
    known
}

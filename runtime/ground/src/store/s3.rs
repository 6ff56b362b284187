//! A bucket of an object store that speaks S3 (Amazon's, MinIO, Ceph, Garage …). What names it is where their own tools look:
//! `AWS_ENDPOINT_URL`, `AWS_REGION`, `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY` and, where there is one, `AWS_SESSION_TOKEN`.

use std::time::{Duration, Instant};

use rusty_s3::actions::S3Action;
use rusty_s3::{Credentials, UrlStyle};
use ureq::http::{Response, StatusCode};
use ureq::{Agent, Body};

use super::{Fill, StoreError};

/// How long a signature holds: longer than any request takes.
const SIGNED_FOR: Duration = Duration::from_secs(3600);
/// A request that fails for a reason that may pass is made so often, with so much longer a rest each time.
const TRIES: u32 = 5;
/// One that is not answered in time is made only once more: a server that is there at all refuses or answers.
const SILENT_TRIES: u32 = 2;
const REST: Duration = Duration::from_millis(200);
const CONNECT: Duration = Duration::from_secs(10);
/// A request with its answer takes no longer than this, and a second for every so many bytes: 64 KiB/s is a slow link.
const ANSWER: Duration = Duration::from_secs(20);
const BYTES_PER_S: u64 = 64 << 10;

pub struct Bucket {
    agent: Agent,
    bucket: rusty_s3::Bucket,
    credentials: Credentials,
    /// What all names begin with.
    prefix: String,
    /// How long a request without content may take.
    limit: Duration,
}

fn agent() -> Agent {
    let config = Agent::config_builder()
        .http_status_as_error(false)
        .timeout_connect(Some(CONNECT))
        // Elsewhere there is somebody else: what is signed and sent is for the endpoint that was named.
        .max_redirects(0)
        .max_redirects_will_error(false)
        .build();
    config.into()
}

impl Bucket {
    /// `BUCKET/PREFIX` at the endpoint that the environment names.
    pub fn open(place: &str, bucket: &str) -> Result<Self, StoreError> {
        let wrong = |why: String| StoreError::Place { place: place.into(), why };
        let variable = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
        let needed = |name: &str| variable(name).ok_or_else(|| wrong(format!("the environment lacks {name}; set it")));
        let (name, prefix) = bucket.split_once('/').unwrap_or((bucket, ""));
        if name.is_empty() {
            return Err(wrong("names no bucket; give s3://BUCKET/PREFIX".into()));
        }
        let region = variable("AWS_REGION").or_else(|| variable("AWS_DEFAULT_REGION"));
        let region = region.unwrap_or_else(|| "us-east-1".into());
        // Amazon's own names its buckets by host, what one runs oneself by path.
        let (endpoint, style) = match variable("AWS_ENDPOINT_URL") {
            Some(own) => (own, UrlStyle::Path),
            None => (format!("https://s3.{region}.amazonaws.com"), UrlStyle::VirtualHost),
        };
        let url = endpoint.parse().map_err(|e| wrong(format!("AWS_ENDPOINT_URL {endpoint}: {e}")))?;
        let bucket = rusty_s3::Bucket::new(url, style, name.to_owned(), region);
        let bucket = bucket.map_err(|e| wrong(format!("{endpoint}: {e}")))?;
        let (key, secret) = (needed("AWS_ACCESS_KEY_ID")?, needed("AWS_SECRET_ACCESS_KEY")?);
        let credentials = match variable("AWS_SESSION_TOKEN") {
            Some(token) => Credentials::new_with_token(key, secret, token),
            None => Credentials::new(key, secret),
        };
        let prefix = prefix.trim_end_matches('/');
        let prefix = if prefix.is_empty() { String::new() } else { format!("{prefix}/") };
        Ok(Self { agent: agent(), bucket, credentials, prefix, limit: ANSWER })
    }

    /// How long a request that carries so many bytes may take.
    fn within(&self, bytes: u64) -> Option<Duration> {
        Some(self.limit + Duration::from_secs(bytes / BYTES_PER_S))
    }

    fn key(&self, name: &str) -> String {
        format!("{}{name}", self.prefix)
    }

    /// Makes a request until its answer is none that may pass; `read` takes the answer.
    fn ask<T>(
        &self,
        (name, action): (&str, &'static str),
        send: &dyn Fn() -> Result<Response<Body>, ureq::Error>,
        read: &dyn Fn(Response<Body>) -> Result<T, String>,
    ) -> Result<T, StoreError> {
        let (mut why, mut silent) = (String::new(), 0);
        for n in 0..TRIES {
            std::thread::sleep(REST * n);
            let asked = Instant::now();
            match send() {
                Ok(answer) if answer.status().is_server_error() => why = format!("the server says {}", answer.status()),
                Ok(answer) if answer.status().is_redirection() => {
                    why = format!(
                        "the server says {} and names another place, which is not followed; name it in AWS_ENDPOINT_URL",
                        answer.status()
                    );
                    break;
                }
                Ok(answer) => {
                    let is_refused = answer.status().is_client_error();
                    match read(answer) {
                        Ok(read) => return Ok(read),
                        Err(e) => why = e,
                    }
                    if is_refused {
                        break;
                    }
                }
                Err(e) => why = e.to_string(),
            }
            silent += u32::from(asked.elapsed() >= self.limit);
            if silent == SILENT_TRIES {
                break;
            }
        }
        let name = format!("s3://{}/{}", self.bucket.name(), self.key(name));
        Err(StoreError::Request { name, action, why })
    }

    pub fn size(&self, name: &str) -> Result<Option<u64>, StoreError> {
        let key = self.key(name);
        let send = || {
            let url = self.bucket.head_object(Some(&self.credentials), &key).sign(SIGNED_FOR);
            self.agent.head(url.as_str()).config().timeout_global(self.within(0)).build().call()
        };
        self.ask((name, "asking for it"), &send, &|answer| match answer.status() {
            StatusCode::NOT_FOUND => Ok(None),
            StatusCode::OK => {
                let length = answer.headers().get("content-length").and_then(|v| v.to_str().ok()?.parse().ok());
                length.map(Some).ok_or_else(|| "the answer has no length".to_owned())
            }
            status => Err(format!("the server says {status}")),
        })
    }

    pub fn range(&self, name: &str, from: u64, bytes: u64) -> Result<Vec<u8>, StoreError> {
        let key = self.key(name);
        let send = || {
            let url = self.bucket.get_object(Some(&self.credentials), &key).sign(SIGNED_FOR);
            let range = format!("bytes={from}-{}", from + bytes - 1);
            let question = self.agent.get(url.as_str()).header("range", range);
            question.config().timeout_global(self.within(bytes)).build().call()
        };
        let found = self.ask((name, "reading"), &send, &|mut answer| match answer.status() {
            StatusCode::NOT_FOUND => Ok(None),
            StatusCode::PARTIAL_CONTENT => {
                // One more than is wanted, so that a longer answer is seen to be one.
                let read = answer.body_mut().with_config().limit(bytes + 1).read_to_vec();
                let read = read.map_err(|e| e.to_string())?;
                match read.len() as u64 == bytes {
                    true => Ok(Some(read)),
                    false => Err(format!("{} bytes came of {bytes}", read.len())),
                }
            }
            status => Err(format!("the server says {status}")),
        })?;
        found.ok_or_else(|| StoreError::Missing(format!("s3://{}/{key}", self.bucket.name())))
    }

    pub fn put(&self, name: &str, fill: Fill<'_>) -> Result<(), StoreError> {
        let key = self.key(name);
        let mut bytes = Vec::new();
        let disk = |source| StoreError::Disk { name: key.clone(), action: "writing", source };
        fill(&mut bytes).map_err(disk)?;
        let send = || {
            let url = self.bucket.put_object(Some(&self.credentials), &key).sign(SIGNED_FOR);
            let question = self.agent.put(url.as_str()).config().timeout_global(self.within(bytes.len() as u64));
            question.build().send(&bytes[..])
        };
        self.ask((name, "writing"), &send, &|answer| match answer.status().is_success() {
            true => Ok(()),
            false => Err(format!("the server says {}", answer.status())),
        })
    }

    pub fn remove(&self, name: &str) -> Result<(), StoreError> {
        let key = self.key(name);
        let send = || {
            let url = self.bucket.delete_object(Some(&self.credentials), &key).sign(SIGNED_FOR);
            self.agent.delete(url.as_str()).config().timeout_global(self.within(0)).build().call()
        };
        self.ask((name, "removing"), &send, &|answer| match answer.status() {
            StatusCode::NOT_FOUND => Ok(()),
            status if status.is_success() => Ok(()),
            status => Err(format!("the server says {status}")),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::{SocketAddr, TcpListener, TcpStream};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    /// A server that does the same with every connection; how many there were.
    fn server(answer: impl Fn(TcpStream) + Send + 'static) -> (SocketAddr, Arc<AtomicUsize>) {
        let listener = TcpListener::bind("127.0.0.1:0").expect("listens");
        let (at, met) = (listener.local_addr().expect("bound"), Arc::new(AtomicUsize::new(0)));
        let counted = met.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                counted.fetch_add(1, Ordering::SeqCst);
                answer(stream);
            }
        });
        (at, met)
    }

    fn bucket(at: SocketAddr, limit: Duration) -> Bucket {
        let url = format!("http://{at}").parse().expect("an address");
        Bucket {
            agent: agent(),
            bucket: rusty_s3::Bucket::new(url, UrlStyle::Path, "bucket", "us-east-1").expect("a bucket"),
            credentials: Credentials::new("key", "secret"),
            prefix: String::new(),
            limit,
        }
    }

    /// The endpoint's certificate and name were checked, and what was signed for it went to whom it named.
    #[test]
    fn a_server_that_names_another_place_is_not_followed_and_nobody_there_hears_of_it() {
        let (elsewhere, met) = server(drop);
        let (at, _) = server(move |mut stream| {
            let _ = stream.read(&mut [0; 4096]);
            let head = format!(
                "HTTP/1.1 307 Temporary Redirect\r\nLocation: http://{elsewhere}/x\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
            );
            let _ = stream.write_all(head.as_bytes());
        });
        let bucket = bucket(at, ANSWER);
        let all = [
            bucket.size("cells/a").map(drop),
            bucket.range("cells/a", 0, 10).map(drop),
            bucket.put("cells/a", &|out| out.write_all(b"secret")),
            bucket.remove("cells/a"),
        ];
        for refused in all {
            let line = refused.expect_err("refused").to_string();
            assert!(line.contains("307") && line.contains("not followed"), "{line}");
        }
        assert_eq!(met.load(Ordering::SeqCst), 0, "somebody else was asked");
    }

    #[test]
    fn a_server_that_says_it_is_busy_is_asked_again() {
        let (at, met) = server(|mut stream| {
            let _ = stream.read(&mut [0; 4096]);
            let busy = "HTTP/1.1 503 Slow Down\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
            let _ = stream.write_all(busy.as_bytes());
        });
        let line = bucket(at, ANSWER).range("cells/a", 0, 10).expect_err("it stalls").to_string();
        assert!(line.contains("503"), "{line}");
        assert_eq!(met.load(Ordering::SeqCst), TRIES as usize);
    }

    #[test]
    fn a_server_that_stalls_before_or_in_its_answer_or_drips_is_given_up_after_few_tries() {
        // Servers that had held on for as long as they do.
        let waited_out = Arc::new(AtomicUsize::new(0));
        let hold = |bytes: &'static [u8], drips: bool| {
            let waited_out = waited_out.clone();
            server(move |mut stream| {
                let waited_out = waited_out.clone();
                std::thread::spawn(move || {
                    let _ = stream.read(&mut [0; 4096]);
                    let _ = stream.write_all(bytes);
                    // Longer than anybody waits.
                    for _ in 0..600 {
                        std::thread::sleep(Duration::from_millis(50));
                        if drips && stream.write_all(b"x").is_err() {
                            return;
                        }
                    }
                    waited_out.fetch_add(1, Ordering::SeqCst);
                });
            })
        };
        let half = b"HTTP/1.1 206 Partial Content\r\nContent-Length: 5000\r\n\r\nxxxxxxxxxx";
        for (begun, drips) in [(&b""[..], false), (half, false), (half, true)] {
            let (at, met) = hold(begun, drips);
            let line =
                bucket(at, Duration::from_millis(200)).range("cells/a", 0, 5000).expect_err("it stalls").to_string();
            assert!(line.contains("cells/a: reading failed") && !line.contains('\n'), "{line}");
            assert_eq!(met.load(Ordering::SeqCst), SILENT_TRIES as usize);
            assert_eq!(waited_out.load(Ordering::SeqCst), 0, "somebody waited for the server's end");
        }
    }
}

//! A ground to whose port more strangers connect than it may have descriptors.

use std::io::Read;
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use super::earlier::put_on_stick;
use super::supervised::mission;

/// Descriptors that the ground is started with, and connections that say nothing.
const DESCRIPTORS: u64 = 64;
const STRANGERS: usize = 200;

/// The port at which the process listens, once it does.
fn port_of(pid: u32) -> Option<u16> {
    let open = std::fs::read_dir(format!("/proc/{pid}/fd")).ok()?;
    let sockets: Vec<String> = open
        .flatten()
        .filter_map(|fd| std::fs::read_link(fd.path()).ok()?.to_str()?.strip_prefix("socket:[").map(str::to_owned))
        .collect();
    let listed = std::fs::read_to_string(format!("/proc/{pid}/net/tcp")).ok()?;
    listed.lines().find_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        // Its own address, its state (10 listens), its inode.
        let is_ours = words.get(3) == Some(&"0A") && sockets.contains(&format!("{}]", words.get(9)?));
        is_ours.then(|| u16::from_str_radix(words.get(1)?.split(':').nth(1)?, 16).ok()).flatten()
    })
}

fn is_closed(stranger: &mut TcpStream) -> bool {
    match stranger.read(&mut [0]) {
        Ok(n) => n == 0,
        Err(e) => e.kind() != std::io::ErrorKind::WouldBlock,
    }
}

#[test]
fn more_silent_connections_than_a_process_has_descriptors_keep_no_model_from_the_ground() {
    let dir = tempfile::tempdir().unwrap();
    let path = mission(dir.path());
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("poll_s = 0.1", "poll_s = 0.1, listen = [\"tcp/127.0.0.1:0\"], again = true"))
        .unwrap();
    let few = format!("ulimit -S -n {DESCRIPTORS} && exec \"$0\" \"$@\"");
    let mut command = Command::new("sh");
    command.args([
        "-c",
        &few,
        env!("CARGO_BIN_EXE_dgtr"),
        "serve",
        "--mission",
        &path,
        "--timeout",
        "120",
        "-q",
        "--out",
    ]);
    command.arg(dir.path().join("out"));
    let mut ground = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let (began, mut strangers, mut is_offered) = (Instant::now(), Vec::<TcpStream>::new(), false);
    let receipt = dir.path().join("upload/supervised/one/receipt");
    let mut most = 0;
    while !receipt.exists() && began.elapsed() < Duration::from_secs(60) {
        strangers.retain_mut(|stranger| !is_closed(stranger));
        if let Some(port) = port_of(ground.id()) {
            while strangers.len() < STRANGERS
                && let Ok(stranger) = TcpStream::connect(("127.0.0.1", port))
            {
                stranger.set_nonblocking(true).unwrap();
                strangers.push(stranger);
            }
        }
        most = most.max(strangers.len());
        if strangers.len() == STRANGERS && !std::mem::replace(&mut is_offered, true) {
            put_on_stick(dir.path(), [9; 32]);
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    let _ = ground.kill();
    ground.wait().unwrap();
    // It is told what became of a file that is no model.
    assert!(Path::exists(&receipt), "{most} connections, offered: {is_offered}");
    assert_eq!(most, STRANGERS);
}

//! A radio between the aircraft and the ground: connections through it end and begin as it falls silent and is heard again.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[derive(Default)]
struct State {
    is_silent: AtomicBool,
    over: AtomicBool,
    connections: Mutex<Vec<TcpStream>>,
}

impl State {
    fn hang_up(&self) {
        for connection in self.connections.lock().expect("lock").drain(..) {
            let _ = connection.shutdown(Shutdown::Both);
        }
    }
}

/// The running radio; it ends when dropped.
pub struct Radio {
    /// Where aircraft connect.
    pub port: u16,
    state: Arc<State>,
}

impl Radio {
    /// Leads to what listens at `ground` on this machine.
    pub fn to(ground: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        listener.set_nonblocking(true).expect("non-blocking");
        let (port, state) = (listener.local_addr().expect("an address").port(), Arc::new(State::default()));
        let own = state.clone();
        std::thread::spawn(move || {
            while !own.over.load(Ordering::Relaxed) {
                let Ok((near, _)) = listener.accept() else {
                    std::thread::sleep(Duration::from_millis(10));
                    continue;
                };
                let far = TcpStream::connect(("127.0.0.1", ground));
                let (Ok(far), false) = (far, own.is_silent.load(Ordering::Relaxed)) else { continue };
                near.set_nonblocking(false).expect("blocking");
                for (from, to) in [(&near, &far), (&far, &near)] {
                    let [from, to] = [from, to].map(|side| side.try_clone().expect("a second handle"));
                    std::thread::spawn(move || pass_on(from, to));
                }
                own.connections.lock().expect("lock").extend([near, far]);
            }
        });
        Self { port, state }
    }

    /// Falls silent, or is heard again.
    pub fn silence(&self, silent: bool) {
        self.state.is_silent.store(silent, Ordering::Relaxed);
        self.state.hang_up();
    }
}

impl Drop for Radio {
    fn drop(&mut self) {
        self.state.over.store(true, Ordering::Relaxed);
        self.state.hang_up();
    }
}

fn pass_on(mut from: TcpStream, mut to: TcpStream) {
    let mut buffer = [0; 4096];
    while let Ok(count @ 1..) = from.read(&mut buffer) {
        if to.write_all(&buffer[..count]).is_err() {
            break;
        }
    }
    let _ = to.shutdown(Shutdown::Both);
}

//! One vehicle and several who listen to it, each on a line of its own: what SITL's ports and MAVProxy's outputs are. Whole
//! frames are handed on, and requests for message rates are answered as ArduPilot answers them.

use std::collections::HashSet;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use hal::link::{PtyLink, SerialLink};
use hal::mavlink::dialect::{COMMAND_ACK_DATA, COMMAND_LONG_DATA, HEARTBEAT_DATA, MavCmd, MavResult};
use hal::mavlink::{Encoder, Framer};
use hal::traits::Link;

const WAIT: Duration = Duration::from_millis(1);

#[derive(Default)]
struct Heard {
    heartbeats: Vec<usize>,
    asked: HashSet<u32>,
}

/// The running hub; it ends when dropped.
pub struct Hub {
    heard: Arc<Mutex<Heard>>,
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Hub {
    /// Listeners' ports are made in `folder` at once; the vehicle's is opened when it is there.
    pub fn start(folder: &Path, vehicle: &str, listeners: &[&str]) -> Self {
        let heard = Arc::new(Mutex::new(Heard { heartbeats: vec![0; listeners.len()], ..Heard::default() }));
        let over = Arc::new(AtomicBool::new(false));
        let ports = listeners.iter().map(|name| PtyLink::create(Some(&folder.join(name))).expect("a pty")).collect();
        let (note, stop, vehicle) = (heard.clone(), over.clone(), folder.join(vehicle));
        let thread = Some(std::thread::spawn(move || serve(&vehicle, ports, &note, &stop)));
        Self { heard, over, thread }
    }

    /// Heartbeats of every listener.
    pub fn heartbeats(&self) -> Vec<usize> {
        self.heard.lock().expect("whole").heartbeats.clone()
    }

    /// Whether somebody wanted this message at a rate.
    pub fn asked_for(&self, id: u32) -> bool {
        self.heard.lock().expect("whole").asked.contains(&id)
    }
}

impl Drop for Hub {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        drop(self.thread.take().map(JoinHandle::join));
    }
}

fn serve(vehicle: &Path, mut ports: Vec<PtyLink>, heard: &Mutex<Heard>, over: &AtomicBool) {
    let mut far: Option<(SerialLink, Framer)> = None;
    let mut framers: Vec<Framer> = ports.iter().map(|_| Framer::new()).collect();
    let mut encoder = Encoder::new(1, 1);
    while !over.load(Ordering::Relaxed) {
        if far.is_none() && vehicle.exists() {
            far = SerialLink::open(vehicle, 921_600).ok().map(|link| (link, Framer::new()));
        }
        if let Some((link, framer)) = &mut far {
            match link.read(framer.space(), WAIT) {
                Ok(got) => framer.filled(got.bytes),
                // The vehicle is gone; the ports stay.
                Err(_) => std::thread::sleep(WAIT),
            }
            while let Some(frame) = framer.next_frame() {
                // A port that nobody reads, or that is full, loses what it does not take.
                ports.iter_mut().for_each(|port| drop(port.write(frame.bytes())));
            }
        }
        for (i, (port, framer)) in ports.iter_mut().zip(&mut framers).enumerate() {
            let Ok(got) = port.read(framer.space(), WAIT) else { continue };
            framer.filled(got.bytes);
            while let Some(frame) = framer.next_frame() {
                let mut heard = heard.lock().expect("whole");
                heard.heartbeats[i] += usize::from(frame.message::<HEARTBEAT_DATA>().is_some());
                if let Some(m) = frame.message::<COMMAND_LONG_DATA>()
                    && m.command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL
                {
                    heard.asked.insert(m.param1 as u32);
                    let ack = COMMAND_ACK_DATA {
                        command: m.command,
                        result: MavResult::MAV_RESULT_ACCEPTED,
                        target_system: frame.system(),
                        target_component: frame.component(),
                        ..COMMAND_ACK_DATA::default()
                    };
                    drop(port.write(encoder.encode(&ack, None)));
                }
                if let Some((link, _)) = &mut far {
                    drop(link.write(frame.bytes()));
                }
            }
        }
    }
}

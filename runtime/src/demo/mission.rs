//! The mission file of the demo: written out, so that it also serves as an example to start from.

use config::keys::PublicKey;

use super::DemoOptions;

/// A port of its own for the ground, from the ones the kernel would hand out; the demo's second run is not in the way of
/// its first.
fn free_port() -> u16 {
    let bound = std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr());
    bound.map_or(7447, |a| a.port())
}

/// The file's text, with the public keys of the ground, west and east.
pub fn text(options: &DemoOptions, [ground, west, east]: [PublicKey; 3]) -> String {
    let port = free_port();
    let DemoOptions { seconds, seed, .. } = options;
    format!(
        r#"# Two aircraft side by side over a simulated town; `dgtr init --reference` explains every setting.
name = "demo"
seed = {seed}
origin = {{ lat_deg = 47.3977, lon_deg = 8.5456, alt_m = 488.0 }}

[camera]
width = 400
height = 300
fx = 300.0
fy = 300.0
cx = 200.0
cy = 150.0
exposure_delay_ms = 60.0

[link]
battery_swap_s = 0.0

[keyframes]
t_min_m = 8.0
max = 48

[memory]
device_mib = 192
host_mib = 1024
max_gaussians = 60000

[training]
seed = {seed}
seconds = {seconds}

[upload]
encoding = "delivery"
connect = ["tcp/127.0.0.1:{port}"]
listen = ["tcp/127.0.0.1:{port}"]

[ground]
public_key = "{ground}"
device_mib = 256
seconds = 15.0

[[aircraft]]
id = "west"
public_key = "{west}"
system_id = 1
link = "serial:west/port:921600"
camera = {{ folder = "west/camera" }}
region_enu = [[-44.0, -32.0], [0.0, -32.0], [0.0, 32.0], [-44.0, 32.0]]

[[aircraft]]
id = "east"
public_key = "{east}"
system_id = 2
link = "serial:east/port:921600"
camera = {{ folder = "east/camera" }}
region_enu = [[0.0, -32.0], [44.0, -32.0], [44.0, 32.0], [0.0, 32.0]]
"#
    )
}

//! A child process that writes video to its standard output, as MJPEG or as raw RGB of the lens's size: `rpicam-vid --codec
//! mjpeg -o -`, `ffmpeg … -f rawvideo -pix_fmt rgb24 -`, `gst-launch-1.0 … ! jpegenc ! fdsink`. Which of the two shows in the
//! first bytes.

use std::io::Read;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::time::Instant;

use image::RgbImage;
use rustix::process::{Pid, Signal, kill_process_group};

use super::jpeg::JpegSplitter;
use super::picture::Picture;
use super::restart::Restart;
use crate::error::HalError;
use crate::traits::{Camera, PictureClues};

/// Pictures waiting between the pipe and us; when nobody fetches them, the newest are dropped.
const WAITING: usize = 4;

struct Grabbed {
    picture: Picture,
    at: Instant,
    number: u64,
}

/// A running camera program.
pub struct PipeCamera {
    command: Vec<String>,
    size: (u32, u32),
    child: Option<Child>,
    pictures: Receiver<Grabbed>,
    restart: Restart,
}

impl PipeCamera {
    /// Starts `command` (program and arguments); `size` is the width and height of its raw pictures.
    ///
    /// # Errors
    /// [`HalError::Camera`] when it is empty or cannot be started.
    pub fn start(command: &[String], size: (u32, u32)) -> Result<Self, HalError> {
        let (child, pictures) = spawn(command, size)?;
        Ok(Self { command: command.to_vec(), size, child: Some(child), pictures, restart: Restart::default() })
    }

    /// The program ended: says so once, and starts it again when its time has come.
    fn revive(&mut self) -> Result<(), HalError> {
        if let Some(mut child) = self.child.take() {
            // What it started and left behind holds the camera.
            end_group(&child);
            let status = child.wait().map_or_else(|e| e.to_string(), |s| s.to_string());
            self.restart.failed();
            return Err(failed(&self.command, format!("ended ({status}); it is started again")));
        }
        if self.restart.is_due() {
            let (child, pictures) = spawn(&self.command, self.size).inspect_err(|_| self.restart.failed())?;
            (self.child, self.pictures) = (Some(child), pictures);
        }
        Ok(())
    }
}

impl Drop for PipeCamera {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            // It may have ended by itself; either way it is reaped.
            end_group(child);
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Ends a program that has not been reaped yet, with all that it started: they are a group of their own.
fn end_group(child: &Child) {
    if let Some(group) = i32::try_from(child.id()).ok().and_then(Pid::from_raw) {
        // Nobody may be left in it.
        let _ = kill_process_group(group, Signal::KILL);
    }
}

fn failed(command: &[String], why: String) -> HalError {
    HalError::Camera { what: format!("program '{}'", command.join(" ")), why }
}

fn spawn(command: &[String], size: (u32, u32)) -> Result<(Child, Receiver<Grabbed>), HalError> {
    let (program, arguments) = command.split_first().ok_or_else(|| failed(command, "no program given".into()))?;
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .process_group(0)
        .spawn()
        .map_err(|e| failed(command, format!("cannot be started: {e}")))?;
    let stdout = child.stdout.take().ok_or_else(|| failed(command, "has no standard output".into()))?;
    let (sender, pictures) = sync_channel(WAITING);
    std::thread::spawn(move || grab(stdout, size, &sender));
    Ok((child, pictures))
}

/// Cuts the stream into pictures until it ends or nobody listens.
fn grab(mut stdout: impl Read, size: (u32, u32), sender: &SyncSender<Grabbed>) {
    let mut start = [0; 3];
    if stdout.read_exact(&mut start).is_err() {
        return;
    }
    let mut number = 0;
    let mut send = |picture| {
        number += 1;
        let grabbed = Grabbed { picture, at: Instant::now(), number };
        !matches!(sender.try_send(grabbed), Err(TrySendError::Disconnected(_)))
    };
    if start == [0xFF, 0xD8, 0xFF] {
        let mut splitter = JpegSplitter::default();
        splitter.push(&start);
        let mut chunk = vec![0; 1 << 16];
        while let Ok(bytes @ 1..) = stdout.read(&mut chunk) {
            splitter.push(&chunk[..bytes]);
            while let Some(jpeg) = splitter.next_jpeg() {
                if !send(Picture::Jpeg(jpeg)) {
                    return;
                }
            }
        }
    } else {
        let mut pixels = vec![0; size.0 as usize * size.1 as usize * 3];
        let mut filled = start.len().min(pixels.len());
        pixels[..filled].copy_from_slice(&start[..filled]);
        while !pixels.is_empty() && stdout.read_exact(&mut pixels[filled..]).is_ok() {
            filled = 0;
            let Some(image) = RgbImage::from_raw(size.0, size.1, pixels.clone()) else { return };
            if !send(Picture::Rgb(image)) {
                return;
            }
        }
    }
}

impl Camera for PipeCamera {
    type Picture = Picture;
    type Error = HalError;

    fn next_picture(&mut self, now_ns: u64) -> Result<Option<(PictureClues, Picture)>, HalError> {
        let grabbed = match self.pictures.try_recv() {
            Ok(grabbed) => grabbed,
            Err(TryRecvError::Empty) => return Ok(None),
            Err(TryRecvError::Disconnected) => return self.revive().map(|()| None),
        };
        self.restart.works();
        let clues = PictureClues {
            arrived_ns: now_ns.saturating_sub(grabbed.at.elapsed().as_nanos() as u64),
            number: Some(grabbed.number),
            ..PictureClues::default()
        };
        Ok(Some((clues, grabbed.picture)))
    }

    fn is_continuous(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use config::mission::CameraSettings;

    use super::*;

    /// Everything a program writes, and its last words.
    fn pictures(command: &[&str]) -> (Vec<(Option<u64>, Picture)>, String) {
        let command: Vec<String> = command.iter().map(ToString::to_string).collect();
        let mut camera = PipeCamera::start(&command, (16, 8)).expect("starts");
        let (mut pictures, until) = (Vec::new(), Instant::now() + Duration::from_secs(20));
        loop {
            assert!(Instant::now() < until, "the program does not end");
            match camera.next_picture(1_000_000_000) {
                Ok(Some((clues, picture))) => pictures.push((clues.number, picture)),
                Ok(None) => std::thread::sleep(Duration::from_millis(5)),
                Err(e) => return (pictures, e.to_string()),
            }
        }
    }

    #[test]
    fn pictures_of_a_program_arrive_and_its_end_is_reported() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.jpg");
        RgbImage::from_pixel(16, 8, image::Rgb([200, 10, 10])).save(&path).expect("saved");
        let path = path.display().to_string();
        let (pictures, end) = pictures(&["cat", &path, &path]);
        let jpeg = Picture::Jpeg(std::fs::read(&path).expect("read"));
        assert!(pictures == [(Some(1), jpeg.clone()), (Some(2), jpeg)], "{} pictures", pictures.len());
        assert!(end.contains("started again"), "{end}");
    }

    #[test]
    fn a_picture_cut_in_its_head_is_refused_in_one_line() {
        let lens = CameraSettings::pinhole(16, 8, 10.0);
        let mut jpeg = std::io::Cursor::new(Vec::new());
        RgbImage::new(16, 8).write_to(&mut jpeg, image::ImageFormat::Jpeg).expect("encoded");
        let jpeg = jpeg.into_inner();
        for n in 2..jpeg.len() {
            let refused = Picture::Jpeg(jpeg[..n].to_vec()).decode(&lens).err().map(|e| e.to_string());
            assert!(refused.as_ref().is_none_or(|line| !line.contains('\n')), "{n} bytes: {refused:?}");
        }
    }

    #[test]
    fn raw_pictures_are_cut_by_their_size_and_half_of_one_is_left_out() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.rgb");
        let bytes: Vec<u8> = (0..16 * 8 * 3 * 5 / 2).map(|i| (i % 251) as u8).collect();
        std::fs::write(&path, &bytes).expect("written");
        let (pictures, _) = pictures(&["cat", &path.display().to_string()]);
        let raw = |i: usize| RgbImage::from_raw(16, 8, bytes[i * 384..(i + 1) * 384].to_vec()).map(Picture::Rgb);
        let expected: Vec<_> = (0..2).filter_map(|i| Some((Some(i as u64 + 1), raw(i)?))).collect();
        assert!(pictures == expected, "{} pictures", pictures.len());
    }

    #[test]
    fn what_a_program_started_ends_with_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let of = |name: &str| folder.path().join(name);
        // A shell that starts another program, as wrappers of cameras do.
        let script = |n: &str, last: &str| format!("sleep 3600 >/dev/null & echo $! > {}; {last}", of(n).display());
        let started = |n: &str, last: &str| {
            let camera = PipeCamera::start(&["sh".into(), "-c".into(), script(n, last)], (16, 8)).expect("starts");
            let until = Instant::now() + Duration::from_secs(20);
            let pid = loop {
                assert!(Instant::now() < until, "nothing was started");
                if let Some(pid) = std::fs::read_to_string(of(n)).ok().and_then(|t| t.trim().parse::<i32>().ok()) {
                    break pid;
                }
                std::thread::sleep(Duration::from_millis(5));
            };
            (camera, pid)
        };
        // Where nobody reaps it, it stays as a zombie.
        let lives = |pid: i32| {
            let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
            stat.rsplit_once(") ").is_some_and(|s| !s.1.starts_with('Z'))
        };
        let ended = |pid: i32| {
            let until = Instant::now() + Duration::from_secs(20);
            while lives(pid) && Instant::now() < until {
                std::thread::sleep(Duration::from_millis(5));
            }
            !lives(pid)
        };
        let (camera, pid) = started("stopped", "wait");
        assert!(lives(pid));
        drop(camera);
        assert!(ended(pid), "it outlived the camera");
        let (mut camera, pid) = started("ended", "exit 3");
        let until = Instant::now() + Duration::from_secs(20);
        while camera.next_picture(0).is_ok() {
            assert!(Instant::now() < until, "its end is not noticed");
            std::thread::sleep(Duration::from_millis(5));
        }
        assert!(ended(pid), "it outlived its program");
    }

    #[test]
    fn a_program_that_does_not_exist_is_named() {
        let error = PipeCamera::start(&["no-such-camera".into()], (16, 8)).err().expect("missing");
        assert!(error.to_string().contains("no-such-camera"));
    }
}

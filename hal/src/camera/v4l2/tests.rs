//! A device that plays a script, and paths that are no devices.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::time::Instant;

use config::mission::{CameraSettings, CameraSource};

use super::*;
use crate::camera::AnyCamera;
use crate::error::Error;

/// One opening: the numbers of the pictures it gives, those that are damaged, and how it ends.
type Script = Vec<(u32, bool)>;

/// A picture 30 ms old for every number of the script, then `end`.
struct Scripted {
    left: VecDeque<(u32, bool)>,
    end: Errno,
}

impl Stream for Scripted {
    fn next(&mut self) -> io::Result<(&[u8], Stamp)> {
        // As slow as a camera, so that none of them finds the queue full.
        std::thread::sleep(Duration::from_millis(10));
        let (number, damaged) = self.left.pop_front().ok_or_else(|| io::Error::from(self.end))?;
        let taken = monotonic_now().checked_sub(Duration::from_millis(30));
        Ok((&[128; 16], Stamp { number, taken, damaged }))
    }

    fn picture(&self, bytes: &[u8]) -> Option<Picture> {
        yuyv::to_rgb(bytes, (4, 2), 8).map(Picture::Rgb)
    }
}

fn scripted(openings: Vec<Result<Script, Errno>>) -> V4l2Camera {
    let openings = Mutex::new(VecDeque::from(openings));
    let open = move || -> Result<Box<dyn Stream>, HalError> {
        let path = Path::new("/dev/video7");
        let next = openings.lock().expect("no panic").pop_front().unwrap_or(Err(Errno::NODEV));
        let left = next.map_err(|e| while_streaming(path, &io::Error::from(e)))?;
        Ok(Box::new(Scripted { left: left.into(), end: Errno::NODEV }))
    };
    V4l2Camera::start(Path::new("/dev/video7"), Arc::new(open)).expect("opens")
}

/// The next picture or failure.
fn next(camera: &mut V4l2Camera) -> Result<(PictureClues, Picture), HalError> {
    let until = Instant::now() + Duration::from_secs(20);
    loop {
        assert!(Instant::now() < until, "nothing comes");
        if let Some(got) = camera.next_picture(1_000_000_000)? {
            return Ok(got);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn pictures_carry_the_drivers_number_and_a_time_before_their_arrival() {
    let mut camera = scripted(vec![Ok(vec![(41, false)])]);
    let (clues, picture) = next(&mut camera).expect("a picture");
    assert_eq!(clues.number, Some(41));
    let stamped_ns = clues.stamped_ns.expect("a stamp");
    assert!(stamped_ns + 30_000_000 <= clues.arrived_ns && clues.arrived_ns <= 1_000_000_000, "{clues:?}");
    let Picture::Rgb(image) = picture else { panic!("{picture:?}") };
    assert_eq!(image.dimensions(), (4, 2));
    assert!(camera.is_continuous());
}

#[test]
fn lost_and_damaged_pictures_are_counted_by_the_drivers_numbers() {
    let mut camera = scripted(vec![Ok(vec![(0, false), (1, true), (2, false), (5, false)])]);
    let numbers: Vec<_> = (0..3).map(|_| next(&mut camera).expect("a picture").0.number).collect();
    assert_eq!(numbers, [Some(0), Some(2), Some(5)]);
    assert_eq!(camera.lost_pictures(), 3);
}

#[test]
fn an_unplugged_camera_is_reported_and_opened_again_and_counts_no_loss() {
    let mut camera = scripted(vec![Ok(vec![(70, false)]), Err(Errno::BUSY), Ok(vec![(0, false)])]);
    assert!(next(&mut camera).is_ok());
    let unplugged = next(&mut camera).expect_err("unplugged");
    assert_eq!(unplugged.kind(), ErrorKind::Closed);
    assert!(unplugged.to_string().contains("/dev/video7: was unplugged"), "{unplugged}");
    let busy = next(&mut camera).expect_err("busy");
    assert_eq!(busy.kind(), ErrorKind::Busy);
    let (clues, _) = next(&mut camera).expect("it is back");
    assert_eq!((clues.number, camera.lost_pictures()), (Some(0), 0));
}

#[test]
fn a_driver_that_breaks_the_thread_is_an_error_and_no_crash() {
    let open = || -> Result<Box<dyn Stream>, HalError> { panic!("an impossible colour space") };
    let error = V4l2Camera::start(Path::new("/dev/video7"), Arc::new(open)).err().expect("refused");
    assert!(error.to_string().contains("not understood"), "{error}");
}

fn opened(device: &str) -> HalError {
    let lens = CameraSettings::pinhole(4, 2, 4.0);
    AnyCamera::open(&CameraSource::V4l2(device.into()), &lens, None).err().expect("no camera")
}

#[test]
fn a_device_that_does_not_exist_is_named_with_the_remedy() {
    let error = opened("/dev/no-such-video");
    assert_eq!(error.kind(), ErrorKind::Invalid);
    assert!(error.to_string().starts_with("camera /dev/no-such-video: no such device; `ls /dev/video*`"), "{error}");
}

#[test]
fn a_device_that_is_no_camera_is_refused() {
    let error = opened("/dev/null");
    assert_eq!(error.kind(), ErrorKind::Invalid);
    assert!(error.to_string().contains("not a video device"), "{error}");
}

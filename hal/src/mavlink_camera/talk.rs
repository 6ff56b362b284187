//! What the camera is asked to do, and what it says.

use super::parameters::ParameterId;
use crate::mavlink::dialect::{
    CAMERA_CAPTURE_STATUS_DATA, CAMERA_IMAGE_CAPTURED_DATA, CAMERA_INFORMATION_DATA, CAMERA_SETTINGS_DATA,
    COMMAND_ACK_DATA, FILE_TRANSFER_PROTOCOL_DATA, PARAM_EXT_ACK_DATA, PARAM_EXT_VALUE_DATA, STORAGE_INFORMATION_DATA,
};

/// What the camera says about itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CameraInfo {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
}

/// Something the camera was asked to do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Request {
    /// Take one picture now; the counter of this capture.
    Capture(u32),
    /// Set a parameter to a value within its bounds; [`MavlinkCamera::answer`](super::MavlinkCamera::answer) says whether that was obeyed.
    Set(ParameterId, f32),
}

/// A message to send.
#[derive(Clone, Debug)]
pub enum Reply {
    /// COMMAND_ACK
    Ack(COMMAND_ACK_DATA),
    /// CAMERA_INFORMATION
    Information(CAMERA_INFORMATION_DATA),
    /// CAMERA_SETTINGS
    Settings(CAMERA_SETTINGS_DATA),
    /// STORAGE_INFORMATION
    Storage(STORAGE_INFORMATION_DATA),
    /// CAMERA_CAPTURE_STATUS
    Status(CAMERA_CAPTURE_STATUS_DATA),
    /// CAMERA_IMAGE_CAPTURED
    Captured(CAMERA_IMAGE_CAPTURED_DATA),
    /// FILE_TRANSFER_PROTOCOL
    File(FILE_TRANSFER_PROTOCOL_DATA),
    /// PARAM_EXT_VALUE
    Value(PARAM_EXT_VALUE_DATA),
    /// PARAM_EXT_ACK
    Set(PARAM_EXT_ACK_DATA),
}

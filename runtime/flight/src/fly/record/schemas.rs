//! The topics and their JSON schemas. Those named `foxglove.…` are Foxglove's well-known ones (docs.foxglove.dev, "schemas"), as far as
//! their fields are written here.

use serde_json::{Value, json};

/// One topic.
pub(super) struct Channel {
    pub(super) topic: &'static str,
    /// Name of its schema.
    pub(super) name: &'static str,
    pub(super) schema: fn() -> Value,
}

const fn channel(topic: &'static str, name: &'static str, schema: fn() -> Value) -> Channel {
    Channel { topic, name, schema }
}

/// All of them.
pub(super) const CHANNELS: [Channel; 7] = [
    channel("/aircraft/pose", "foxglove.PoseInFrame", pose_in_frame),
    channel("/aircraft/fix", "foxglove.LocationFix", location_fix),
    channel("/exposure", "dgtr.Exposure", exposure),
    channel("/keyframe/pose", "foxglove.PoseInFrame", pose_in_frame),
    channel("/keyframe/image", "foxglove.CompressedImage", compressed_image),
    channel("/state", "dgtr.State", state),
    channel("/log", "foxglove.Log", log),
];

fn object(title: &str, properties: Value) -> Value {
    json!({ "title": title, "type": "object", "properties": properties })
}

fn time() -> Value {
    object(
        "time",
        json!({ "sec": { "type": "integer", "minimum": 0 }, "nsec": { "type": "integer", "minimum": 0, "maximum": 999_999_999 } }),
    )
}

fn numbers(title: &str, names: &[&str]) -> Value {
    let fields = names.iter().map(|name| ((*name).to_owned(), json!({ "type": "number" })));
    object(title, Value::Object(fields.collect()))
}

fn pose_in_frame() -> Value {
    let pose = json!({
        "position": numbers("foxglove.Vector3", &["x", "y", "z"]),
        "orientation": numbers("foxglove.Quaternion", &["x", "y", "z", "w"]),
    });
    let pose = object("foxglove.Pose", pose);
    object("foxglove.PoseInFrame", json!({ "timestamp": time(), "frame_id": { "type": "string" }, "pose": pose }))
}

fn location_fix() -> Value {
    object(
        "foxglove.LocationFix",
        json!({
            "timestamp": time(),
            "frame_id": { "type": "string" },
            "latitude": { "type": "number" },
            "longitude": { "type": "number" },
            "altitude": { "type": "number" },
            "position_covariance": { "type": "array", "items": { "type": "number" }, "minItems": 9, "maxItems": 9 },
            "position_covariance_type": { "type": "integer", "minimum": 0, "maximum": 3 },
        }),
    )
}

fn compressed_image() -> Value {
    object(
        "foxglove.CompressedImage",
        json!({
            "timestamp": time(),
            "frame_id": { "type": "string" },
            "data": { "type": "string", "contentEncoding": "base64" },
            "format": { "type": "string" },
        }),
    )
}

fn log() -> Value {
    object(
        "foxglove.Log",
        json!({
            "timestamp": time(),
            "level": { "type": "integer", "minimum": 0, "maximum": 5 },
            "message": { "type": "string" },
            "name": { "type": "string" },
            "file": { "type": "string" },
            "line": { "type": "integer", "minimum": 0 },
        }),
    )
}

fn exposure() -> Value {
    object("dgtr.Exposure", json!({ "timestamp": time(), "sequence": { "type": "integer", "minimum": 0 } }))
}

fn state() -> Value {
    let count = || json!({ "type": "integer", "minimum": 0 });
    object(
        "dgtr.State",
        json!({
            "timestamp": time(),
            "state": { "type": "string" },
            "failsafe": { "type": "string" },
            "pictures": count(),
            "key_frames": count(),
            "covered_pct": count(),
            "gaussians": count(),
            "trained": { "type": "number" },
            "loss": { "type": "number" },
        }),
    )
}

//! A page that shows a scene: the model as SOG, a kept viewer (PlayCanvas' supersplat-viewer: WebGL 2, SOG, touch, and a documented
//! interface), our overlay, and pictures of the cameras, all in one file that opens by double click and asks no network for anything.
//!
//! The viewer is not ours and not in the repository: `runtime/setup.sh` fetches the version that `viewer.pin` names.

use std::io::Write;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use config::error::{Error, ErrorKind};
use engine::device::renderer;
use engine::error::EngineError;
use models::camera::View;
use models::cloud::GaussianCloud;
use models::formats::model::ModelHeader;
use models::formats::sog::{self, streamed};
use models::formats::{FormatError, write_atomic};
use models::metrics::to_rgb8;
use serde_json::{Value, json};
use vulkan::trainer::Rendering;

use crate::report::picture::data_uri;
use package::Package;

mod camera;
mod package;

/// Most cameras in a page: more are no help, and each is a rendering and 4 kB.
pub const MAX_THUMBNAILS: u16 = 48;
/// Cameras in a page where nothing is asked for.
const THUMBNAILS: u16 = 24;
/// Longest edge of their pictures, pixels.
const THUMBNAIL_EDGE: u32 = 160;

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// The viewer was never fetched.
    #[error(
        "the viewer for --to html is not there (looked at {searched}); run runtime/setup.sh --viewer, or point DGTR_VIEWER at \
         the unpacked package {name}"
    )]
    Missing {
        /// Folders that were tried.
        searched: String,
        /// Package and version.
        name: &'static str,
    },
    /// A file of another version, or one that was changed.
    #[error("{}: is not the file of {name}; delete its folder and run runtime/setup.sh --viewer", path.display())]
    Other {
        /// The file.
        path: PathBuf,
        /// Package and version.
        name: &'static str,
    },
    /// The model, or the page's file.
    #[error(transparent)]
    File(#[from] FormatError),
    /// The pictures of the cameras.
    #[error("pictures of the cameras: {0} (--thumbnails 0 leaves them out)")]
    Pictures(#[from] EngineError),
}

impl Error for ViewerError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Missing { .. } | Self::Other { .. } => ErrorKind::Device,
            Self::File(e) => e.kind(),
            Self::Pictures(e) => e.kind(),
        }
    }
}

/// What a page should hold.
#[derive(Clone, Copy, Debug, Default)]
pub struct ViewerRequest<'a> {
    /// How many cameras to jump to; `None`: 24.
    pub thumbnails: Option<u16>,
    /// Vulkan device, for their pictures, whose name contains this.
    pub device: Option<&'a str>,
}

/// Writes the page of a scene.
///
/// # Errors
/// No viewer, a cloud that SOG does not hold, no Vulkan device for the pictures, the disk.
pub fn write(
    path: &Path,
    header: &ModelHeader,
    cloud: &GaussianCloud,
    request: &ViewerRequest<'_>,
) -> Result<(), ViewerError> {
    let package = Package::find()?;
    let sog = sog::encode(path, cloud)?;
    let most = usize::from(request.thumbnails.unwrap_or(THUMBNAILS));
    let views = evenly(&header.views, most);
    let pictures = pictures(cloud, &views, request.device)?;
    let scene = json!({ "shift": sog.shift, "pictures": pictures, "settings": settings(cloud, &views) });
    page(path, &title_of(header, path), header, &package, &scene, &STANDARD.encode(&sog.bytes))
}

/// Writes the page of a scene in levels of detail into its folder, as `index.html`; `coarsest` is its coarsest level. To be opened
/// over HTTP: a page from a file may not fetch what lies beside it.
///
/// # Errors
/// No viewer, the disk.
pub fn write_streamed(
    folder: &Path,
    header: &ModelHeader,
    coarsest: &GaussianCloud,
    shift: [f32; 3],
) -> Result<PathBuf, ViewerError> {
    let package = Package::find()?;
    let path = folder.join("index.html");
    let settings = settings(coarsest, &[]);
    let scene = json!({ "shift": shift, "pictures": [], "settings": settings, "streamed": streamed::INDEX });
    page(&path, &title_of(header, folder), header, &package, &scene, "")?;
    Ok(path)
}

/// The mission's name, or that of what is written.
fn title_of(header: &ModelHeader, path: &Path) -> String {
    let name = path.file_stem().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    escape(if header.mission.is_empty() { &name } else { &header.mission })
}

/// Fills the page; `sog` is base64.
fn page(
    path: &Path,
    title: &str,
    header: &ModelHeader,
    package: &Package,
    scene: &Value,
    sog: &str,
) -> Result<(), ViewerError> {
    let place = match header.origin {
        Some(o) => format!("origin {:.6}°, {:.6}°, {:.1} m", o.lat_deg, o.lon_deg, o.alt_m),
        None => "in the scene's own metres".to_owned(),
    };
    // "</script>" in a name would end the block.
    let scene = scene.to_string().replace('<', "\\u003c");
    let part = |name| match name {
        "title" => Some(title),
        "place" => Some(place.as_str()),
        "scene" => Some(scene.as_str()),
        "sog" => Some(sog),
        "viewer.js" => Some(package.script.as_str()),
        "viewer.css" => Some(package.style.as_str()),
        "licence" => Some(package.licence.as_str()),
        "splats.js" => Some(include_str!("viewer/splats.js")),
        "overlay.js" => Some(include_str!("viewer/overlay.js")),
        _ => None,
    };
    Ok(write_atomic(path, |out| fill(out, include_str!("viewer/page.html"), part))?)
}

/// Writes `page` with each `{{name}}` replaced.
fn fill<'a>(out: &mut dyn Write, page: &'a str, part: impl Fn(&'a str) -> Option<&'a str>) -> std::io::Result<()> {
    let mut rest = page;
    while let Some((before, after)) = rest.split_once("{{") {
        let (name, after) = after.split_once("}}").unwrap_or((after, ""));
        out.write_all(before.as_bytes())?;
        let text = part(name).ok_or_else(|| std::io::Error::other(format!("the page has no part {name:?}")))?;
        out.write_all(text.as_bytes())?;
        rest = after;
    }
    out.write_all(rest.as_bytes())
}

/// The viewer's settings: where it starts, and a place to jump to per camera.
fn settings(cloud: &GaussianCloud, views: &[(&str, View)]) -> Value {
    let [position, target] = camera::overview(cloud);
    let annotations: Vec<Value> = views
        .iter()
        .map(|(name, view)| {
            let stand = camera::stand(view, cloud);
            json!({ "position": stand.target, "title": name, "text": "", "extras": null, "camera": { "initial": stand } })
        })
        .collect();
    json!({
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": false,
        "background": { "color": [0.4, 0.4, 0.4] },
        "postEffectSettings": {
            "sharpness": { "enabled": false, "amount": 0 },
            "bloom": { "enabled": false, "intensity": 1, "blurLevel": 2 },
            "grading": { "enabled": false, "brightness": 0, "contrast": 1, "saturation": 1, "tint": [1, 1, 1] },
            "vignette": { "enabled": false, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1 },
            "fringing": { "enabled": false, "intensity": 0.5 },
        },
        "animTracks": [],
        "cameras": [{ "initial": { "position": position, "target": target, "fov": camera::OVERVIEW_FOV_DEG } }],
        "annotations": annotations,
        "startMode": "default",
    })
}

/// At most `most` of the views, as far apart in the flight as they go.
fn evenly(views: &[(String, View)], most: usize) -> Vec<(&str, View)> {
    let n = most.min(views.len());
    (0..n).map(|i| &views[i * views.len() / n]).map(|(name, view)| (name.as_str(), *view)).collect()
}

/// What each of the views sees, as data URIs.
fn pictures(cloud: &GaussianCloud, views: &[(&str, View)], device: Option<&str>) -> Result<Vec<String>, EngineError> {
    let small: Vec<View> = views
        .iter()
        .map(|(_, view)| {
            let k = &view.intrinsics;
            let scale = f64::from(THUMBNAIL_EDGE) / f64::from(k.width.max(k.height));
            let size = |v: u32| ((f64::from(v) * scale).round() as u32).max(1);
            View { intrinsics: k.resized(size(k.width), size(k.height)), pose: view.pose }
        })
        .collect();
    if small.is_empty() {
        return Ok(Vec::new());
    }
    let mut trainer = renderer(device, cloud, THUMBNAIL_EDGE, THUMBNAIL_EDGE)?;
    let mut rendering = Rendering::default();
    let mut uris = Vec::with_capacity(small.len());
    for (view, (name, _)) in small.iter().zip(views) {
        trainer.render(view, &mut rendering)?;
        let picture = to_rgb8(&rendering.rgb, rendering.width, rendering.height)
            .ok_or_else(|| EngineError::RenderingSize((*name).to_owned()))?;
        let encode = |source| EngineError::Encode { path: (*name).into(), source };
        uris.push(data_uri(&picture).map_err(encode)?);
    }
    Ok(uris)
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_are_chosen_evenly_and_never_more_than_there_are() {
        let view = |i: u32| {
            let intrinsics = models::camera::Intrinsics { width: 4, height: 3, fx: 4.0, fy: 4.0, cx: 2.0, cy: 1.5 };
            let pose = models::camera::Pose { rotation: Default::default(), center: Default::default() };
            (i.to_string(), View { intrinsics, pose })
        };
        let views: Vec<_> = (0..10).map(view).collect();
        let names = |n| evenly(&views, n).iter().map(|v| v.0.parse().expect("a number")).collect::<Vec<u32>>();
        assert_eq!(names(5), [0, 2, 4, 6, 8]);
        assert_eq!(names(99).len(), 10);
        assert!(names(0).is_empty() && evenly(&[], 5).is_empty());
    }

    #[test]
    fn parts_go_where_the_page_names_them_and_are_not_searched_for_names() {
        let mut page = Vec::new();
        fill(&mut page, "a {{x}} b {{y}}", |n| Some(if n == "x" { "{{y}}" } else { "2" })).expect("written");
        assert_eq!(String::from_utf8_lossy(&page), "a {{y}} b 2");
        assert!(fill(&mut Vec::new(), "{{z}}", |_| None).is_err());
    }
}

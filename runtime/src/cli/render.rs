//! `dgtr render MODEL --cameras FILE --out DIR`: colour and depth of any cameras.

use std::path::{Path, PathBuf};

use engine::device::file_renderer;
use engine::evaluate::save_png;
use engine::{renderings, tiles};
use image::{ImageBuffer, Luma};
use job::console;
use job::interrupt;
use models::camera::View;
use models::formats::reconstruction::Shot;
use models::formats::{FormatError, model, transforms, write_atomic};
use models::metrics::to_rgb8;
use vulkan::trainer::Rendering;

use super::CliError;

/// Where less than this share of a pixel is covered, it has no depth.
const LEAST_COVER: f32 = 0.5;

/// Arguments of `dgtr render`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The .dgtr model.
    pub model: PathBuf,
    /// Cameras as a transforms.json of nerfstudio (the pictures it names need not exist).
    #[arg(long)]
    pub cameras: PathBuf,
    /// Where to write NAME.png (colour) and NAME_depth.png (16 bit), in folders where the cameras' pictures lie in several.
    #[arg(long)]
    pub out: PathBuf,
    /// Metres per unit of the depth pictures; 0 means nothing is there, 65535 this far or farther.
    #[arg(long, default_value_t = 0.01)]
    pub depth_unit: f32,
    /// Device whose name contains this: processor, or a Vulkan device.
    #[arg(long)]
    pub device: Option<String>,
}

/// Runs `dgtr render`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    if !(args.depth_unit > 0.0 && args.depth_unit.is_finite()) {
        return Err(CliError::input(format!("--depth-unit {} must be a positive number of metres", args.depth_unit)));
    }
    let mut cameras = transforms::read(&args.cameras)?;
    if let Some(local) = model::read_header(&args.model)?.0.local {
        cameras.shots.iter_mut().for_each(|shot| shot.pose.center = local.into_own(shot.pose.center));
    }
    let views: Vec<(String, View)> =
        cameras.shots.iter().map(|s| Ok((s.path.clone(), view(&args.cameras, s)?))).collect::<Result<_, CliError>>()?;
    let bent = cameras.shots.iter().filter(|s| !s.lens.distortion.is_none()).count();
    if bent > 0 {
        tracing::info!(
            "{bent} cameras have a distorted lens; their pictures are rendered as training saw them, undistorted"
        );
    }
    let names: Vec<&str> = views.iter().map(|v| v.0.as_str()).collect();
    let files = renderings::places(&names, &[".png", "_depth.png"])?;
    let width = views.iter().map(|v| v.1.intrinsics.width).max().unwrap_or(1);
    let height = views.iter().map(|v| v.1.intrinsics.height).max().unwrap_or(1);
    let (_, mut trainer) = file_renderer(args.device.as_deref(), &args.model, tiles::size((width, height)))?;
    let stop = interrupt::Interrupt::install()?;
    let mut progress = console::Progress::new("rendering", views.len() as u64);
    let mut rendering = Rendering::default();
    for (i, (name, view)) in views.iter().enumerate() {
        if stop.requested() {
            return Err(CliError::interrupted(format!(
                "stopped after {i} of {} pictures in {}",
                views.len(),
                args.out.display()
            )));
        }
        tiles::render(&mut trainer, view, &mut rendering)?;
        let Some(color) = to_rgb8(&rendering.rgb, rendering.width, rendering.height) else {
            return Err(CliError::failed(format!("{name}: the rendering has another size than its camera")));
        };
        save_png(&color, &args.out.join(&files[i][0]))?;
        save_depth(&rendering, args.depth_unit, &args.out.join(&files[i][1]))?;
        progress.set(i as u64 + 1, || name.clone());
    }
    progress.finish(&format!("{} pictures in {}", views.len(), args.out.display()));
    Ok(())
}

fn view(file: &Path, shot: &Shot) -> Result<View, CliError> {
    let bad = |what: &str| {
        CliError::from(FormatError::Invalid { path: file.to_owned(), what: format!("frame {:?}: {what}", shot.path) })
    };
    let Some(size) = shot.lens.size else { return Err(bad("w and h are needed")) };
    Ok(View { intrinsics: shot.lens.intrinsics(size), pose: shot.pose })
}

/// Alpha-blended depth divided by cover, in units of `unit` metres.
fn save_depth(rendering: &Rendering, unit: f32, path: &Path) -> Result<(), CliError> {
    let values = rendering.depth.iter().zip(&rendering.transmittance).map(|(d, t)| {
        let cover = 1.0 - t;
        if cover < LEAST_COVER { 0 } else { (d / cover / unit).round().clamp(1.0, 65_535.0) as u16 }
    });
    let picture: Option<ImageBuffer<Luma<u16>, Vec<u16>>> =
        ImageBuffer::from_raw(rendering.width, rendering.height, values.collect());
    let bad = |what: String| CliError::failed(format!("{}: {what}", path.display()));
    let picture = picture.ok_or_else(|| bad("the rendering has another size than its camera".to_owned()))?;
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, image::ImageFormat::Png).map_err(|e| bad(format!("cannot be encoded: {e}")))?;
    Ok(write_atomic(path, |out| out.write_all(bytes.get_ref()))?)
}

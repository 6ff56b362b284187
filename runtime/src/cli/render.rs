//! `dgtr render MODEL --cameras FILE --out DIR`: colour and depth of any cameras.

use std::path::{Path, PathBuf};

use engine::device::file_renderer;
use engine::evaluate::save_png;
use image::{ImageBuffer, Luma};
use job::console;
use job::interrupt;
use models::camera::View;
use models::formats::reconstruction::Shot;
use models::formats::{FormatError, transforms, write_atomic};
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
    /// Where to write <stem>.png (colour) and <stem>_depth.png (16 bit).
    #[arg(long)]
    pub out: PathBuf,
    /// Metres per unit of the depth pictures; 0 means nothing is there, 65535 this far or farther.
    #[arg(long, default_value_t = 0.01)]
    pub depth_unit: f32,
    /// Vulkan device whose name contains this.
    #[arg(long)]
    pub device: Option<String>,
}

/// What a camera's picture is called in the output folder.
///
/// # Errors
/// The camera's name ends in no file name, and would lead out of the folder.
fn picture_name(cameras: &Path, name: &str) -> Result<String, CliError> {
    let file = Path::new(name).file_stem().map(|s| s.to_string_lossy().into_owned());
    file.ok_or_else(|| {
        let said = format!("{name:?} is no name of a picture; end file_path in one, such as images/0001.jpg");
        CliError::input(format!("{}: {said}", cameras.display()))
    })
}

/// Runs `dgtr render`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    if !(args.depth_unit > 0.0 && args.depth_unit.is_finite()) {
        return Err(CliError::input(format!("--depth-unit {} must be a positive number of metres", args.depth_unit)));
    }
    let cameras = transforms::read(&args.cameras)?;
    let views: Vec<(String, View)> = cameras
        .shots
        .iter()
        .map(|s| Ok((picture_name(&args.cameras, &s.path)?, view(&args.cameras, s)?)))
        .collect::<Result<_, CliError>>()?;
    let width = views.iter().map(|v| v.1.intrinsics.width).max().unwrap_or(1);
    let height = views.iter().map(|v| v.1.intrinsics.height).max().unwrap_or(1);
    let (_, mut trainer) = file_renderer(args.device.as_deref(), &args.model, (width, height))?;
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
        trainer.render(view, &mut rendering)?;
        let Some(color) = to_rgb8(&rendering.rgb, rendering.width, rendering.height) else {
            return Err(CliError::failed(format!("{name}: the rendering has another size than its camera")));
        };
        save_png(&color, &args.out.join(format!("{name}.png")))?;
        save_depth(&rendering, args.depth_unit, &args.out.join(format!("{name}_depth.png")))?;
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
    if !shot.lens.distortion.is_none() {
        return Err(bad("only pinhole cameras can be rendered; leave k1, k2, p1, p2 out"));
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_name_of_a_camera_leads_out_of_the_output_folder() {
        let named = |name| picture_name(Path::new("cameras.json"), name).ok();
        assert_eq!(named("/etc/images/0001.jpg").as_deref(), Some("0001"));
        assert_eq!(named("../../a").as_deref(), Some("a"));
        for out in ["../../up/..", "/tmp/esc/..", "..", "/", ""] {
            assert_eq!(named(out), None, "{out}");
        }
    }
}

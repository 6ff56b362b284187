//! What the host and the kernels share, by name: the uniform block, the push constants, the status words and the partial
//! sums. The declarations here are the only ones: `shaders/layout.glsl` is generated from them (`DGTR_BLESS=1 cargo test
//! -p vulkan` remakes it and the SPIR-V), and a test compares the two.

use config::plan::{LANE_SUM_BYTES, Lanes, STATUS_BYTES};

/// Missed steps that the table of lazy Adam updates covers; no Gaussian is left behind for longer.
pub(crate) const DEFERRED_STEPS: usize = 512;
/// Cursors in the status section: the largest number of sorting lanes.
const CURSORS: usize = Lanes::CARD.sort as usize;

/// In place of a confidence: the pixel is left out of every comparison (`LEFT_OUT` of the shaders' frame.glsl). Confidences are
/// 0 or above it.
pub(crate) const LEFT_OUT: u8 = 1;

/// A section's place in the arena, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Section {
    pub offset: u64,
    pub bytes: u64,
}

/// A type that both languages have.
trait Glsl {
    /// What a block's fields of this type must be aligned to.
    const ALIGNMENT: usize;
    /// The declaration of a field `name`.
    #[cfg(test)]
    fn declare(name: &str) -> String;
}

macro_rules! glsl_types {
    ($($type:ty: $glsl:literal $array:literal, $alignment:literal;)*) => {
        $(impl Glsl for $type {
            const ALIGNMENT: usize = $alignment;
            #[cfg(test)]
            fn declare(name: &str) -> String {
                format!(concat!($glsl, " {}", $array), name)
            }
        })*
    };
}

glsl_types! {
    u32: "uint" "", 4;
    i32: "int" "", 4;
    f32: "float" "", 4;
    [f32; 2]: "vec2" "", 8;
    [u32; 2]: "uvec2" "", 8;
    [f32; 3]: "vec3" "", 16;
    [[f32; 4]; 3]: "vec4" "[3]", 16;
    [u32; CURSORS]: "uint" "[256]", 4;
    [WalkCursor; CURSORS]: "WalkCursor" "[256]", 4;
    [MissedSteps; DEFERRED_STEPS]: "MissedSteps" "[512]", 16;
}

/// Declares structs for Rust, and what the generator needs to declare them for GLSL. A field lies at the same offset in
/// both when it begins at a multiple of its alignment in GLSL, which is checked at compile time.
macro_rules! layout {
    ($($(#[doc = $about:literal])* $name:ident { $($(#[doc = $doc:literal])* $field:ident: $type:ty,)* })*) => {
        $(
            $(#[doc = $about])*
            #[repr(C)]
            #[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
            pub(crate) struct $name { $($(#[doc = $doc])* pub $field: $type,)* }

            $(const _: () = {
                let offset = std::mem::offset_of!($name, $field);
                assert!(offset.is_multiple_of(<$type as Glsl>::ALIGNMENT), concat!(stringify!($field), " is not aligned"));
            };)*

            #[cfg(test)]
            impl $name {
                fn glsl() -> String {
                    let mut text = String::new();
                    $($(text += &format!("    //{}\n", $doc);)*
                    text += &format!("    {};\n", <$type as Glsl>::declare(stringify!($field)));)*
                    text
                }
            }
        )*
    };
}

layout! {
    /// What k missed steps of lazy Adam amount to (`trainer::deferred`).
    MissedSteps {
        /// Sum of the means' steps, in units of m/√v.
        mean: f32,
        /// Sum of steps at rate one.
        unit: f32,
        /// beta1^k.
        first_decay: f32,
        /// beta2^k.
        second_decay: f32,
    }

    /// The constants of a step, one uniform block for every kernel.
    Frame {
        /// What never changes in a run comes first: where a kernel branches on a push constant, lavapipe (Mesa 22.3) takes
        /// the words of this block at the same offset for constants too, and compiles and keeps one more kernel for each
        /// new value of theirs. With the camera there, that was a kernel and 0.2 MiB per step (tests/compiles_once.rs).
        beta1: f32,
        beta2: f32,
        epsilon: f32,
        /// Scale of moments in 16 bits.
        moment_scale: f32,
        /// World → camera: rows of the rotation, translation in w.
        view_rows: [[f32; 4]; 3],
        /// fx, fy, pixels.
        focal: [f32; 2],
        principal_point: [f32; 2],
        /// In the world.
        camera_center: [f32; 3],
        /// Nearest depth that is drawn.
        near: f32,
        /// Bounds of x/z and y/z in the Jacobian.
        min_ratio: [f32; 2],
        max_ratio: [f32; 2],
        /// The picture, pixels.
        size: [u32; 2],
        /// The rendered window, tiles.
        window: [u32; 2],
        /// Its first pixel.
        region_origin: [u32; 2],
        /// Its pixels, cut at the picture's edge.
        region: [u32; 2],
        gaussians: u32,
        /// Highest SH degree that is evaluated in this step.
        sh_degree: u32,
        /// FLAG_…
        flags: u32,
        /// The picture is reduced by this factor.
        divisor: u32,
        background: [f32; 3],
        /// Share of Gaussians left out (DropGaussian).
        drop_share: f32,
        exposure_gain: [f32; 3],
        /// Least confidence of the depth prior that counts.
        min_confidence: f32,
        exposure_offset: [f32; 3],
        /// Weight of the depth loss.
        depth_weight: f32,
        mean_rate: f32,
        log_scale_rate: f32,
        rotation_rate: f32,
        opacity_rate: f32,
        /// SH degree 0.
        sh_dc_rate: f32,
        /// SH above.
        sh_rest_rate: f32,
        /// Noise on means, world units, and its bound.
        noise: f32,
        max_noise: f32,
        /// decay / (1 - beta1^t).
        first_bias: f32,
        /// 1 / (1 - beta2^t).
        second_bias: f32,
        /// t, from 1.
        step: u32,
        seed: u32,
        /// Weight of L1 over 3 * pixels.
        l1_weight: f32,
        /// Weight of SSIM over 3 * pixels.
        ssim_weight: f32,
        /// The view's full width.
        source_width: u32,
        /// u32 offset of the view's depth prior; 0: none.
        depth_offset: u32,
        /// Weight of the mean entropy of the opacities in view.
        entropy_weight: f32,
        /// Weight of the magnitude of each SH coefficient above degree 0.
        sh_weight: f32,
        unused_0: u32,
        unused_1: u32,
        /// By the number of steps missed.
        deferred: [MissedSteps; DEFERRED_STEPS],
    }

    /// What a kernel is told besides the frame.
    Push {
        /// First tile of the band, or first pixel of a part of a picture.
        first: u32,
        /// One past its last tile.
        last: u32,
        mode: u32,
        pass: u32,
    }

    /// Where a sorting lane goes on in the next round of counting or emitting (`shaders/walk.glsl`).
    WalkCursor {
        /// In depth order.
        gaussian: u32,
        /// Row of tiles to go on with; -1 at the start of a Gaussian.
        row: i32,
        /// Next gradient slot.
        slot: u32,
        /// First gradient slot of the present Gaussian.
        first_slot: u32,
    }

    /// What kernels tell each other and the host.
    Status {
        /// Gaussians in view.
        visible: u32,
        /// Gaussian-tile instances, 2^32 - 1 when there are more.
        instances: u32,
        /// Pearson's correlation of rendered depth and prior.
        correlation: f32,
        /// 1 when it says something.
        correlates: u32,
        /// dL/d(depth) = depth_by_prior * prior + depth_by_rendered * depth + depth_constant.
        depth_by_prior: f32,
        depth_by_rendered: f32,
        depth_constant: f32,
        /// Instances of each sorting lane's share.
        lane_instances: [u32; CURSORS],
        /// 1 when the lane has counted its share to the end.
        lane_counted: [u32; CURSORS],
        cursors: [WalkCursor; CURSORS],
    }

    /// Moments of rendered depth D and prior E over a lane's pixels (Welford).
    DepthMoments {
        count: f32,
        mean_d: f32,
        mean_e: f32,
        /// Sums of (D - mean)², (E - mean)² and their product.
        square_d: f32,
        square_e: f32,
        product: f32,
        unused_0: f32,
        unused_1: f32,
    }

    /// A lane's share of the camera's gradient, p' = exp(turn) p + shift.
    PoseSums {
        turn: [f32; 3],
        /// Gaussians with a gradient that is not finite.
        non_finite: u32,
        shift: [f32; 3],
        unused_0: f32,
    }

    /// A strip of pixels' share of the loss and of the exposure's gradient.
    LossSums {
        /// By the logarithm of the gain.
        gain: [f32; 3],
        l1: f32,
        offset: [f32; 3],
        ssim: f32,
    }
}

impl Default for Push {
    fn default() -> Self {
        bytemuck::Zeroable::zeroed()
    }
}

const _: () = assert!(size_of::<Status>() as u64 <= STATUS_BYTES);
const _: () = assert!(size_of::<DepthMoments>() == size_of::<PoseSums>());
const _: () = assert!(size_of::<PoseSums>() as u64 == LANE_SUM_BYTES);

macro_rules! flags {
    ($($(#[doc = $doc:literal])* $name:ident = $value:literal;)*) => {
        $($(#[doc = $doc])* pub(crate) const $name: u32 = $value;)*

        #[cfg(test)]
        fn flags_glsl() -> String {
            let mut text = String::new();
            $($(text += &format!("//{}\n", $doc);)*
            text += &format!("const uint {} = {}u;\n", stringify!($name), $value);)*
            text
        }
    };
}

// Bits of `Frame::flags`. FLAG_KEEP_… and those after it switch a skip off, for the benchmark that says what each is worth;
// they change no picture.
flags! {
    /// The depth loss does not reach scales and rotations.
    FLAG_FREEZE_SHAPE = 1;
    /// Parallel rays along the view's axis; focal lengths in pixels per metre. Drawn only, never trained on.
    FLAG_ORTHOGRAPHIC = 2;
    /// The view has a depth prior.
    FLAG_DEPTH = 4;
    /// No culling at the picture's edges.
    FLAG_KEEP_OUTSIDE = 8;
    /// No culling by opacity.
    FLAG_KEEP_FAINT = 16;
    /// Every tile of the bounding box, not only those the ellipse touches.
    FLAG_WHOLE_BOXES = 32;
    /// Tiles are blended to the end, opaque or not.
    FLAG_NO_EARLY_END = 64;
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn generated() -> String {
        let mut text =
            "// Generated from src/layout.rs, where each field is described once; DGTR_BLESS=1 remakes it.\n"
                .to_owned();
        text += &flags_glsl();
        let block = |head: &str, fields: String, tail: &str| format!("\n{head} {{\n{fields}}}{tail};\n");
        text += &block("struct MissedSteps", MissedSteps::glsl(), "");
        text += &block("struct WalkCursor", WalkCursor::glsl(), "");
        text += &block("struct Status", Status::glsl(), "");
        text += &block("struct DepthMoments", DepthMoments::glsl(), "");
        text += &block("struct PoseSums", PoseSums::glsl(), "");
        text += &block("struct LossSums", LossSums::glsl(), "");
        text += &block("layout(std140, set = 0, binding = 0) uniform Frame", Frame::glsl(), " frame");
        text += &block("layout(push_constant) uniform Push", Push::glsl(), " push");
        text
    }

    #[test]
    fn the_kernels_declare_the_fields_that_the_host_declares() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("shaders/layout.glsl");
        if std::env::var_os("DGTR_BLESS").is_some() {
            std::fs::write(&path, generated()).unwrap();
        }
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text == generated(), "layout.glsl is older than src/layout.rs: DGTR_BLESS=1 remakes it");
    }
}

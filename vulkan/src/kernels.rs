//! The list of kernels: for each its checked-in SPIR-V and the sections of the arena it binds, in binding order.

use crate::arena::Section;
use crate::stages::Stage;

/// How many lanes a workgroup has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Group {
    /// Plain loops over Gaussians or pixels.
    Wide,
    /// Sorting kernels, dispatched over shares of the Gaussians: one lane per share, or [`SCAN_LANES`].
    Sort,
    /// Kernels that walk the tiles of Gaussians, dispatched over the same shares: one lane per share, or a workgroup.
    Walk,
    /// Blending kernels, dispatched over tiles: one lane per tile, or one per row of it.
    Tiles,
    /// Exactly [`SCAN_LANES`], one per digit or share of the tiles.
    Scan,
}

/// How many kinds there are.
pub(crate) const GROUPS: usize = Group::Scan as usize + 1;

/// Lanes of a scanning workgroup (a number inside its shaders).
pub(crate) const SCAN_LANES: u32 = 256;

pub(crate) struct KernelInfo {
    pub name: &'static str,
    pub spirv: &'static [u8],
    /// The variant with more lanes per tile or share.
    pub more_lanes: Option<&'static [u8]>,
    pub bindings: &'static [&'static str],
    /// Sections read through texel fetches, from binding [`FIRST_TEXELS`] on.
    pub texels: &'static [&'static str],
    pub group: Group,
    pub stage: Stage,
}

macro_rules! spirv {
    ($file:literal) => {
        include_bytes!(concat!("../shaders/spirv/", $file, ".spv"))
    };
    (more_lanes Tiles $file:literal) => {
        Some(include_bytes!(concat!("../shaders/spirv/", $file, "_rows.spv")))
    };
    (more_lanes Sort $file:literal) => {
        Some(include_bytes!(concat!("../shaders/spirv/", $file, "_group.spv")))
    };
    (more_lanes Walk $file:literal) => {
        Some(include_bytes!(concat!("../shaders/spirv/", $file, "_group.spv")))
    };
    (more_lanes $other:ident $file:literal) => {
        None
    };
}

macro_rules! kernels {
    ($($id:ident $file:literal $stage:ident $group:ident [$($binding:literal)*] [$($texels:literal)*];)*) => {
        /// One compute pipeline with its descriptor set.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum Kernel { $($id),* }

        pub(crate) const KERNELS: &[KernelInfo] = &[$(KernelInfo {
            name: stringify!($id),
            spirv: spirv!($file),
            more_lanes: spirv!(more_lanes $group $file),
            bindings: &[$($binding),*],
            texels: &[$($texels),*],
            group: Group::$group,
            stage: Stage::$stage,
        }),*];
    };
}

kernels! {
    Target "target" Target Wide ["view" "target"] [];
    Project "project" Project Wide ["geometry" "projected" "keys"] ["geometry"];
    SortCount "sort_count" Sort Sort ["keys" "digits" "status"] [];
    SortCountOther "sort_count" Sort Sort ["keys_other" "digits" "status"] [];
    SortScan "sort_scan" Sort Scan ["digits" "status"] [];
    SortScatter "sort_scatter" Sort Sort ["keys" "rows" "keys_other" "rows_other" "digits" "status"] [];
    SortScatterBack "sort_scatter" Sort Sort ["keys_other" "rows_other" "keys" "rows" "digits" "status"] [];
    Shade "shade" Shade Wide ["rows" "status" "geometry" "sh" "sh_first_moment" "sh_second_moment" "shaded"]
        ["projected" "geometry" "sh" "sh_first_moment" "sh_second_moment"];
    Count "count" Count Walk ["tiles" "status"] ["projected" "rows"];
    TilePrefix "tile_prefix" Count Wide ["tiles" "tile_starts"] [];
    TileScan "tile_scan" Count Scan ["tile_starts" "status"] [];
    Emit "emit" Emit Walk ["tiles" "status" "instances" "slot_ranges"] ["projected" "rows" "tile_starts"];
    Rasterise "rasterise" Rasterise Tiles ["tile_starts" "image" "transmittance"] ["shaded" "instances"];
    DepthSums "depth_sums" Loss Wide ["image" "target" "partials"] [];
    DepthFinish "depth_finish" Loss Wide ["partials" "status"] [];
    SsimRows "ssim_rows" Loss Wide ["moments"] ["image" "target"];
    SsimColumns "ssim_columns" Loss Wide ["adjoint" "partials"] ["moments"];
    SsimBackRows "ssim_back_rows" Loss Wide ["moments"] ["adjoint"];
    LossGradient "loss_gradient" Loss Wide ["image_gradient" "partials" "status"] ["moments" "image" "target"];
    RasteriseBackward "rasterise_backward" RasteriseBackward Tiles ["tile_starts" "slots"]
        ["shaded" "instances" "image" "image_gradient"];
    RasteriseBackwardDepth "rasterise_backward_depth" RasteriseBackward Tiles ["tile_starts" "slots"]
        ["shaded" "instances" "image" "image_gradient"];
    Reduce "reduce" Reduce Wide ["reduced" "status"] ["slot_ranges" "slots"];
    Optimise "optimise" Optimise Wide ["rows" "status" "geometry" "sh" "sh_first_moment" "sh_second_moment" "partials"]
        ["reduced" "geometry" "sh" "sh_first_moment" "sh_second_moment"];
}

/// A number that changes whenever any kernel does (FNV-1a over names and SPIR-V): what was measured with other kernels
/// says nothing about these.
pub(crate) fn fingerprint() -> u64 {
    let bytes = KERNELS
        .iter()
        .flat_map(|k| k.name.bytes().chain([Some(k.spirv), k.more_lanes].into_iter().flatten().flatten().copied()));
    bytes.fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3))
}

/// First of the texel bindings.
pub(crate) const FIRST_TEXELS: u32 = 9;

/// What a texel fetch of a section yields.
pub(crate) fn texel_format(name: &str, half_moments: bool) -> ash::vk::Format {
    match name {
        "sh_first_moment" | "sh_second_moment" if half_moments => ash::vk::Format::R16G16B16A16_SFLOAT,
        "instances" | "target" | "slot_ranges" => ash::vk::Format::R32G32_UINT,
        "rows" | "tile_starts" => ash::vk::Format::R32_UINT,
        _ => ash::vk::Format::R32G32B32A32_SFLOAT,
    }
}

/// SSIM's maps lie where the gradient slots will be: each half as many vec4 as three channels of pixels need.
pub(crate) fn part_of_slots(name: &str, slots: Section, pixels: usize) -> Option<Section> {
    let half = 48 * pixels as u64;
    match name {
        "moments" => Some(Section { offset: slots.offset, bytes: half }),
        "adjoint" => Some(Section { offset: slots.offset + half, bytes: half }),
        _ => None,
    }
}

//! The list of kernels: for each its checked-in SPIR-V and the sections of the arena it binds, in binding order.

use crate::layout::Section;
use crate::stages::Stage;

/// How many lanes a workgroup has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Group {
    /// Plain loops over Gaussians or pixels.
    Wide,
    /// SSIM's windows over strips of pixels, as many lanes: a lane holds the sums of a strip at once, or of a part of it.
    Strips,
    /// Sorting kernels, dispatched over shares of the Gaussians: one lane per share, or [`SCAN_LANES`].
    Sort,
    /// Kernels that walk the tiles of Gaussians, dispatched over the same shares: one lane per share, or a workgroup.
    Walk,
    /// Blending kernels, dispatched over tiles: one lane per tile, or one per run of it.
    Tiles,
    /// Exactly [`SCAN_LANES`], one per digit or share of the tiles.
    Scan,
}

/// How many kinds there are.
pub(crate) const GROUPS: usize = Group::Scan as usize + 1;

/// Lanes of a scanning workgroup (a number inside its shaders).
pub(crate) const SCAN_LANES: u32 = 256;
/// Lanes that sum depths; one lane merges what they leave.
pub(crate) const DEPTH_LANES: u32 = 1024;

/// A kernel as it is checked in.
#[derive(Clone, Copy)]
pub(crate) struct Spirv {
    /// What it only reads, it fetches as texels.
    pub texels: &'static [u8],
    /// The kernel that reads from storage buffers instead; none where nothing is fetched.
    pub storage: Option<&'static [u8]>,
}

impl Spirv {
    /// What to compile on a device that has storage buffers enough (`storage`), or views large enough.
    pub fn reading(&self, storage: bool) -> &'static [u8] {
        self.storage.filter(|_| storage).unwrap_or(self.texels)
    }
}

pub(crate) struct KernelInfo {
    pub name: &'static str,
    /// Name of its source and of its SPIR-V, without its variant's suffix.
    #[cfg_attr(not(test), allow(dead_code, reason = "for the list of what the boards' drivers compile"))]
    pub file: &'static str,
    pub spirv: Spirv,
    /// Its group's other variant: `_runs`, `_short` or `_group`.
    pub variant: Option<Spirv>,
    /// `_runs_shared`: a lane per run where lanes cannot read each other.
    pub shared: Option<Spirv>,
    pub bindings: &'static [&'static str],
    /// Sections read through texel fetches, from binding [`FIRST_TEXELS`] on.
    pub texels: &'static [&'static str],
    pub group: Group,
    pub stage: Stage,
}

macro_rules! spirv {
    ($file:literal $variant:literal []) => {
        Spirv { texels: include_bytes!(concat!("../shaders/spirv/", $file, $variant, ".spv")), storage: None }
    };
    ($file:literal $variant:literal [$($texels:literal)+]) => {
        Spirv {
            texels: include_bytes!(concat!("../shaders/spirv/", $file, $variant, ".spv")),
            storage: Some(include_bytes!(concat!("../shaders/spirv/", $file, $variant, ".storage.spv"))),
        }
    };
    (variant Tiles $file:literal $texels:tt) => {
        Some(spirv!($file "_runs" $texels))
    };
    (variant Strips $file:literal $texels:tt) => {
        Some(spirv!($file "_short" $texels))
    };
    (variant Sort $file:literal $texels:tt) => {
        Some(spirv!($file "_group" $texels))
    };
    (variant Walk $file:literal $texels:tt) => {
        Some(spirv!($file "_group" $texels))
    };
    (variant $other:ident $file:literal $texels:tt) => {
        None
    };
    (shared Tiles $file:literal $texels:tt) => {
        Some(spirv!($file "_runs_shared" $texels))
    };
    (shared $other:ident $file:literal $texels:tt) => {
        None
    };
}

macro_rules! kernels {
    ($($id:ident $file:literal $stage:ident $group:ident [$($binding:literal)*] [$($texels:literal)*];)*) => {
        /// One compute pipeline with its descriptor set.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum Kernel { $($id),* }

        /// Every kernel, in the order of [`KERNELS`].
        pub(crate) const ALL: &[Kernel] = &[$(Kernel::$id),*];

        pub(crate) const KERNELS: &[KernelInfo] = &[$(KernelInfo {
            name: stringify!($id),
            file: $file,
            spirv: spirv!($file "" [$($texels)*]),
            variant: spirv!(variant $group $file [$($texels)*]),
            shared: spirv!(shared $group $file [$($texels)*]),
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
    SortScatter "sort_scatter" Sort Sort ["keys" "order" "keys_other" "order_other" "digits" "status"] [];
    SortScatterBack "sort_scatter" Sort Sort ["keys_other" "order_other" "keys" "order" "digits" "status"] [];
    // `status` and `projected` it does not read: they keep SH and its moments at the bindings that `moments.glsl` has them at.
    CatchUp "catch_up" Shade Wide ["keys" "status" "geometry" "sh" "sh_first_moment" "sh_second_moment"]
        ["projected" "geometry" "sh" "sh_first_moment" "sh_second_moment"];
    Shade "shade" Shade Wide ["order" "status" "shaded"] ["projected" "geometry" "sh"];
    Count "count" Count Walk ["tiles" "status"] ["projected" "order"];
    TilePrefix "tile_prefix" Count Wide ["tiles" "tile_starts"] [];
    TileScan "tile_scan" Count Scan ["tile_starts" "status"] [];
    Emit "emit" Emit Walk ["tiles" "status" "instances" "slot_ranges"] ["projected" "order" "tile_starts"];
    Rasterise "rasterise" Rasterise Tiles ["tile_starts" "image" "transmittance"] ["shaded" "instances"];
    RasteriseMedian "rasterise_median" Rasterise Tiles ["tile_starts" "image" "transmittance"] ["shaded" "instances"];
    DepthSums "depth_sums" Loss Wide ["image" "target" "lane_sums"] [];
    DepthFinish "depth_finish" Loss Wide ["lane_sums" "status"] [];
    SsimRows "ssim_rows" Loss Strips ["moments"] ["image" "target"];
    SsimColumns "ssim_columns" Loss Strips ["adjoint" "strip_sums"] ["moments"];
    SsimBackRows "ssim_back_rows" Loss Strips ["moments"] ["adjoint"];
    LossGradient "loss_gradient" Loss Strips ["image_gradient" "strip_sums" "status"] ["moments" "image" "target"];
    ExposureSums "exposure_sums" Loss Wide ["strip_sums"] ["image" "image_gradient"];
    RasteriseBackward "rasterise_backward" RasteriseBackward Tiles ["tile_starts" "slots"]
        ["shaded" "instances" "image" "image_gradient"];
    RasteriseBackwardDepth "rasterise_backward_depth" RasteriseBackward Tiles ["tile_starts" "slots"]
        ["shaded" "instances" "image" "image_gradient"];
    Reduce "reduce" Reduce Wide ["reduced" "status"] ["slot_ranges" "slots" "shaded"];
    OptimiseSh "optimise_sh" Optimise Wide ["order" "status" "reduced" "sh" "sh_first_moment" "sh_second_moment"]
        ["reduced" "geometry" "sh" "sh_first_moment" "sh_second_moment"];
    ProjectBackward "project_backward" Optimise Wide ["order" "status" "projected" "lane_sums"] ["reduced" "geometry"];
    PoseSums "pose_sums" Optimise Wide ["order" "status" "lane_sums"] ["projected" "geometry" "reduced"];
    Optimise "optimise" Optimise Wide ["order" "status" "geometry"] ["projected" "geometry" "reduced"];
}

/// A number that changes whenever any kernel does, or one of the functions in `others` (FNV-1a over names, SPIR-V and text).
pub(crate) fn fingerprint(others: &[&str]) -> u64 {
    let variants = |k: &KernelInfo| [Some(k.spirv), k.variant, k.shared].into_iter().flatten().flat_map(|s| s.texels);
    let bytes = KERNELS.iter().flat_map(|k| k.name.bytes().chain(variants(k).copied()));
    bytes
        .chain(others.iter().flat_map(|s| s.bytes()))
        .fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3))
}

/// First of the texel bindings.
pub(crate) const FIRST_TEXELS: u32 = 9;

/// What a texel fetch of a section yields.
pub(crate) fn texel_format(name: &str, half_moments: bool) -> ash::vk::Format {
    match name {
        "sh_first_moment" | "sh_second_moment" if half_moments => ash::vk::Format::R16G16B16A16_SFLOAT,
        "instances" | "target" | "slot_ranges" => ash::vk::Format::R32G32_UINT,
        "order" | "tile_starts" => ash::vk::Format::R32_UINT,
        _ => ash::vk::Format::R32G32B32A32_SFLOAT,
    }
}

/// Bytes of one element of a format.
pub(crate) fn texel_bytes(format: ash::vk::Format) -> u64 {
    match format {
        ash::vk::Format::R32_UINT => 4,
        ash::vk::Format::R32G32_UINT | ash::vk::Format::R16G16B16A16_SFLOAT => 8,
        _ => 16,
    }
}

/// Bytes of SSIM's maps, which lie where the gradient slots will be: each as many vec4 as three channels of pixels need.
pub(crate) fn part_bytes_of_slots(name: &str, pixels: usize) -> Option<u64> {
    matches!(name, "moments" | "adjoint").then_some(48 * pixels as u64)
}

/// Where SSIM's maps lie.
pub(crate) fn part_of_slots(name: &str, slots: Section, pixels: usize) -> Option<Section> {
    let bytes = part_bytes_of_slots(name, pixels)?;
    let first = if name == "moments" { 0 } else { bytes };
    Some(Section { offset: slots.offset + first, bytes })
}

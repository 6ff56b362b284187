//! The table of contents: every case with its promise, and where the cases live that are not the renderer's.

use super::{Case, device, extremes, half, instances, reference};

macro_rules! case {
    ($input:literal, $promise:literal, $device:expr, $reference:expr) => {
        Case { input: $input, promise: $promise, device: $device, reference: $reference }
    };
}

/// Every case of the renderer and the trainer. There is no reference where the host does the work for both (it refuses poses,
/// moves and adds rows), nor of counting and emitting, which the reference does in one function.
pub const CASES: &[Case] = &[
    case!(
        "NaN or infinity in any parameter",
        "the row is left out and counted, the others are unchanged",
        Some(device::a_row_with_nan_or_infinity_in_any_slot_is_dropped_and_counted_at_load),
        Some(reference::a_row_with_nan_or_infinity_in_any_slot_is_counted_and_changes_nothing_else)
    ),
    case!(
        "denormals and f32::MAX in any parameter",
        "picture, loss and parameters stay finite",
        Some(device::denormal_and_largest_numbers_in_any_slot_leave_everything_finite),
        Some(reference::denormal_and_largest_numbers_in_any_slot_leave_everything_finite)
    ),
    case!(
        "quaternions of any length, zero too",
        "zero is left out, the rest normalised",
        Some(extremes::a_quaternion_of_length_zero_is_dropped_and_any_other_length_is_normalised),
        Some(reference::a_quaternion_of_length_zero_is_not_drawn_and_any_other_length_is_normalised)
    ),
    case!(
        "log scales up to 40 and beyond",
        "visible, flat, inside the tiles",
        Some(device::log_scales_up_to_forty_stay_visible),
        Some(reference::log_scales_up_to_forty_stay_visible_and_finite)
    ),
    case!(
        "needles: det Σ₂ near 0, σ < 0",
        "positive determinant, never more than the peak opacity",
        Some(device::needles_have_a_positive_determinant_and_never_more_than_their_peak_opacity),
        Some(reference::needles_thinner_than_f32_can_square_have_a_positive_determinant_and_no_negative_exponent)
    ),
    case!(
        "Gaussians at the camera centre or behind it",
        "not drawn, not moved, the step ends",
        Some(device::at_the_camera_centre_or_behind_nothing_is_drawn_and_the_step_still_ends),
        Some(reference::a_gaussian_at_the_camera_centre_or_behind_it_is_counted_and_not_drawn)
    ),
    case!(
        "nothing visible, no instance",
        "black picture, gradient zero",
        Some(device::at_the_camera_centre_or_behind_nothing_is_drawn_and_the_step_still_ends),
        Some(reference::nothing_to_draw_is_a_black_picture_with_a_gradient_of_zero)
    ),
    case!(
        "α → 1, one behind the other",
        "no division by zero in 1/(1−α)",
        Some(device::opaque_gaussians_in_front_of_each_other_divide_by_no_zero),
        Some(reference::opaque_gaussians_in_front_of_each_other_divide_by_no_zero)
    ),
    case!(
        "pictures of 1×1, 1×17, 17×1",
        "drawn as the reference draws them",
        Some(device::pictures_of_one_row_one_column_or_one_pixel_are_those_of_the_reference),
        Some(reference::pictures_of_one_row_one_column_or_one_pixel_are_drawn)
    ),
    case!(
        "colours up to f32::MAX",
        "clamped, with gradient zero",
        Some(device::colours_up_to_the_largest_float_are_clamped),
        Some(reference::colours_up_to_the_largest_float_are_clamped_and_their_gradient_is_zero)
    ),
    case!(
        "duplicated Gaussians",
        "drawn in the order of their rows",
        Some(extremes::duplicated_gaussians_are_drawn_in_the_order_of_their_rows),
        Some(reference::duplicated_gaussians_are_drawn_in_the_order_of_their_rows)
    ),
    case!(
        "the scene × 0.1 … 10⁶",
        "the same picture",
        Some(device::the_same_scene_at_any_scale_gives_the_same_picture),
        Some(reference::the_same_scene_at_any_scale_gives_the_same_picture)
    ),
    case!(
        "scenes of 1 cm and of 100 km",
        "train alike",
        Some(extremes::scenes_a_centimetre_and_a_hundred_kilometres_across_train_alike),
        Some(extremes::scenes_a_centimetre_and_a_hundred_kilometres_across_train_alike_in_the_reference)
    ),
    case!(
        "10 km and 6,378 km from the origin",
        "the same picture at 10 km, finite beyond",
        Some(extremes::cameras_far_from_the_origin_see_the_same_picture),
        Some(extremes::cameras_far_from_the_origin_see_the_same_picture_in_the_reference)
    ),
    case!(
        "rates × 10³ and × 10⁶, NaN, negative",
        "recovered from, or refused by name",
        Some(extremes::extreme_learning_rates_are_recovered_from_or_refused),
        Some(extremes::extreme_learning_rates_are_recovered_from_by_the_reference)
    ),
    case!(
        "pictures of one colour",
        "SSIM has no negative variance",
        Some(extremes::constant_photographs_have_no_negative_variance),
        Some(reference::ssim_of_constant_pictures_has_no_negative_variance)
    ),
    case!(
        "depth priors that say nothing",
        "no correlation, no gradient",
        Some(device::a_depth_prior_that_says_nothing_has_no_correlation),
        Some(reference::pearson_of_constant_depth_or_an_empty_mask_has_value_and_gradient_zero)
    ),
    case!(
        "exposure against a black photograph",
        "loss zero of nothing, gain and offset finite",
        Some(device::a_black_photograph_of_nothing_has_loss_zero_and_exposure_stays_finite),
        Some(reference::exposure_against_a_black_photograph_stays_finite)
    ),
    case!(
        "poses with NaN, zero quaternions, flips",
        "refused by name; a flipped one sees nothing",
        Some(device::poses_that_are_not_finite_are_refused_and_a_flipped_one_sees_nothing),
        None
    ),
    case!(
        "relocation: all dead, none dead, opaque",
        "rows stay sound, moves are counted",
        Some(device::relocation_survives_all_dead_none_dead_and_fully_opaque),
        None
    ),
    case!(
        "growth beyond the plan",
        "fills the plan and stops there",
        Some(device::growth_fills_the_plan_and_stops_there),
        None
    ),
    case!(
        "more tiles than instances",
        "the other tiles stay empty",
        Some(instances::more_tiles_than_instances_leave_the_other_tiles_empty),
        Some(instances::more_tiles_than_instances_leave_the_other_tiles_empty_in_the_reference)
    ),
    case!(
        "count pass ≠ emit pass",
        "a plan for exactly the counted instances holds them",
        Some(instances::every_shape_emits_exactly_the_instances_it_was_counted_for),
        None
    ),
    case!(
        "70,000 Gaussians in one tile",
        "those behind the opaque ones stay as they are",
        Some(instances::a_tile_with_more_gaussians_than_a_loop_may_turn_leaves_those_behind_alone),
        Some(instances::a_crowded_tile_leaves_those_behind_opaque_ones_alone_in_the_reference)
    ),
    case!(
        "one Gaussian over 70,400 tiles",
        "its gradient is the sum over all",
        Some(instances::a_gaussian_with_more_tiles_than_a_loop_may_turn_has_its_whole_gradient),
        Some(instances::a_gaussian_over_more_tiles_than_sixteen_bits_count_has_its_whole_gradient_in_the_reference)
    ),
    case!(
        "T·α below f16",
        "summed: transmittance is kept in 32 bits",
        Some(instances::light_and_contributions_below_sixteen_bits_are_still_summed),
        Some(instances::light_and_contributions_below_sixteen_bits_are_still_summed_in_the_reference)
    ),
    case!(
        "f16 storage of moments against f32",
        "the same loss, the same bytes every time; right on average",
        Some(half::training_with_half_moments_ends_where_training_with_whole_ones_does),
        Some(half::second_moments_in_sixteen_bits_are_right_on_average_only_when_rounded_by_chance)
    ),
    case!(
        "gradients beyond and below f16",
        "clamped or none, every number finite",
        Some(half::tiny_and_huge_gradients_in_half_moments_leave_every_number_finite),
        Some(half::moments_beyond_sixteen_bits_are_clamped_and_those_below_are_none)
    ),
];

/// Cases of other parts, or too large to run along: what comes in, and the test that tries it (file below the project's
/// root, name).
pub const ELSEWHERE: &[(&str, &str, &str)] = &[
    (
        "more instances than the buffer",
        "vulkan/tests/bands.rs",
        "instances_beyond_the_plan_are_blended_in_bands_with_identical_bits",
    ),
    (
        "more than 2³¹ and 2³² instances: cutting",
        "vulkan/src/device/bands.rs",
        "more_than_two_to_the_thirty_second_instances_are_counted_and_cut_without_wrapping",
    ),
    (
        "more than 2³² instances: a whole step",
        "vulkan/tests/numerical_gpu.rs",
        "more_instances_than_thirty_two_bits_count_are_drawn",
    ),
    (
        "(L−min)/(max−min) = 0/0",
        "vulkan/src/pictures/sampler.rs",
        "views_of_equal_or_unknown_loss_are_ranked_never_divided",
    ),
    (
        "more loop turns than the driver allows",
        "vulkan/tests/walk.rs",
        "every_tile_of_every_giant_is_counted_and_emitted",
    ),
    (
        "off-centre principal point, clamp beyond the frustum, both passes",
        "vulkan/tests/gradients.rs",
        "every_parameter_group_agrees_with_central_differences",
    ),
    ("UTM or ECEF in f32", "config/geometry/src/geodesy.rs", "enu_round_trip_stays_below_a_micrometre_everywhere"),
    (
        "duplicate points, single points, NaN",
        "models/src/init/baselines.rs",
        "duplicates_single_points_and_nan_leave_a_valid_cloud",
    ),
    (
        "fewer than three points",
        "models/tests/refine_behaviour.rs",
        "fewer_than_three_points_and_fewer_than_two_frames_are_no_problem",
    ),
    (
        "alignment that could shrink all scales to 0",
        "models/src/align/solve/tests.rs",
        "a_single_pair_is_anchored_by_its_baseline",
    ),
    ("Umeyama: reflection", "models/src/align/similarity.rs", "a_mirror_image_gives_a_rotation_never_a_reflection"),
    ("Umeyama: no variance", "models/src/align/similarity.rs", "lines_spots_and_too_few_points_are_refused"),
    ("singular ICP", "models/src/align/icp.rs", "lines_spots_and_nan_are_refused_and_a_plane_is_not"),
    (
        "poses turned by 180°",
        "models/tests/refine_behaviour.rs",
        "headings_turned_by_half_a_turn_are_refused_and_righted_even_on_the_first_frame",
    ),
    (
        "duplicated poses",
        "models/tests/refine_behaviour.rs",
        "a_duplicate_picture_lands_on_its_twin_and_a_duplicate_name_is_an_error",
    ),
    ("poses out of order", "models/src/refine/motion.rs", "order_of_arrival_does_not_matter_when_times_are_known"),
    (
        "poses with NaN",
        "models/tests/refine_behaviour.rs",
        "poses_that_are_not_numbers_are_refused_counted_and_leave_no_trace",
    ),
    ("100,000 steps", "vulkan/tests/numerical_gpu.rs", "a_hundred_thousand_steps_stay_sound"),
];

//! Numbers that broke other renderers, through the reference's whole step: one test per case of `vulkan::cases`.
#![allow(clippy::panic, reason = "a test fails by panicking")]

use vulkan::cases::{extremes, half, instances, reference};

macro_rules! held {
    ($module:ident: $($name:ident)*) => {$(
        #[test]
        fn $name() {
            println!("{}", $module::$name().unwrap_or_else(|e| panic!("{e}")));
        }
    )*};
}

held! { reference:
    a_row_with_nan_or_infinity_in_any_slot_is_counted_and_changes_nothing_else
    denormal_and_largest_numbers_in_any_slot_leave_everything_finite
    a_quaternion_of_length_zero_is_not_drawn_and_any_other_length_is_normalised
    log_scales_up_to_forty_stay_visible_and_finite
    needles_thinner_than_f32_can_square_have_a_positive_determinant_and_no_negative_exponent
    a_gaussian_at_the_camera_centre_or_behind_it_is_counted_and_not_drawn
    nothing_to_draw_is_a_black_picture_with_a_gradient_of_zero
    opaque_gaussians_in_front_of_each_other_divide_by_no_zero
    pictures_of_one_row_one_column_or_one_pixel_are_drawn
    colours_up_to_the_largest_float_are_clamped_and_their_gradient_is_zero
    duplicated_gaussians_are_drawn_in_the_order_of_their_rows
    the_same_scene_at_any_scale_gives_the_same_picture
    ssim_of_constant_pictures_has_no_negative_variance
    pearson_of_constant_depth_or_an_empty_mask_has_value_and_gradient_zero
    exposure_against_a_black_photograph_stays_finite
}

held! { extremes:
    scenes_a_centimetre_and_a_hundred_kilometres_across_train_alike_in_the_reference
    cameras_far_from_the_origin_see_the_same_picture_in_the_reference
    extreme_learning_rates_are_recovered_from_by_the_reference
}

held! { half:
    second_moments_in_sixteen_bits_are_right_on_average_only_when_rounded_by_chance
    moments_beyond_sixteen_bits_are_clamped_and_those_below_are_none
}

held! { instances:
    more_tiles_than_instances_leave_the_other_tiles_empty_in_the_reference
    light_and_contributions_below_sixteen_bits_are_still_summed_in_the_reference
    a_crowded_tile_leaves_those_behind_opaque_ones_alone_in_the_reference
    a_gaussian_over_more_tiles_than_sixteen_bits_count_has_its_whole_gradient_in_the_reference
}

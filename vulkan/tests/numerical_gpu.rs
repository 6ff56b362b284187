//! Numbers that broke other renderers, through the trainer on the device: one test per case of `vulkan::cases`. The same
//! promises hold for the reference (`numerical_reference.rs`).
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use vulkan::cases::{ELSEWHERE, Outcome, device, extremes, half, instances};
use vulkan::gpu::Gpu;

fn on_device(case: impl Fn(&Gpu) -> Outcome) {
    match Gpu::open(None) {
        Ok(gpu) => println!("{}", case(&gpu).unwrap_or_else(|e| panic!("{e}"))),
        Err(e) => needs::missing(needs::Need::Vulkan, e),
    }
}

macro_rules! held {
    ($module:ident: $($name:ident)*) => {$(
        #[test]
        fn $name() {
            on_device($module::$name);
        }
    )*};
}

held! { device:
    a_row_with_nan_or_infinity_in_any_slot_is_dropped_and_counted_at_load
    denormal_and_largest_numbers_in_any_slot_leave_everything_finite
    log_scales_up_to_forty_stay_visible
    needles_have_a_positive_determinant_and_never_more_than_their_peak_opacity
    at_the_camera_centre_or_behind_nothing_is_drawn_and_the_step_still_ends
    opaque_gaussians_in_front_of_each_other_divide_by_no_zero
    pictures_of_one_row_one_column_or_one_pixel_are_those_of_the_reference
    colours_up_to_the_largest_float_are_clamped
    the_same_scene_at_any_scale_gives_the_same_picture
    a_depth_prior_that_says_nothing_has_no_correlation
    a_black_photograph_of_nothing_has_loss_zero_and_exposure_stays_finite
    poses_that_are_not_finite_are_refused_and_a_flipped_one_sees_nothing
    relocation_survives_all_dead_none_dead_and_fully_opaque
    growth_fills_the_plan_and_stops_there
}

held! { extremes:
    a_quaternion_of_length_zero_is_dropped_and_any_other_length_is_normalised
    duplicated_gaussians_are_drawn_in_the_order_of_their_rows
    scenes_a_centimetre_and_a_hundred_kilometres_across_train_alike
    cameras_far_from_the_origin_see_the_same_picture
    extreme_learning_rates_are_recovered_from_or_refused
    constant_photographs_have_no_negative_variance
}

held! { half:
    training_with_half_moments_ends_where_training_with_whole_ones_does
    tiny_and_huge_gradients_in_half_moments_leave_every_number_finite
}

held! { instances:
    more_tiles_than_instances_leave_the_other_tiles_empty
    every_shape_emits_exactly_the_instances_it_was_counted_for
    a_tile_with_more_gaussians_than_a_loop_may_turn_leaves_those_behind_alone
    a_gaussian_with_more_tiles_than_a_loop_may_turn_has_its_whole_gradient
    light_and_contributions_below_sixteen_bits_are_still_summed
}

#[test]
#[ignore = "takes up to half an hour"]
fn more_instances_than_thirty_two_bits_count_are_drawn() {
    on_device(instances::more_instances_than_thirty_two_bits_count);
}

#[test]
#[ignore = "takes minutes"]
fn a_hundred_thousand_steps_stay_sound() {
    on_device(|gpu| extremes::long_run(gpu, 100_000));
}

#[test]
fn eight_hundred_steps_stay_sound() {
    on_device(|gpu| extremes::long_run(gpu, 800));
}

#[test]
fn every_case_of_the_list_has_a_test_of_its_name() {
    let list = include_str!("../src/cases/list.rs");
    let tests = concat!(include_str!("numerical_gpu.rs"), include_str!("numerical_reference.rs"));
    let mut named = 0;
    for piece in list.split("Some(").skip(1) {
        let name = piece.split(')').next().unwrap().rsplit("::").next().unwrap();
        assert!(tests.contains(&format!("    {name}\n")), "{name} has no test");
        named += 1;
    }
    assert!(named > 30, "the list was not understood");
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    for (input, file, name) in ELSEWHERE {
        let text = std::fs::read_to_string(root.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"));
        assert!(text.contains(&format!("fn {name}(")), "{input}: {file} has no test {name}");
    }
}

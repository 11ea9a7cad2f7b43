"""Tests that `make test` leaves to `make test-ci` and `make test-all`, each with what covers its contract meanwhile.

Each took a third of a second of processor time or more, and is not the only proof of what it proves. A name that ends
in "*" stands for all tests that begin so; whole functions that are slow are marked where they stand.
"""

MESHES = "the same on the plane, the sphere or the cylinder"
ONE_OF_A_KIND = "other values of the same parameters"

SLOW: dict[str, dict[str, tuple[str, ...]]] = {
    "test_examples": {
        "examples 01, 02 and 06 run; `make examples` runs all": (
            "test_an_example_makes_its_picture[03*",
            "test_an_example_makes_its_picture[04*",
            "test_an_example_makes_its_picture[05*",
            "test_an_example_makes_its_picture[07*",
            "test_an_example_makes_its_picture[08*",
            "test_an_example_makes_its_picture[09*",
            "test_an_example_makes_its_picture[10*",
        ),
        "test_a_picture_without_a_highlight_ends_in_one_line starts an example as a user does": (
            "test_an_example_runs_as_a_user_runs_it[02*",
        ),
    },
    "test_nightly_run": {
        ONE_OF_A_KIND: (
            "test_nothing_is_kept_of_a_night_that_stops_before_it_is_whole[draw-error1]",
            "test_a_baseline_that_cannot_be_compared_stops_a_night_before_it_works[<lambda>-quick/figures*",
            *(f"test_a_full_disk_is_told_and_nothing_is_lost[{n}]" for n in range(1, 7)),
            "test_nothing_is_kept_of_a_night_that_stops_before_it_is_whole[append-error0]",
            "test_nothing_is_kept_of_a_night_that_stops_before_it_is_whole[write_nightly_page-error1]",
            "test_nothing_is_kept_of_a_night_that_stops_before_it_is_whole[draw-error0]",
            "test_nothing_is_kept_of_a_night_that_stops_before_it_is_whole[judge-error1]",
        ),
        "test_a_full_disk_is_told_and_nothing_is_lost stops at the same step": (
            "test_the_next_night_works_after_a_full_disk",
        ),
        "test_the_command_prints_a_table_and_the_page, and test_gate": ("test_the_command_prints_what_is_worse",),
    },
    "test_gate_edits": {
        ONE_OF_A_KIND: (
            "test_a_single_result_that_moved_is_told_on_the_same_machine_alone[variant]",
            "test_a_single_result_that_moved_is_told_on_the_same_machine_alone[versions]",
        ),
        "the same edits against the same seeds, and test_some_edits_are_seen_against_other_seeds_in_each_run": (
            "test_edits_are_seen_against_other_seeds_too*",
        ),
    },
    "test_gate": {
        ONE_OF_A_KIND: (
            "test_without_exact_pairs_the_test_is_unpaired[versions]",
            "test_without_exact_pairs_the_test_is_unpaired[more]",
            "test_an_uncertainty_that_is_no_number_covers_nothing[inf]",
            "test_an_uncertainty_that_is_no_longer_stated_is_seen[some-axis_ratio*",
            "test_an_uncertainty_that_is_no_longer_stated_is_seen[all-mahalanobis2*",
            "test_where_no_uncertainty_was_ever_stated_there_is_none_to_lose[axis_ratio*",
        ),
    },
    "test_gate_signs": {
        "test_more_wrong_signs_are_a_regression_and_fewer_must_be_explained": (
            "test_equal_signs_are_equal_and_one_wrong_sign_is_no_finding",
        ),
    },
    "test_deformed_render": {
        "the same on tissue": ("test_a_rigid_motion_of_tissue_is_the_reverse_motion_of_the_camera[reflectance0]",),
        ONE_OF_A_KIND: ("test_analytic_surfaces_deform[surface1-part1]",),
    },
    "test_deforming_sequence": {
        "test_flow for tissue that stands still, test_deformed_render for tissue that moves": (
            "test_flow_is_that_of_the_tissue",
        ),
    },
    "test_relief": {
        ONE_OF_A_KIND: (
            "test_fine_normals_and_curvatures_are_those_of_the_height[colon-None]",
            "test_fine_normals_and_curvatures_are_those_of_the_height[quadric-*",
            "test_slope_wavelength_and_height[0.05-gaussian]",
            "test_slope_wavelength_and_height[0.05-pits]",
            "test_slope_wavelength_and_height[0.25-gaussian]",
            "test_slope_wavelength_and_height[0.25-ridged]",
            "test_slope_wavelength_and_height[0.5-pits]",
            "test_slope_wavelength_and_height[0.5-ridged]",
            "test_anisotropy_draws_waves_out_along_the_direction[5.0]",
        ),
    },
    "test_colon": {
        "the recipe with polyps and relief": (
            "test_partial_derivatives_match_finite_differences[pedunculated]",
            "test_normals_and_curvatures_match_finite_differences_of_the_surface[pedunculated]",
        ),
        "the pedunculated polyp's mesh": (
            "test_mesh_has_two_open_ends_and_normals_into_the_lumen[shipped]",
            "test_mesh_has_two_open_ends_and_normals_into_the_lumen[polyps*",
        ),
    },
    "test_viewpoints": {
        "the same in the colon": (
            "test_poses_are_rigid_repeatable_and_different[liver]",
            "test_poses_are_rigid_repeatable_and_different[colon_*",
            "test_camera_is_never_in_tissue_and_sees_the_surface[liver]",
            "test_camera_is_never_in_tissue_and_sees_the_surface[colon_*",
        ),
    },
    "test_camera_path": {
        "the path in a bent tube, and off_axis and wall in the colon": (
            "test_poses_are_rigid_smooth_and_never_in_tissue[path-colon]",
        ),
    },
    "test_process_runs": {
        ONE_OF_A_KIND: (
            "test_the_command_that_makes_a_realisation_again_holds_the_core[]",
            "test_an_estimator_of_ours_gives_the_same_rows_as_a_core[--files]",
            "test_a_run_closes_its_cores[experiment]",
            "test_a_core_ends_with_its_parent[]",
            "test_a_core_ends_with_its_parent[import os*",
        ),
    },
    "test_cli": {
        "test_stopping: other commands whose reader has gone": ("test_a_reader_that_has_gone_is_no_error",),
    },
    "test_stopping": {
        ONE_OF_A_KIND: (
            "test_an_output_that_is_full_is_told[schema*",
            "test_a_reader_that_has_gone_is_no_error[schema*",
        ),
    },
    "test_tissue_colour": {
        ONE_OF_A_KIND: ("test_the_kernel_is_the_reference[sphere-llvm_ad_rgb]",),
        MESHES: (
            "test_the_table_finds_every_vessel[colon]",
            "test_the_kernel_is_the_reference[colon-*",
            "test_the_kernel_is_the_reference[plane-llvm_ad_mono]",
            "test_murray_holds_at_every_node[colon]",
        ),
    },
    "test_dense_shading": {
        "test_dense_command scores maps; test_a_matt_hollow_is_recovered holds the method": (
            "test_it_is_scored_as_maps_are",
        ),
        ONE_OF_A_KIND: (
            "test_a_matt_hollow_is_recovered_through_any_lens[pinhole]",
            "test_a_matt_hollow_is_recovered_through_any_lens[brown_conrady]",
        ),
    },
    "test_dataset": {
        ONE_OF_A_KIND: ("test_a_stopped_run_goes_on[1]", "test_a_stopped_run_goes_on[5]"),
        "test_a_stopped_run_goes_on[3] and test_damage_is_mended": ("test_a_shard_cut_anywhere_goes_on",),
    },
    "test_page_up_to_date": {
        ONE_OF_A_KIND: (
            "test_what_is_damaged_is_written_again[cut_*",
            "test_what_is_damaged_is_written_again[edit_the_page]",
            "test_what_is_damaged_is_written_again[spoil_the_note]",
            "test_what_is_damaged_is_written_again[remove_the_guide]",
        ),
        "test_realism_page: a stop leaves the earlier page; what is damaged is written again here": (
            "test_a_stop_leaves_the_earlier_page_and_the_next_call_makes_it_whole",
        ),
    },
    "test_nightly_page": {
        "the state of a regression, and test_gate_notes for the sentences": (
            "test_each_state_is_told[fine-*",
            "test_each_state_is_told[changed-*",
        ),
    },
    "test_photometric": {
        ONE_OF_A_KIND: (
            "test_published_protocol_is_solved_to_its_bound[values2]",
            "test_curved_surfaces_with_the_light_at_the_camera[plane]",
            "test_published_protocol_is_solved_to_its_bound[values3]",
            "test_published_protocol_is_solved_to_its_bound[values1]",
            "test_curved_surfaces_with_the_light_at_the_camera[inside]",
        ),
    },
    "test_motion_evidence": {
        ONE_OF_A_KIND: (
            "test_a_told_sign_is_wrong_no_more_often_than_stated[one]",
            "test_a_told_sign_is_wrong_no_more_often_than_stated[short]",
        ),
    },
    "test_motion_sequence": {
        ONE_OF_A_KIND: (
            "test_a_sequence_with_poses_tells_the_shape[concave]",
            "test_a_sequence_with_poses_tells_the_shape[convex]",
        ),
    },
    "test_motion_experiment": {
        "test_motion_evidence and test_motion_sequence": (
            "test_a_small_run_tells_right_signs_and_none_where_the_poses_are_backwards",
        ),
    },
    "test_mesh_surface": {
        "meshes that are made here": ("test_reference_meshes_are_told_apart",),
        ONE_OF_A_KIND: (
            "test_malformed_files_give_one_line[cloud.vtk]",
            "test_malformed_files_give_one_line[range.vtk]",
        ),
    },
    "test_export": {
        ONE_OF_A_KIND: (
            "test_sampled_pictures_have_the_same_mean[bounces off tissue]",
            "test_mitsuba_renders_the_same_picture[quadric-rough plastic*",
            "test_mitsuba_renders_the_same_picture[quadric-phong*",
            "test_the_line_in_the_file_makes_it_load[phong*",
        ),
    },
    "test_reuse": {
        "test_a_quick_look_is_taken_where_it_costs_less_than_the_frame": (
            "test_a_frame_that_is_not_rendered_shows_too_few_highlights[colon]",
        ),
        "the same on rough spheres": (
            "test_highlights_and_labels_are_those_of_a_fresh_session[colon]",
            "test_highlights_that_get_their_radiance_later_stand_as_if_found_with_it[colon]",
        ),
        ONE_OF_A_KIND: (
            "test_wide_sources_are_judged_by_the_frame_that_is_kept[8]",
            "test_samples_are_the_same_bytes_without_reuse[liver*",
        ),
    },
    "test_frames": {
        MESHES: (
            "test_labels_are_the_exact_truth_to_the_meshs_fineness[colon-*",
            "test_truth_is_the_same_with_and_without_labels_first[colon]",
            "test_truth_is_the_same_with_and_without_labels_first[saddle]",
        ),
    },
    "test_two_truths": {
        "the same on surfaces that are made here": ("test_labels_of_a_users_mesh_are_both_truths[liver*",),
        ONE_OF_A_KIND: ("test_labels_are_both_exact_truths_to_the_meshs_fineness[saddle-*",),
        MESHES: ("test_labels_are_both_exact_truths_to_the_meshs_fineness[colon-*",),
    },
    "test_closed_form": {
        ONE_OF_A_KIND: (
            "test_every_pixel_has_the_radiance_of_the_formula[plane-500.0]",
            "test_every_pixel_has_the_radiance_of_the_formula[sphere-10.0]",
        ),
    },
    "test_bench_suite": {
        ONE_OF_A_KIND: ("test_every_drawn_scene_is_valid[first]", "test_every_drawn_scene_is_valid[second]"),
    },
    "test_paper_experiment": {
        "test_cli: the same command goes on and gives the same results": (
            "test_a_run_cut_in_two_gives_the_same_bytes",
        ),
    },
    "test_score_dataset": {
        "test_a_dataset_has_a_frame_for_each_sample, and test_score_export": ("test_the_command_exports",),
        "test_own_estimates_of_a_dataset_are_scored_as_they_were": (
            "test_frames_need_none_of_the_estimators_that_a_dataset_was_made_with",
        ),
    },
    "test_score_table": {ONE_OF_A_KIND: ("test_own_estimates_with_a_lens[csv]",)},
    "test_tracks": {
        ONE_OF_A_KIND: (
            "test_the_law_tells_wrong_poses[axes]",
            "test_a_highlight_moves_as_the_law_says[saddle*",
        ),
    },
    "test_pose_region_coverage": {
        ONE_OF_A_KIND: ("test_regions_cover_at_and_far_from_the_branch_point[58.0-0.05]",),
    },
    "test_cone_axis": {
        ONE_OF_A_KIND: (
            "test_cone_axis_stays_below_two_hundredths_of_a_degree[sphere]",
            "test_half_a_pixel_is_noticed[shift0-cylinder]",
            "test_half_a_pixel_is_noticed[shift1-cylinder]",
            "test_circle_pose_follows_its_law[10.0]",
            "test_cone_axis_stays_below_two_hundredths_of_a_degree[cylinder]",
        ),
    },
    "test_harness_faults": {
        "the same on the plane": (
            "test_a_rendered_picture_can_be_reconstructed[saddle]",
            "test_a_rendered_picture_can_be_reconstructed[sphere]",
            "test_a_rendered_picture_can_be_reconstructed[cylinder]",
        ),
    },
    "test_light_calibration": {ONE_OF_A_KIND: ("test_touching_highlights_are_separated[lights1]",)},
    "test_two_views": {
        ONE_OF_A_KIND: ("test_rendered_pairs_tell_the_signs[saddle*", "test_rendered_pairs_tell_the_signs[beyond*")
    },
    "test_backend": {
        ONE_OF_A_KIND: ("test_a_variant_that_fails_leaves_the_next_one_usable[nope]",),
    },
    "test_public_surface": {ONE_OF_A_KIND: ("test_a_picture_is_reconstructed_without_slow_packages[fov]",)},
    "test_realism_distance": {
        "test_the_command_says_too_few_scenes": ("test_few_scenes_carry_no_verdict",),
    },
    "test_render": {
        ONE_OF_A_KIND: ("test_true_highlights_bisect_and_are_where_the_frame_is_brightest[saddle,*",),
        MESHES: ("test_vertex_normals_of_rendered_meshes_are_the_exact_ones[colon]",),
    },
    "test_flow": {ONE_OF_A_KIND: ("test_the_cycle_closes[fisheye-saddle]",)},
    "test_peak_shape": {ONE_OF_A_KIND: ("test_noise_is_allowed_for[0.03]", "test_noise_is_allowed_for[0.06]")},
    "test_known": {
        ONE_OF_A_KIND: ("test_regions_hold_over_the_distance_where_lights_are_not_told_apart[prior*",),
    },
    "test_bench_certificates": {ONE_OF_A_KIND: ("test_no_figure_is_taken_on_trust[score_deg-1e-05-same]",)},
    "test_light_solver": {ONE_OF_A_KIND: ("test_two_lights_among_stray_highlights[ball-camera1]",)},
    "test_lens_render": {ONE_OF_A_KIND: ("test_frames_and_truth_through_a_masked_fisheye[anatomy]",)},
    "test_completion": {"test_many_normals_undo_the_error_and_vague_ones_leave_it": ("test_more_normals_help_more",)},
    "test_variants_of_runs": {
        ONE_OF_A_KIND: ("test_an_experiment_beside_one_of_another_variant_has_the_rows_that_it_has_alone[names0]",),
    },
    "test_picture_way": {
        "the same way by another detector": ("test_a_picture_climbs_three_times_through_five_packages[colour]",),
    },
    "test_guide": {
        ONE_OF_A_KIND: ("test_the_interval_of_a_median_holds_it_in_95_of_100_samples_of_frames[12-3]",),
    },
    "test_hard_cases": {
        ONE_OF_A_KIND: ("test_streaks_are_refused_or_flagged[-1.1]",),
    },
    "test_advice": {ONE_OF_A_KIND: ("test_the_gain_of_strata_is_that_of_planted_errors[True]",)},
    "test_inverse_rendering": {
        ONE_OF_A_KIND: (
            "test_normal_and_curvatures_are_recovered[saddle]",
            "test_normal_and_curvatures_are_recovered[cylinder]",
        )
    },
    "test_core_check": {
        ONE_OF_A_KIND: (
            "test_a_usual_mistake_is_named[answer['normal'] = *",
            "test_a_fault_of_a_frame_core_is_found[away]",
            "test_a_fault_of_a_frame_core_is_found[level]",
        )
    },
    "test_sensor_scenes": {
        ONE_OF_A_KIND: (
            "test_pictures_read_back_as_the_frame[2]",
            "test_known_vignetting_is_undone[0.05]",
        )
    },
    "test_even_pixels": {ONE_OF_A_KIND: ("test_labels_need_no_second_trace[saddle]",)},
}
"""Names of tests by what covers them, by file."""

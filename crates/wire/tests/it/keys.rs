//! Keys against `tests/golden/keys.json`, which the Python package is tested against too.

use serde_json::Value;
use std::collections::BTreeMap;
use wire::key;

#[test]
fn keys_match_the_golden_ones() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/keys.json");
    let golden: BTreeMap<String, Value> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    for (name, entry) in &golden {
        let chunk = |argument: &str| entry["arguments"][argument].to_string().trim_matches('"').to_owned();
        let key = match name.as_str() {
            "sim_reset" => key::sim_reset(&chunk("worker")),
            "sim_step" => key::sim_step(&chunk("worker")),
            "sim_frame" => key::sim_frame(&chunk("worker")),
            "sim_action" => key::sim_action(&chunk("worker")),
            "sim_plan" => key::sim_plan(&chunk("worker")),
            "sim_alive" => key::sim_alive(&chunk("worker")),
            "demonstration_step" => key::demonstration_step(&chunk("episode"), &chunk("step")),
            "demonstration_commit" => key::demonstration_commit(&chunk("episode")),
            "demonstration_recorded" => key::demonstration_recorded(&chunk("episode")),
            "planner_plan" => key::planner_plan(&chunk("planner")),
            "planner_register_goal" => key::planner_register_goal(&chunk("planner")),
            "planner_load_model" => key::planner_load_model(&chunk("planner")),
            "planner_unload_model" => key::planner_unload_model(&chunk("planner")),
            "planner_list_models" => key::planner_list_models(&chunk("planner")),
            "trainer_alive" => key::trainer_alive(&chunk("trainer")),
            "planner_alive" => key::planner_alive(&chunk("planner")),
            "trainer_start_run" => key::trainer_start_run(&chunk("trainer")),
            "trainer_stop_run" => key::trainer_stop_run(&chunk("trainer")),
            "trainer_list_runs" => key::trainer_list_runs(&chunk("trainer")),
            "training_progress" => key::training_progress(&chunk("run")),
            "checkpoint_announcement" => key::checkpoint_announcement(&chunk("model")),
            "checkpoint_chunk" => key::checkpoint_chunk(&chunk("digest")),
            "checkpoint_list_versions" => key::checkpoint_list_versions(&chunk("model")),
            "checkpoint_promote" => key::checkpoint_promote(&chunk("model")),
            "checkpoint_roll_back" => key::checkpoint_roll_back(&chunk("model")),
            other => panic!("keys.json names {other}, which is not tested here"),
        };
        assert_eq!(key.unwrap().as_str(), entry["key"], "{name}");
    }
    assert_eq!(golden.len(), 25, "every key is in the file");
}

#[test]
fn a_name_that_is_not_a_chunk_is_refused() {
    let error = key::planner_plan("a/b").unwrap_err();
    assert_eq!((error.field.as_str(), error.got.as_str()), ("planner_plan", "\"a/b\""));
}

#[test]
fn the_worker_is_read_from_its_token() {
    let key = key::sim_alive("w7").unwrap();
    assert_eq!(key::worker_of_sim_alive(&key).as_deref(), Some("w7"));
    assert_eq!(key::worker_of_sim_alive(&key::planner_alive("w7").unwrap()), None);
}

#[test]
fn the_episode_is_read_from_the_key_of_its_steps() {
    let key = key::demonstration_step("door-lock-17", "*").unwrap();
    assert_eq!(key::episode_of_demonstration_step(&key).as_deref(), Some("door-lock-17"));
    assert_eq!(key::episode_of_demonstration_step(&key::demonstration_commit("door-lock-17").unwrap()), None);
}

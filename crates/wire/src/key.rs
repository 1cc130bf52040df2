//! All zenoh key expressions. The verbatim chunk `@v1` is the protocol version: `cpn/**` does not match it.
//!
//! Each function takes the variable chunks of its key; `"*"` matches any value of a chunk.

use crate::Error;
use zenoh::key_expr::{OwnedKeyExpr, keyexpr};

macro_rules! keys {
    ($($(#[$doc:meta])* $name:ident($($chunk:ident),+) = $format:literal;)+) => {
        mod format {
            zenoh::key_expr::format::kedefine!($(pub(super) $name: $format),+);
        }
        $(
            $(#[$doc])*
            ///
            /// # Errors
            /// If a chunk is not valid in a key expression.
            pub fn $name($($chunk: &str),+) -> Result<OwnedKeyExpr, Error> {
                zenoh::key_expr::format::keformat!(format::$name::formatter(), $($chunk = $chunk),+).map_err(|_| {
                    let got = [$(format!("{:?}", $chunk)),+].join(", ");
                    Error::invalid(stringify!($name), concat!("chunks for the key ", $format), got)
                })
            }
        )+
    };
}

keys! {
    /// Queryable: [`crate::planner::PlanRequest`].
    planner_plan(planner) = "cpn/@v1/planner/${planner:*}/plan";
    /// Queryable: [`crate::planner::RegisterGoalRequest`].
    planner_register_goal(planner) = "cpn/@v1/planner/${planner:*}/register_goal";
    /// Queryable: [`crate::planner::LoadModelRequest`].
    planner_load_model(planner) = "cpn/@v1/planner/${planner:*}/load_model";
    /// Queryable: [`crate::planner::UnloadModelRequest`].
    planner_unload_model(planner) = "cpn/@v1/planner/${planner:*}/unload_model";
    /// Queryable: [`crate::planner::ListModelsRequest`].
    planner_list_models(planner) = "cpn/@v1/planner/${planner:*}/list_models";
    /// Queryable: [`crate::sim::ResetRequest`].
    sim_reset(worker) = "cpn/@v1/sim/${worker:*}/reset";
    /// Queryable: [`crate::sim::StepRequest`].
    sim_step(worker) = "cpn/@v1/sim/${worker:*}/step";
    /// Published frames, for watchers.
    sim_frame(worker) = "cpn/@v1/sim/${worker:*}/frame";
    /// Published actions, for watchers.
    sim_action(worker) = "cpn/@v1/sim/${worker:*}/action";
    /// Published [`crate::sim::TrialPlan`], for watchers.
    sim_plan(worker) = "cpn/@v1/sim/${worker:*}/plan";
    /// Published [`crate::demonstration::DemonstrationStep`]; queryable, without a payload, once the episode is recorded.
    demonstration_step(episode, step) = "cpn/@v1/demonstration/${episode:*}/step/${step:*}";
    /// Queryable: [`crate::demonstration::CommitEpisodeRequest`].
    demonstration_commit(episode) = "cpn/@v1/demonstration/${episode:*}/commit";
    /// Published [`crate::demonstration::RecordedEpisode`]; queryable without a payload.
    demonstration_recorded(episode) = "cpn/@v1/demonstration/${episode:*}/recorded";
    /// Published [`crate::checkpoint::CheckpointAnnouncement`].
    checkpoint_announcement(model) = "cpn/@v1/checkpoint/${model:*}/announcement";
    /// Queryable: [`crate::checkpoint::CheckpointChunkRequest`].
    checkpoint_chunk(digest) = "cpn/@v1/checkpoint/${digest:*}/chunk";
    /// Queryable: [`crate::checkpoint::ListVersionsRequest`].
    checkpoint_list_versions(model) = "cpn/@v1/checkpoint/${model:*}/list_versions";
    /// Queryable: [`crate::checkpoint::PromoteVersionRequest`].
    checkpoint_promote(model) = "cpn/@v1/checkpoint/${model:*}/promote";
    /// Queryable: [`crate::checkpoint::RollBackRequest`].
    checkpoint_roll_back(model) = "cpn/@v1/checkpoint/${model:*}/roll_back";
    /// Queryable: [`crate::training::StartRunRequest`].
    trainer_start_run(trainer) = "cpn/@v1/trainer/${trainer:*}/start_run";
    /// Queryable: [`crate::training::StopRunRequest`].
    trainer_stop_run(trainer) = "cpn/@v1/trainer/${trainer:*}/stop_run";
    /// Queryable: [`crate::training::ListRunsRequest`].
    trainer_list_runs(trainer) = "cpn/@v1/trainer/${trainer:*}/list_runs";
    /// Published [`crate::training::Run`].
    training_progress(run) = "cpn/@v1/training/${run:*}/progress";
    /// Liveliness token of a trainer's service.
    trainer_alive(trainer) = "cpn/@v1/alive/trainer/${trainer:*}";
    /// Liveliness token of a planner.
    planner_alive(planner) = "cpn/@v1/alive/planner/${planner:*}";
    /// Liveliness token of a simulator worker.
    sim_alive(worker) = "cpn/@v1/alive/sim/${worker:*}";
}

/// Worker's name in the key of its liveliness token.
pub fn worker_of_sim_alive(key: &keyexpr) -> Option<String> {
    Some(format::sim_alive::parse(key).ok()?.worker().to_string())
}

/// Episode identifier, or `*`, in the key of an episode's steps.
pub fn episode_of_demonstration_step(key: &keyexpr) -> Option<String> {
    Some(format::demonstration_step::parse(key).ok()?.episode().to_string())
}

/// Episode identifier, or `*`, in the key of a recording.
pub fn episode_of_demonstration_recorded(key: &keyexpr) -> Option<String> {
    Some(format::demonstration_recorded::parse(key).ok()?.episode().to_string())
}

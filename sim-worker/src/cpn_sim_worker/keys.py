"""All zenoh key expressions of the project.

The verbatim chunk `@v1` is the protocol version: `cpn/**` does not match it. `tests/golden/keys.json` at the root of
the repository keeps this module and its Rust counterpart in step.
"""

ROOT = "cpn/@v1"


def sim_reset(worker: str) -> str:
    """Queryable: `ResetRequest` to `ResetResponse`."""
    return f"{ROOT}/sim/{worker}/reset"


def sim_step(worker: str) -> str:
    """Queryable: `StepRequest` to `StepResponse`."""
    return f"{ROOT}/sim/{worker}/step"


def sim_frame(worker: str) -> str:
    """Put: `Frame`."""
    return f"{ROOT}/sim/{worker}/frame"


def sim_action(worker: str) -> str:
    """Put: `AppliedAction`."""
    return f"{ROOT}/sim/{worker}/action"


def sim_plan(worker: str) -> str:
    """Put: `TrialPlan`, by the evaluator."""
    return f"{ROOT}/sim/{worker}/plan"


def sim_alive(worker: str) -> str:
    """Liveliness token of a worker that is ready."""
    return f"{ROOT}/alive/sim/{worker}"


def demonstration_step(episode: str, step: int | str) -> str:
    """Put: `DemonstrationStep`. Both arguments may be `*` in a subscription."""
    return f"{ROOT}/demonstration/{episode}/step/{step}"


def demonstration_commit(episode: str) -> str:
    """Queryable of the trainer: `CommitEpisodeRequest` to `CommitEpisodeResponse`."""
    return f"{ROOT}/demonstration/{episode}/commit"


def demonstration_recorded(episode: str) -> str:
    """Put, and queryable, of the trainer: `RecordedEpisode`."""
    return f"{ROOT}/demonstration/{episode}/recorded"


def planner_plan(planner: str) -> str:
    """Queryable: `PlanRequest` to `PlanResponse`."""
    return f"{ROOT}/planner/{planner}/plan"


def planner_register_goal(planner: str) -> str:
    """Queryable: `RegisterGoalRequest` to `RegisterGoalResponse`."""
    return f"{ROOT}/planner/{planner}/register_goal"


def planner_load_model(planner: str) -> str:
    """Queryable: `LoadModelRequest` to `LoadModelResponse`."""
    return f"{ROOT}/planner/{planner}/load_model"


def planner_unload_model(planner: str) -> str:
    """Queryable: `UnloadModelRequest` to `UnloadModelResponse`."""
    return f"{ROOT}/planner/{planner}/unload_model"


def planner_list_models(planner: str) -> str:
    """Queryable: `ListModelsRequest` to `ListModelsResponse`."""
    return f"{ROOT}/planner/{planner}/list_models"


def trainer_start_run(trainer: str) -> str:
    """Queryable: `StartRunRequest` to `StartRunResponse`."""
    return f"{ROOT}/trainer/{trainer}/start_run"


def trainer_stop_run(trainer: str) -> str:
    """Queryable: `StopRunRequest` to `StopRunResponse`."""
    return f"{ROOT}/trainer/{trainer}/stop_run"


def trainer_list_runs(trainer: str) -> str:
    """Queryable: `ListRunsRequest` to `ListRunsResponse`."""
    return f"{ROOT}/trainer/{trainer}/list_runs"


def training_progress(run: str) -> str:
    """Put of the trainer: `Run`."""
    return f"{ROOT}/training/{run}/progress"


def trainer_alive(trainer: str) -> str:
    """Liveliness token of a trainer's service that is ready."""
    return f"{ROOT}/alive/trainer/{trainer}"


def planner_alive(planner: str) -> str:
    """Liveliness token of a planner that is ready."""
    return f"{ROOT}/alive/planner/{planner}"


def checkpoint_announcement(model: str) -> str:
    """Put: `CheckpointAnnouncement`."""
    return f"{ROOT}/checkpoint/{model}/announcement"


def checkpoint_chunk(digest: str) -> str:
    """Queryable of the trainer: `CheckpointChunkRequest` to `CheckpointChunkResponse`."""
    return f"{ROOT}/checkpoint/{digest}/chunk"


def checkpoint_list_versions(model: str) -> str:
    """Queryable of the trainer: `ListVersionsRequest` to `ListVersionsResponse`."""
    return f"{ROOT}/checkpoint/{model}/list_versions"


def checkpoint_promote(model: str) -> str:
    """Queryable of the trainer: `PromoteVersionRequest` to `PromoteVersionResponse`."""
    return f"{ROOT}/checkpoint/{model}/promote"


def checkpoint_roll_back(model: str) -> str:
    """Queryable of the trainer: `RollBackRequest` to `RollBackResponse`."""
    return f"{ROOT}/checkpoint/{model}/roll_back"

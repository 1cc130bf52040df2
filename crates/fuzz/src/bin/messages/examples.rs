//! A valid message of each type.

use crate::round_trip;
use std::sync::LazyLock;
use std::time::Duration;
use wire::checkpoint::*;
use wire::demonstration::*;
use wire::planner::*;
use wire::sim::*;
use wire::training::*;
use wire::trial::*;
use wire::{Error, Image, Message, Position, encode};

/// Check of a message type, and the bytes of a message.
type Example = (fn(&[u8]) -> Result<(), Error>, Vec<u8>);

pub static EXAMPLES: LazyLock<Vec<Example>> = LazyLock::new(|| {
    [planner(), simulator(), demonstrations(), checkpoints(), training()].into_iter().flatten().collect()
});

fn example<M: Message>(message: M) -> Example {
    (round_trip::<M>, encode(message))
}

fn planner() -> Vec<Example> {
    let model = ModelInfo {
        name: "cpn".into(),
        method: "cpn".into(),
        digest: digest(),
        training_tasks: vec!["reach".into()],
        horizon: 5,
        version: 1,
    };
    let plan = |goal, observation| PlanRequest::new("cpn", goal, observation);
    let search = Search { solver: Solver::Hybrid, iterations: Some(4), samples: Some(64), anytime: true };
    vec![
        example(plan(Goal::Image(image()), image().into())),
        example(plan(Goal::Position(position()), position().into())),
        example(PlanRequest {
            seed: 7,
            deadline: Some(Duration::from_millis(50)),
            model_digest: Some(digest()),
            search: Some(search),
            warm_start: vec![action(); 2],
            steps_left: Some(70),
            ..plan(Goal::Id(digest()), image().into())
        }),
        example(PlanRequest { approach: Some(approach()), ..plan(Goal::Image(image()), image().into()) }),
        example(plan_response()),
        example(RegisterGoalRequest { image: image() }),
        example(RegisterGoalResponse { goal_id: digest() }),
        example(LoadModelRequest { model: "cpn".into(), source: CheckpointSource::File("cpn.safetensors".into()) }),
        example(LoadModelRequest { model: "cpn".into(), source: CheckpointSource::Bytes(vec![7; 9]) }),
        example(LoadModelResponse { model: model.clone() }),
        example(UnloadModelRequest { model: "cpn".into() }),
        example(UnloadModelResponse),
        example(ListModelsRequest),
        example(ListModelsResponse { models: vec![model; 2] }),
        example(RecordedTrial {
            variation: variation(),
            model: "cpn".into(),
            model_digest: digest(),
            goal: image(),
            goal_position: Some(position()),
            steps: 3,
            plans: 2,
        }),
        example(TrialPlan { episode_id: "reach-5".into(), step: 3, model: "cpn".into(), plan: plan_response() }),
    ]
}

fn plan_response() -> PlanResponse {
    PlanResponse {
        actions: vec![action(); 2],
        first_action: action(),
        inner_losses: vec![0.5, 0.25],
        latent_distance: Some(1.5),
        times: StageTimes { queue_seconds: 0.1, encode_seconds: 0.2, plan_seconds: 0.3 },
        model_digest: digest(),
        goal_id: digest(),
        iterations: 1,
        iterations_run: 2,
        warm_start: vec![action(); 2],
        approach: Some(approach()),
    }
}

fn approach() -> Approach {
    Approach { tried: 1, position: [0.5; 3], plans: 2 }
}

fn simulator() -> Vec<Example> {
    vec![
        example(ResetRequest { variation: variation(), goal_seed: Some(6) }),
        example(ResetResponse {
            episode_id: "reach-5".into(),
            goal: image(),
            observation: image(),
            max_steps: 200,
            goal_position: Some(position()),
            hand_position: position(),
            goal_hand_position: position(),
            success: false,
            progress: 0.25,
            control: Control { action_size: 4, metres: 0.01, hz: 80.0 },
        }),
        example(StepRequest { episode_id: "reach-5".into(), step: 3, action: action() }),
        example(StepResponse {
            observation: image(),
            reward: 0.5,
            success: true,
            done: true,
            hand_position: position(),
            progress: 1.0,
        }),
    ]
}

fn demonstrations() -> Vec<Example> {
    let episode = RecordedEpisode {
        episode_id: "reach-5".into(),
        variation: variation(),
        steps: 9,
        digest: digest(),
        goal_position: vec![0.0, 0.5, 0.25],
        control_hz: 80.0,
        render_spec: r#"{"camera":"corner"}"#.into(),
    };
    let step = RecordedStep {
        step: 3,
        action: Some(action()),
        applied_action: Some(action()),
        state: vec![0.5; 4],
        reward: 0.5,
        success: true,
    };
    vec![
        example(step.clone().with_frame("reach-5".into(), image())),
        example(step),
        example(episode.clone()),
        example(CommitEpisodeRequest { episode }),
        example(CommitEpisodeResponse { missing_steps: vec![1, 2] }),
    ]
}

fn checkpoints() -> Vec<Example> {
    let model = || "cpn".to_owned();
    let manifest = CheckpointManifest {
        model: model(),
        version: 1,
        digest: digest(),
        size_bytes: 9,
        config_digest: digest(),
        parents: vec![digest()],
        signature_bundle: Some("{}".into()),
    };
    let version = CheckpointVersion { manifest: manifest.clone(), promoted: true };
    vec![
        example(manifest.clone()),
        example(CheckpointAnnouncement { manifest: manifest.clone(), promoted_unix_nanos: 1 }),
        example(CheckpointChunkRequest { digest: digest(), offset_bytes: 1, length_bytes: 9 }),
        example(CheckpointChunkResponse { data: vec![7; 9] }),
        example(ListVersionsRequest { model: Some(model()) }),
        example(ListVersionsResponse { versions: vec![version; 2] }),
        example(PromoteVersionRequest { model: model(), version: 1 }),
        example(PromoteVersionResponse { manifest: manifest.clone() }),
        example(RollBackRequest { model: model() }),
        example(RollBackResponse { manifest }),
    ]
}

fn training() -> Vec<Example> {
    let name = || "cpn".to_owned();
    let progress = Progress {
        step: 3,
        steps: 9,
        epoch: 1,
        epochs: 3,
        samples: 12,
        loss: 0.5,
        learning_rate: 1e-3,
        gradient_norm: 2.0,
        samples_per_second: 100.0,
    };
    let run = Run { name: name(), state: RunState::Finished { digest: digest() }, progress: Some(progress) };
    let failed = Run { name: name(), state: RunState::Failed { reason: "no data".into() }, progress: None };
    vec![
        example(run.clone()),
        example(StartRunRequest {
            name: name(),
            preset: Some("paper-cpn".into()),
            hold_out: vec!["reach".into()],
            seed: Some(7),
            settings: "training.epochs = 10".into(),
        }),
        example(StartRunResponse { run: run.clone() }),
        example(StopRunRequest { name: name() }),
        example(StopRunResponse { run: failed.clone() }),
        example(ListRunsRequest),
        example(ListRunsResponse { runs: vec![run.clone(), failed] }),
        example(WatchRunRequest { name: name() }),
        example(WatchRunResponse { run }),
    ]
}

fn image() -> Image {
    let image = Image::new(1, 2, vec![7; 6]).expect("an image");
    image.rendered_as(r#"{"camera":"corner"}"#).expect("a short spec")
}

fn position() -> Position {
    Position::new([0.5, -0.25, 0.125]).expect("a position")
}

fn action() -> Vec<f32> {
    vec![0.25, -1.0]
}

fn variation() -> Variation {
    Variation { task: "reach".into(), seed: 5 }
}

fn digest() -> String {
    "0".repeat(64)
}

//! Round trip of every message through its encoding, and decoders on arbitrary bytes.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use std::time::Duration;
use wire::checkpoint::*;
use wire::demonstration::*;
use wire::planner::*;
use wire::sim::*;
use wire::training::*;
use wire::trial::*;
use wire::{Image, Message, Position, decode, encode};

fn image() -> impl Strategy<Value = Image> {
    (1u32..6, 1u32..6, "\\PC{0,20}").prop_flat_map(|(height, width, spec)| {
        vec(any::<u8>(), (height * width * 3) as usize)
            .prop_map(move |data| Image::new(height, width, data).unwrap().rendered_as(spec.clone()).unwrap())
    })
}

fn name() -> &'static str {
    "[a-z0-9_-][a-z0-9._-]{0,20}"
}

fn digest() -> &'static str {
    "[0-9a-f]{64}"
}

fn action() -> impl Strategy<Value = Vec<f32>> {
    vec(-1.0f32..1.0, 1..6)
}

fn position() -> impl Strategy<Value = Vec<f32>> {
    prop_oneof![Just(Vec::new()), vec(-1.0f32..1.0, 3)]
}

fn approach() -> impl Strategy<Value = Approach> {
    (any::<u32>(), proptest::array::uniform3(-1000.0f32..=1000.0), any::<u32>())
        .prop_map(|(tried, position, plans)| Approach { tried, position, plans })
}

fn point() -> impl Strategy<Value = Position> {
    proptest::array::uniform3(-1000.0f32..=1000.0).prop_map(|metres| Position::new(metres).unwrap())
}

fn control() -> impl Strategy<Value = Control> {
    (3u32..=64, 1e-3..1.0, 1.0..1e3).prop_map(|(action_size, metres, hz)| Control { action_size, metres, hz })
}

fn search() -> impl Strategy<Value = Search> {
    let solver = prop_oneof![Just(Solver::Gradient), Just(Solver::Cem), Just(Solver::Mppi), Just(Solver::Hybrid)];
    (solver, option::of(0u32..=1000), option::of(2u32..=4096), any::<bool>()).prop_map(
        |(solver, iterations, samples, anytime)| Search {
            solver,
            iterations,
            samples: samples.filter(|_| solver != Solver::Gradient),
            anytime,
        },
    )
}

fn recorded() -> impl Strategy<Value = RecordedEpisode> {
    (name(), variation(), 2..=MAX_STEPS, digest(), position(), 0.1..100.0, "\\PC{0,30}").prop_map(
        |(episode_id, variation, steps, digest, goal_position, control_hz, render_spec)| RecordedEpisode {
            episode_id,
            variation,
            steps,
            digest,
            goal_position,
            control_hz,
            render_spec,
        },
    )
}

fn info() -> impl Strategy<Value = ModelInfo> {
    (name(), "[a-z-]{2,6}", digest(), vec(name(), 0..3), any::<u32>(), any::<u32>()).prop_map(
        |(name, method, digest, training_tasks, horizon, version)| ModelInfo {
            name,
            method,
            digest,
            training_tasks,
            horizon,
            version,
        },
    )
}

fn manifest() -> impl Strategy<Value = CheckpointManifest> {
    let bundle = option::of("\\PC{1,40}");
    (name(), 1u32.., digest(), any::<u64>(), digest(), vec(digest(), 0..3), bundle).prop_map(
        |(model, version, digest, size_bytes, config_digest, parents, signature_bundle)| CheckpointManifest {
            model,
            version,
            digest,
            size_bytes,
            config_digest,
            parents,
            signature_bundle,
        },
    )
}

fn variation() -> impl Strategy<Value = Variation> {
    (name(), any::<u64>()).prop_map(|(task, seed)| Variation { task, seed })
}

fn progress() -> impl Strategy<Value = Progress> {
    ((any::<u64>(), 1u64.., any::<u64>(), any::<u64>(), any::<u64>()), (-9.0..9.0, 0.0..1.0, 0.0..9.0, 0.0..1e6))
        .prop_map(
            |((step, steps, epoch, epochs, samples), (loss, learning_rate, gradient_norm, samples_per_second))| {
                Progress { step, steps, epoch, epochs, samples, loss, learning_rate, gradient_norm, samples_per_second }
            },
        )
}

fn run() -> impl Strategy<Value = Run> {
    let state = prop_oneof![
        Just(RunState::Running),
        digest().prop_map(|digest| RunState::Finished { digest }),
        Just(RunState::Stopped),
        "\\PC{0,40}".prop_map(|reason| RunState::Failed { reason }),
        Just(RunState::Interrupted),
    ];
    (name(), state, option::of(progress())).prop_map(|(name, state, progress)| Run { name, state, progress })
}

fn survives<M: Message + Clone + PartialEq + std::fmt::Debug>(message: M) {
    assert_eq!(decode::<M>(&encode(message.clone())).unwrap(), message);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn plan_request(
        model in name(),
        goal in prop_oneof![
            digest().prop_map(Goal::Id),
            image().prop_map(Goal::Image),
            point().prop_map(Goal::Position),
        ],
        observation in prop_oneof![image().prop_map(Into::into), point().prop_map(Into::into)],
        seed in any::<u64>(),
        deadline in option::of((1u64..u64::from(u32::MAX)).prop_map(Duration::from_millis)),
        model_digest in option::of(digest()),
        search in option::of(search()),
        warm_start in vec(action(), 0..6),
        steps_left in option::of(1..=MAX_STEPS_LEFT),
        approach in option::of(approach()),
    ) {
        // An anytime search needs a deadline.
        let deadline = deadline.or_else(|| search?.anytime.then_some(Duration::from_millis(1)));
        // An approach comes without a search and a warm start.
        let approach = approach.filter(|_| search.is_none() && warm_start.is_empty());
        let request =
            PlanRequest { model, goal, observation, seed, deadline, model_digest, search, warm_start, steps_left, approach };
        survives(request);
    }

    #[test]
    fn plan_response(
        actions in vec(action(), 0..6),
        first_action in action(),
        inner_losses in vec(0.0f32..9.0, 0..4),
        latent_distance in option::of(0.0f32..9.0),
        (queue_seconds, encode_seconds, plan_seconds) in (0.0..1.0, 0.0..1.0, 0.0..1.0),
        model_digest in digest(),
        goal_id in digest(),
        (iterations, iterations_run) in any::<(u32, u32)>(),
        warm_start in vec(action(), 0..6),
        approach in option::of(approach()),
        (episode_id, model) in (".{0,20}", name()),
    ) {
        let times = StageTimes { queue_seconds, encode_seconds, plan_seconds };
        let plan = PlanResponse {
            actions,
            first_action,
            inner_losses,
            latent_distance,
            times,
            model_digest,
            goal_id,
            iterations,
            iterations_run,
            warm_start,
            approach,
        };
        survives(plan.clone());
        survives(TrialPlan { episode_id, step: iterations, model, plan });
    }

    #[test]
    fn trials(
        variation in variation(),
        model in name(),
        (model_digest, plans) in prop_oneof![(digest(), 0u32..), Just((String::new(), 0))],
        goal in image(),
        goal_position in option::of(point()),
        steps in 1u32..,
    ) {
        survives(RecordedTrial { variation, model, model_digest, goal, goal_position, steps, plans });
    }

    #[test]
    fn goals_and_models(
        image in image(),
        goal_id in digest(),
        model in name(),
        source in prop_oneof![
            name().prop_map(CheckpointSource::File),
            vec(any::<u8>(), 0..50).prop_map(CheckpointSource::Bytes),
        ],
        models in vec(info(), 0..3),
        info in info(),
    ) {
        survives(RegisterGoalRequest { image });
        survives(RegisterGoalResponse { goal_id });
        survives(LoadModelRequest { model: model.clone(), source });
        survives(UnloadModelRequest { model });
        survives(UnloadModelResponse);
        survives(LoadModelResponse { model: info });
        survives(ListModelsRequest);
        survives(ListModelsResponse { models });
    }

    #[test]
    fn simulator(
        variation in variation(),
        episode_id in name(),
        (goal, observation) in (image(), image()),
        step in any::<u32>(),
        action in action(),
        reward in -9.0..9.0,
        (success, done) in any::<(bool, bool)>(),
        (goal_position, hand_position, goal_hand_position) in (option::of(point()), point(), point()),
        (progress, control) in (0.0..=1.0, control()),
    ) {
        survives(ResetRequest { variation, goal_seed: success.then_some(u64::from(step)) });
        survives(StepRequest { episode_id: episode_id.clone(), step, action });
        survives(StepResponse { observation: observation.clone(), reward, success, done, hand_position, progress });
        survives(ResetResponse {
            episode_id,
            goal,
            observation,
            max_steps: step,
            goal_position,
            hand_position,
            goal_hand_position,
            success,
            progress,
            control,
        });
    }

    #[test]
    fn demonstrations(
        episode in recorded(),
        frame in image(),
        (action, applied_action) in (option::of(action()), option::of(action())),
        (state, reward, success) in (vec(-9.0f32..9.0, 0..40), -9.0f32..9.0, any::<bool>()),
        step in 0..MAX_STEPS,
        missing_steps in vec(any::<u32>(), 0..5),
    ) {
        let recorded = RecordedStep { step, action, applied_action, state, reward, success };
        survives(recorded.clone());

        survives(recorded.with_frame(episode.episode_id.clone(), frame));
        survives(episode.clone());
        survives(CommitEpisodeRequest { episode });
        survives(CommitEpisodeResponse { missing_steps });
    }

    #[test]
    fn checkpoints(
        manifest in manifest(),
        (digest, offset_bytes, length_bytes) in (digest(), any::<u64>(), 1..=MAX_CHUNK_BYTES),
        data in vec(any::<u8>(), 0..50),
        versions in vec((manifest(), any::<bool>()), 0..3),
        model in name(),
        version in 1u32..,
        promoted_unix_nanos in any::<u64>(),
    ) {
        let versions = versions.into_iter().map(|(manifest, promoted)| CheckpointVersion { manifest, promoted });
        survives(manifest.clone());
        survives(CheckpointAnnouncement { manifest: manifest.clone(), promoted_unix_nanos });
        survives(CheckpointChunkRequest { digest, offset_bytes, length_bytes });
        survives(CheckpointChunkResponse { data });
        survives(ListVersionsRequest { model: None });
        survives(ListVersionsRequest { model: Some(model.clone()) });
        survives(ListVersionsResponse { versions: versions.collect() });
        survives(PromoteVersionRequest { model: model.clone(), version });
        survives(PromoteVersionResponse { manifest: manifest.clone() });
        survives(RollBackRequest { model });
        survives(RollBackResponse { manifest });
    }

    #[test]
    fn training(
        name in name(),
        preset in option::of(name()),
        hold_out in vec(name(), 0..3),
        seed in option::of(any::<u64>()),
        settings in "\\PC{0,40}",
        run in run(),
        runs in vec(run(), 0..3),
    ) {
        survives(run.clone());
        survives(StartRunRequest { name: name.clone(), preset, hold_out, seed, settings });
        survives(StartRunResponse { run: run.clone() });
        survives(StopRunRequest { name: name.clone() });
        survives(StopRunResponse { run: run.clone() });
        survives(ListRunsRequest);
        survives(ListRunsResponse { runs });
        survives(WatchRunRequest { name });
        survives(WatchRunResponse { run });
    }

    #[test]
    fn any_bytes_are_refused_or_decoded(bytes in vec(any::<u8>(), 0..200)) {
        let _ = decode::<PlanRequest>(&bytes);
        let _ = decode::<LoadModelRequest>(&bytes);
        let _ = decode::<ResetResponse>(&bytes);
        let _ = decode::<DemonstrationStep>(&bytes);
        let _ = decode::<CommitEpisodeRequest>(&bytes);
        let _ = decode::<RecordedEpisode>(&bytes);
        let _ = decode::<RecordedTrial>(&bytes);
        let _ = decode::<CheckpointAnnouncement>(&bytes);
        let _ = decode::<ListVersionsResponse>(&bytes);
        let _ = decode::<StartRunRequest>(&bytes);
        let _ = decode::<Run>(&bytes);
    }
}

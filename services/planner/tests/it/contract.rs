//! Contract of all transports: the same request gets the same answer.

use crate::common::{
    self, Client, Fixture, checkpoint, checkpoint_for, from_bytes, from_file, image, plan_request, position_checkpoint,
    position_request, timeless,
};
use cpn::MethodKind;
use planner::model::RANDOM;
use wire::planner::{ModelInfo, PlanResponse};
use wire::proto::plan_request::{Goal, Observed};
use wire::{Code, Error, proto};

const MODELS: [&str; 6] = ["bc", "cpn", RANDOM, "te-bc", "te-bc-horizon", "upn"];

async fn start() -> Fixture {
    let checkpoints = MethodKind::ALL.map(|method| (method.name(), checkpoint(method, 1)));
    Fixture::start(&checkpoints, |_| ()).await
}

/// Answers of a planner to valid requests of every kind.
async fn answers(client: &Client) -> (Vec<PlanResponse>, Vec<ModelInfo>, String) {
    let models = client.list_models().await.unwrap().models;
    let register = proto::RegisterGoalRequest { image: Some(image(0)) };
    let goal_id = client.register_goal(register.clone()).await.unwrap().goal_id;
    assert_eq!(client.register_goal(register).await.unwrap().goal_id, goal_id, "the same image, the same id");
    let mut plans = Vec::new();
    for model in MODELS {
        let by_image = client.plan(plan_request(model, 3)).await.unwrap();
        let by_id = proto::PlanRequest { goal: Some(Goal::GoalId(goal_id.clone())), ..plan_request(model, 3) };
        for _ in 0..2 {
            let plan = client.plan(by_id.clone()).await.unwrap();
            let times = plan.times;
            assert!(times.queue_seconds > 0.0 && times.encode_seconds > 0.0 && times.plan_seconds > 0.0, "{times:?}");
            assert_eq!(timeless(plan), timeless(by_image.clone()), "{model}: by image or by id, cached or not");
        }
        assert_eq!(by_image.goal_id, goal_id);
        plans.push(timeless(by_image));
    }
    (plans, models, goal_id)
}

#[tokio::test(flavor = "multi_thread")]
async fn every_transport_gives_the_same_answers() {
    let fixture = start().await;
    let [in_process, others @ ..] = fixture.clients();
    let expected = answers(&in_process).await;
    for client in others {
        assert_eq!(answers(&client).await, expected, "{}", client.transport());
    }

    let (plans, models, _) = expected;
    assert_eq!(models.iter().map(|info| info.name.as_str()).collect::<Vec<_>>(), MODELS);
    for (plan, info) in plans.iter().zip(&models) {
        assert_eq!(info.method, info.name);
        assert_eq!(plan.model_digest, info.digest);
        assert_eq!(plan.actions.len(), info.horizon as usize, "{}", info.name);
        let clipped: Vec<f32> = plan.actions[0].iter().map(|v| v.clamp(-1.0, 1.0)).collect();
        assert_eq!(plan.first_action, clipped);
        let (losses, distance) = match info.name.as_str() {
            "upn" | "cpn" => (2, true),
            RANDOM => (0, false),
            _ => (0, true),
        };
        assert_eq!((plan.inner_losses.len(), plan.latent_distance.is_some()), (losses, distance), "{}", info.name);
        let tasks: &[&str] = if info.name == RANDOM { &[] } else { &["door-lock", "reach"] };
        assert_eq!(info.training_tasks, tasks);
    }
    fixture.planner.shutdown().await.unwrap();
}

/// Request with one fault.
fn spoiled(spoil: impl FnOnce(&mut proto::PlanRequest)) -> proto::PlanRequest {
    let mut request = plan_request("cpn", 3);
    spoil(&mut request);
    request
}

fn smaller(side: u32) -> proto::Image {
    let data = vec![0; (side * 84 * 3) as usize];
    proto::Image { height: side, data, ..image(0) }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_transport_refuses_alike() {
    let fixture = start().await;
    let unregistered = "0".repeat(64);
    let cases = [
        (
            spoiled(|r| r.observed = Some(Observed::Observation(smaller(83)))),
            Error::invalid("observation.height", 84, 83),
        ),
        (
            spoiled(|r| r.goal = Some(Goal::GoalImage(proto::Image { width: 42, height: 168, ..image(0) }))),
            Error::invalid("goal_image.height", 84, 168),
        ),
        (
            spoiled(|r| r.observed = Some(Observed::Observation(proto::Image { data: vec![0; 10], ..image(0) }))),
            Error::invalid("observation.data", "21168 bytes", "10 bytes"),
        ),
        (
            spoiled(|r| r.observed = Some(Observed::Observation(proto::Image { format: 0, ..image(0) }))),
            Error::invalid("observation.format", "PIXEL_FORMAT_RGB8", "PIXEL_FORMAT_UNSPECIFIED"),
        ),
        (spoiled(|r| r.observed = None), Error::invalid("observation", "a value", "none")),
        (spoiled(|r| r.goal = None), Error::invalid("goal", "a value", "none")),
        (
            spoiled(|r| r.model = "gpt".into()),
            Error::new(Code::NotFound, "model", "one of bc, cpn, random, te-bc, te-bc-horizon, upn", "gpt"),
        ),
        (
            spoiled(|r| r.goal = Some(Goal::GoalId(unregistered.clone()))),
            Error::new(Code::NotFound, "goal_id", "one of the 1024 goals registered last", &unregistered),
        ),
    ];
    for client in fixture.clients() {
        let transport = client.transport();
        for (request, error) in &cases {
            assert_eq!(client.plan(request.clone()).await.unwrap_err(), *error, "{transport}");
            client.plan(plan_request("cpn", 3)).await.unwrap();
        }
        let goal = proto::RegisterGoalRequest { image: Some(smaller(1)) };
        assert_eq!(client.register_goal(goal).await.unwrap_err(), Error::invalid("image.height", 84, 1), "{transport}");
        let loads = [
            (from_bytes(RANDOM, Vec::new()), Code::FailedPrecondition, "model"),
            (from_bytes("cpn", vec![7; 99]), Code::InvalidArgument, "checkpoint"),
            (from_file("cpn", "absent.safetensors"), Code::NotFound, "file"),
            (from_file("cpn", "../cpn.safetensors"), Code::InvalidArgument, "file"),
        ];
        for (request, code, field) in loads {
            let error = client.load_model(request).await.unwrap_err();
            assert_eq!((error.code, error.field.as_str()), (code, field), "{transport}: {error}");
        }
        client.plan(plan_request("cpn", 3)).await.unwrap();
    }
}

/// The number of steps left is required by the model that takes it, whose plans depend on it, and ignored by the others.
#[tokio::test(flavor = "multi_thread")]
async fn every_transport_passes_the_steps_left() {
    let fixture = start().await;
    for client in fixture.clients() {
        let transport = client.transport();
        for model in MODELS {
            let plan =
                async |steps_left| client.plan(proto::PlanRequest { steps_left, ..plan_request(model, 3) }).await;
            let [near, far] = [plan(Some(1)).await, plan(Some(10_000)).await].map(|plan| plan.unwrap().actions);
            let without = plan(None).await.map(|plan| plan.actions);
            if model == "te-bc-horizon" {
                assert_ne!(near, far, "{transport}");
                let expected = "the number of steps that remain for the task";
                assert_eq!(without, Err(Error::invalid("steps_left", expected, "none")), "{transport}");
            } else {
                assert_eq!((&near, Ok(&near)), (&far, without.as_ref()), "{transport}, {model}");
            }
            assert_eq!(plan(Some(0)).await.unwrap_err(), Error::invalid("steps_left", "1 to 10000", 0), "{transport}");
        }
    }
}

/// Images with different render specs are refused, also when the model's training images had another.
#[tokio::test(flavor = "multi_thread")]
async fn every_transport_refuses_mixed_render_specs() {
    // As long as real ones, since an error must have room for two.
    let [soft, hard] =
        ["soft", "hard"].map(|shadows| format!("{{\"shadows\":\"{shadows}\",\"x\":\"{}\"}}", "x".repeat(300)));
    let checkpoints = [("cpn", checkpoint(MethodKind::Cpn, 1)), ("soft", checkpoint_for(MethodKind::Cpn, 1, &soft))];
    let fixture = Fixture::start(&checkpoints, |_| ()).await;
    let look = |spec: &str, seed| proto::Image { render_spec: spec.into(), ..image(seed) };
    let request = |model: &str, goal: &str, observation: &str| proto::PlanRequest {
        goal: Some(Goal::GoalImage(look(goal, 0))),
        observed: Some(Observed::Observation(look(observation, 3))),
        ..plan_request(model, 3)
    };
    let (observation, goal_image) = ("observation.render_spec", "goal_image.render_spec");
    let refused = |field: &str| Error::new(Code::FailedPrecondition, field, &soft, &hard);
    for client in fixture.clients() {
        let transport = client.transport();
        for (model, goal, shown, field) in [
            ("soft", &*soft, &*hard, observation),
            ("soft", "", &hard, observation),
            ("soft", &hard, &soft, goal_image),
            ("soft", &hard, &hard, goal_image),
            ("cpn", &soft, &hard, observation),
            (RANDOM, &soft, &hard, observation),
        ] {
            let error = client.plan(request(model, goal, shown)).await.unwrap_err();
            assert_eq!(error, refused(field), "{transport}, {model}");
        }
        let register = proto::RegisterGoalRequest { image: Some(look(&hard, 0)) };
        let goal_id = client.register_goal(register).await.unwrap().goal_id;
        let by_id = proto::PlanRequest { goal: Some(Goal::GoalId(goal_id)), ..request("soft", "", &soft) };
        assert_eq!(client.plan(by_id).await.unwrap_err(), refused("goal_id"), "{transport}");
        for (model, goal, shown) in
            [("soft", &*soft, &*soft), ("soft", "", ""), ("soft", "", &soft), ("cpn", &hard, &hard), ("cpn", "", &soft)]
        {
            client.plan(request(model, goal, shown)).await.unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_have_their_grpc_statuses() {
    let fixture = start().await;
    let [_, Client::Grpc(mut grpc), _] = fixture.clients() else { unreachable!() };
    for (request, code) in [
        (spoiled(|r| r.goal = None), tonic::Code::InvalidArgument),
        (spoiled(|r| r.model = "gpt".into()), tonic::Code::NotFound),
    ] {
        assert_eq!(grpc.plan(request).await.unwrap_err().code(), code);
    }
    let status = grpc.load_model(from_bytes(RANDOM, Vec::new())).await.unwrap_err();
    assert_eq!(status.code(), tonic::Code::FailedPrecondition);
    assert_eq!(status.message(), "model: expected a name other than random, got random");
}

/// The least recently used goal is evicted; its client, told so, registers it again.
#[tokio::test(flavor = "multi_thread")]
async fn the_least_recently_used_goal_is_evicted() {
    let fixture = Fixture::start(&[], |config| config.goal_capacity = 2.try_into().unwrap()).await;
    let [client, ..] = fixture.clients();
    let mut ids = Vec::new();
    for seed in 0..3 {
        let request = proto::RegisterGoalRequest { image: Some(image(seed)) };
        ids.push(client.register_goal(request).await.unwrap().goal_id);
    }
    let towards = |id: &String| spoiled(|r| (r.model, r.goal) = (RANDOM.into(), Some(Goal::GoalId(id.clone()))));
    common::is(Code::NotFound, "goal_id", client.plan(towards(&ids[0])).await);
    for id in &ids[1..] {
        assert_eq!(client.plan(towards(id)).await.unwrap().goal_id, *id);
    }
}

/// Plans between positions, over every transport; positions and images are not accepted for each other.
#[tokio::test(flavor = "multi_thread")]
async fn every_transport_plans_between_positions() {
    let checkpoints = [("cpn", checkpoint(MethodKind::Cpn, 1)), ("jenga", position_checkpoint(1))];
    let fixture = Fixture::start(&checkpoints, |_| ()).await;
    let request = position_request("jenga");
    let expected = timeless(fixture.clients()[0].plan(request.clone()).await.unwrap());
    assert_eq!((expected.actions.len(), expected.first_action.len(), expected.inner_losses.len()), (5, 3, 2));
    let of_position = request.observed.clone();
    let spoiled = |spoil: &dyn Fn(&mut proto::PlanRequest)| {
        let mut request = request.clone();
        spoil(&mut request);
        request
    };
    let (black, picture) = (Goal::GoalImage(image(0)), Some(Observed::Observation(image(1))));
    let nowhere = proto::Position { x: f32::NAN, ..Default::default() };
    let cases = [
        (spoiled(&|r| r.goal = Some(black.clone())), Error::invalid("goal_image", "a position", "an image")),
        (spoiled(&|r| r.observed = picture.clone()), Error::invalid("observation", "a position", "an image")),
        (position_request("cpn"), Error::invalid("goal_position", "an image", "a position")),
        (
            proto::PlanRequest { observed: of_position.clone(), ..plan_request("cpn", 3) },
            Error::invalid("position", "an image", "a position"),
        ),
        (
            spoiled(&|r| r.observed = Some(Observed::Position(nowhere))),
            Error::invalid("position.x", "-1000 to 1000 metres", "NaN"),
        ),
    ];
    for client in fixture.clients() {
        let transport = client.transport();
        let plan = client.plan(request.clone()).await.unwrap();
        assert_eq!(timeless(plan.clone()), expected, "{transport}");
        let by_id = spoiled(&|r| r.goal = Some(Goal::GoalId(plan.goal_id.clone())));
        assert_eq!(timeless(client.plan(by_id).await.unwrap()), expected, "{transport}: a goal's id stands for it");
        let other = Goal::GoalPosition(proto::Position { x: 0.73, y: 0.09, z: 0.42 });
        let other = client.plan(spoiled(&|r| r.goal = Some(other.clone()))).await.unwrap();
        assert_ne!(other.actions, expected.actions, "{transport}: the goal counts");
        for (request, error) in &cases {
            assert_eq!(client.plan(request.clone()).await.unwrap_err(), *error, "{transport}");
        }
        // The random baseline accepts both.
        client.plan(position_request(RANDOM)).await.unwrap();
    }
    fixture.planner.shutdown().await.unwrap();
}

//! Searches chosen by requests, over every transport.

use crate::common::{
    self, Client, Fixture, PATIENCE, checkpoint, from_bytes, image, is, plan_request, serve, soon, timeless,
};
use cpn::method::{Observed, Ongoing, Query};
use cpn::{Input, Method, MethodKind, Model, ModelConfig, Plan, Planner, Precision};
use planner::model::RANDOM;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use testing::{provenance, small_config};
use wire::Code;
use wire::planner::{Approach, PlanResponse};
use wire::proto::{self, Solver};

const SOLVERS: [Solver; 4] = [Solver::Gradient, Solver::Cem, Solver::Mppi, Solver::Hybrid];

fn search(solver: Solver, iterations: impl Into<Option<u32>>, anytime: bool) -> Option<proto::Search> {
    let samples = if solver == Solver::Gradient { 0 } else { 32 };
    Some(proto::Search { solver: solver.into(), iterations: iterations.into(), samples, anytime })
}

fn actions(actions: &[Vec<f32>]) -> Vec<proto::Action> {
    actions.iter().map(|values| proto::Action { values: values.clone() }).collect()
}

async fn fixture() -> Fixture {
    Fixture::start(&[("cpn", checkpoint(MethodKind::Cpn, 1)), ("te-bc", checkpoint(MethodKind::TeBc, 1))], |_| ()).await
}

#[tokio::test(flavor = "multi_thread")]
async fn every_solver_is_deterministic_and_uses_the_warm_start() {
    let fixture = fixture().await;
    for solver in SOLVERS {
        let request = proto::PlanRequest { search: search(solver, 3, false), ..plan_request("cpn", 3) };
        let mut first: Option<PlanResponse> = None;
        for client in fixture.clients() {
            let plan = timeless(client.plan(request.clone()).await.unwrap());
            assert_eq!((plan.iterations_run, plan.inner_losses.len()), (3, 4), "{solver:?}");
            assert_eq!(plan.warm_start.len(), plan.actions.len());
            assert_eq!(plan.warm_start[..plan.actions.len() - 1], plan.actions[1..]);
            assert_eq!(&plan, first.get_or_insert(plan.clone()), "{solver:?} over {}", client.transport());
            let on = proto::PlanRequest { warm_start: actions(&plan.actions), ..request.clone() };
            let on = client.plan(on).await.unwrap();
            // The last inner loss is the first of a search warm-started from this plan.
            assert_eq!(on.inner_losses[0], plan.inner_losses[3], "{solver:?} over {}", client.transport());
        }
    }
    let [client, ..] = fixture.clients();
    let plain = timeless(client.plan(plan_request("cpn", 3)).await.unwrap());
    let trained = proto::PlanRequest { search: search(Solver::Gradient, None, false), ..plan_request("cpn", 3) };
    assert_eq!(timeless(client.plan(trained).await.unwrap()), plain, "the gradient is the model's own way");
}

/// Checkpoint whose one familiar goal is the image of seed 0.
fn familiar_checkpoint(config: ModelConfig) -> Vec<u8> {
    let mut model = Model::new(config, 1);
    let embeddings = Planner::new(&model, Precision::Float32, 1).encode(&[Observed::Image(&image(0).data)]);
    model.set_familiar_goals(&embeddings);
    cpn::checkpoint::to_bytes(&model, &provenance(&["reach"], 1)).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_familiar_goal_keeps_the_policys_plan_unless_the_request_says_otherwise() {
    let config = ModelConfig { familiar_goals: 1, ..small_config(MethodKind::Cpn) };
    let fixture = Fixture::start(&[("cpn", familiar_checkpoint(config))], |_| ()).await;
    for client in fixture.clients() {
        let plan = async |request: proto::PlanRequest| timeless(client.plan(request).await.unwrap());
        let request = plan_request("cpn", 3);
        let policy = plan(proto::PlanRequest { search: search(Solver::Gradient, 0, false), ..request.clone() }).await;
        let updated =
            plan(proto::PlanRequest { search: search(Solver::Gradient, None, false), ..request.clone() }).await;
        assert_ne!(policy.actions, updated.actions);
        assert_eq!((updated.iterations, updated.iterations_run), (1, 1));

        let kept = plan(request.clone()).await;
        assert_eq!((&kept.actions, kept.iterations, kept.iterations_run), (&policy.actions, 0, 1));
        let by_id = Some(proto::plan_request::Goal::GoalId(kept.goal_id.clone()));
        assert_eq!(plan(proto::PlanRequest { goal: by_id, ..request.clone() }).await, kept, "of a known goal");
        let started = plan(proto::PlanRequest { warm_start: actions(&kept.warm_start), ..request.clone() }).await;
        assert_eq!(started.iterations, 1, "a search from an initial plan was asked for");

        let new = Some(proto::plan_request::Goal::GoalImage(image(5)));
        let new = proto::PlanRequest { goal: new, ..request };
        let named = proto::PlanRequest { search: search(Solver::Gradient, None, false), ..new.clone() };
        let new = plan(new).await;
        assert_eq!((new.iterations, &new), (1, &plan(named).await), "over {}", client.transport());
    }
}

/// While the observation stays the same, the hand has stalled: after eight plans the target is another.
#[tokio::test(flavor = "multi_thread")]
async fn an_approach_moves_the_target_when_the_hand_stalls() {
    let config = ModelConfig { position_dynamics: true, updates: 2, ..small_config(MethodKind::Cpn) };
    let moving = cpn::checkpoint::to_bytes(&Model::new(config, 1), &provenance(&["reach"], 1)).unwrap();
    let fixture = Fixture::start(&[("moving", moving), ("cpn", checkpoint(MethodKind::Cpn, 1))], |_| ()).await;
    for client in fixture.clients() {
        let request = plan_request("moving", 3);
        let first = timeless(client.plan(request.clone()).await.unwrap());
        let mut last = first.clone();
        for plans in 1..=8 {
            let approach = last.approach.map(Into::into);
            last = timeless(client.plan(proto::PlanRequest { approach, ..request.clone() }).await.unwrap());
            let Approach { tried, plans: still, .. } = last.approach.unwrap();
            assert_eq!((tried, still), if plans < 8 { (0, plans) } else { (1, 0) });
            assert_eq!(last.latent_distance, first.latent_distance);
            assert_eq!(last.actions == first.actions, tried == 0, "over {}", client.transport());
        }
        let at = |tried| Some(proto::Approach { tried, ..last.approach.unwrap().into() });
        let plan = async |approach| client.plan(proto::PlanRequest { approach, ..request.clone() }).await.unwrap();
        assert_eq!(plan(at(1)).await.actions, last.actions);
        assert_eq!(plan(at(3)).await.actions, first.actions, "the goal's position again");

        let named = proto::PlanRequest { search: search(Solver::Gradient, None, false), ..request };
        assert_eq!(timeless(client.plan(named).await.unwrap()), PlanResponse { approach: None, ..first });
        let approach = last.approach.map(Into::into);
        let other = client.plan(proto::PlanRequest { approach, ..plan_request("cpn", 3) }).await;
        is(Code::InvalidArgument, "approach", other);
    }
}

/// Of a familiar goal the approach begins with the policy, and leaves it after 24 plans without motion.
#[tokio::test(flavor = "multi_thread")]
async fn an_approach_leaves_the_policy_when_the_hand_stalls() {
    let config = ModelConfig { position_dynamics: true, familiar_goals: 1, ..small_config(MethodKind::Cpn) };
    let fixture = Fixture::start(&[("cpn", familiar_checkpoint(config))], |_| ()).await;
    let [client, ..] = fixture.clients();
    let mut approach = None;
    for _ in 0..24 {
        let plan = client.plan(proto::PlanRequest { approach, ..plan_request("cpn", 3) }).await.unwrap();
        assert_eq!(plan.iterations, 0);
        approach = plan.approach.map(Into::into);
    }
    let later = client.plan(proto::PlanRequest { approach, ..plan_request("cpn", 3) }).await.unwrap();
    let named = proto::PlanRequest { search: search(Solver::Gradient, None, false), ..plan_request("cpn", 3) };
    assert_eq!((later.iterations, later.actions), (1, client.plan(named).await.unwrap().actions));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_anytime_search_uses_its_time_and_can_be_repeated() {
    let fixture = fixture().await;
    for (solver, client) in SOLVERS.into_iter().zip(fixture.clients().into_iter().cycle()) {
        let anytime = search(solver, None, true);
        let request = proto::PlanRequest { search: anytime, deadline_ms: 200, ..plan_request("cpn", 5) };
        let plan = client.plan(request).await.unwrap();
        assert!(plan.iterations_run > 3, "{solver:?}: {} iterations", plan.iterations_run);
        assert!(plan.inner_losses.is_sorted_by(|a, b| a >= b), "{solver:?}: {:?}", plan.inner_losses);
        let again = search(solver, plan.iterations, false);
        let again = client.plan(proto::PlanRequest { search: again, ..plan_request("cpn", 5) }).await.unwrap();
        assert_eq!(again.actions, plan.actions, "{solver:?} over {}", client.transport());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_searches_are_refused() {
    let fixture = fixture().await;
    for client in fixture.clients() {
        let refused = async |spoil: &dyn Fn(&mut proto::PlanRequest), model: &str| {
            let mut request = plan_request(model, 1);
            spoil(&mut request);
            client.plan(request).await
        };
        for model in ["te-bc", "random"] {
            is(Code::InvalidArgument, "search", refused(&|r| r.search = search(Solver::Cem, 2, false), model).await);
            is(Code::InvalidArgument, "warm_start", refused(&|r| r.warm_start = actions(&[vec![0.0; 4]]), model).await);
        }
        for start in [vec![vec![0.0; 4]; 4], vec![vec![0.0; 3]; 5]] {
            is(Code::InvalidArgument, "warm_start", refused(&|r| r.warm_start = actions(&start), "cpn").await);
        }
        is(
            Code::InvalidArgument,
            "deadline_ms",
            refused(&|r| r.search = search(Solver::Mppi, None, true), "cpn").await,
        );
        client.plan(plan_request("cpn", 1)).await.unwrap();
    }
}

/// Search that takes at least seconds.
fn long(solver: Solver) -> proto::PlanRequest {
    let samples = if solver == Solver::Gradient { 0 } else { 4096 };
    let search = proto::Search { solver: solver.into(), iterations: Some(1000), samples, anytime: false };
    proto::PlanRequest { search: Some(search), ..plan_request("cpn", 3) }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_search_that_cannot_meet_its_deadline_is_refused_at_once() {
    let fixture = fixture().await;
    for client in fixture.clients() {
        for solver in [Solver::Cem, Solver::Mppi, Solver::Hybrid] {
            let hopeless = proto::PlanRequest { deadline_ms: 100, ..long(solver) };
            is(Code::ResourceExhausted, "search", client.plan(hopeless).await);
        }
    }
}

/// During a long search other requests are planned and models swapped; the search finds the same plan as without them.
#[tokio::test(flavor = "multi_thread")]
async fn a_long_search_does_not_delay_other_requests() {
    let fixture = fixture().await;
    let [_, grpc, _] = fixture.clients();
    let mut moderate = long(Solver::Cem);
    moderate.search.as_mut().unwrap().iterations = Some(40);
    let alone = timeless(grpc.plan(moderate.clone()).await.unwrap());

    let client = grpc.clone();
    let endless = tokio::spawn(async move { client.plan(long(Solver::Hybrid)).await });
    let client = grpc.clone();
    let searching = tokio::spawn(async move { client.plan(moderate).await });
    for client in fixture.clients() {
        for seed in 0..10 {
            client.plan(plan_request("cpn", seed)).await.unwrap();
            client.plan(plan_request(RANDOM, seed)).await.unwrap();
        }
        client.load_model(from_bytes("te-bc", checkpoint(MethodKind::TeBc, 2))).await.unwrap();
        // The search keeps its checkpoint, even when more are swapped in than are retired.
        for seed in 2..7 {
            client.load_model(from_bytes("cpn", checkpoint(MethodKind::Cpn, seed))).await.unwrap();
        }
        client.load_model(from_bytes("cpn", checkpoint(MethodKind::Cpn, 1))).await.unwrap();
    }
    assert_eq!(timeless(soon(searching).await.unwrap().unwrap()), alone);
    assert!(!endless.is_finished(), "it takes longer than all of these");
    endless.abort();
}

/// Method with endless searches, which counts their slices.
struct Endless(Arc<AtomicU64>);

impl Method for Endless {
    fn name(&self) -> &'static str {
        "cpn"
    }

    fn horizon(&self) -> usize {
        1
    }

    fn actions(&self) -> usize {
        4
    }

    fn updates(&self) -> Option<usize> {
        Some(1)
    }

    fn takes(&self, _: Input) -> bool {
        true
    }

    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>> {
        vec![vec![0.0]; inputs.len()]
    }

    fn plan(&mut self, queries: &[Query<'_>], _: &mut cpn::method::Search<'_>) -> Vec<Plan> {
        common::random(queries)
    }

    fn resume(&mut self, _: &[Query<'_>], _: &mut Ongoing, go_on: &mut dyn FnMut() -> bool) {
        loop {
            self.0.fetch_add(1, Ordering::Relaxed);
            if !go_on() {
                return;
            }
        }
    }
}

/// Waits until no more slices are run.
async fn has_ended(pieces: &AtomicU64) {
    let mut before = pieces.load(Ordering::Relaxed);
    let ended = async {
        loop {
            tokio::time::sleep(Duration::from_millis(100)).await;
            let now = pieces.load(Ordering::Relaxed);
            if std::mem::replace(&mut before, now) == now {
                return;
            }
        }
    };
    soon(ended).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_search_ends_with_its_deadline_and_with_its_client() {
    let fixture = fixture().await;
    let pieces = Arc::new(AtomicU64::new(0));
    serve(&fixture.planner.core(), "endless", Box::new(Endless(Arc::clone(&pieces)))).await;
    let endless = || proto::PlanRequest { search: search(Solver::Gradient, 1000, false), ..plan_request("endless", 1) };
    for client in fixture.clients() {
        let request = proto::PlanRequest { deadline_ms: 200, ..endless() };
        is(Code::DeadlineExceeded, "deadline_ms", client.plan(request).await);
        has_ended(&pieces).await;
        client.plan(plan_request("cpn", 1)).await.unwrap();
    }

    let [core, grpc, _] = fixture.clients();
    for client in [core, grpc] {
        let (before, asked) = (pieces.load(Ordering::Relaxed), client.clone());
        let asking = tokio::spawn(async move { asked.plan(endless()).await });
        let begun = async {
            while pieces.load(Ordering::Relaxed) == before {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        soon(begun).await;
        asking.abort();
        has_ended(&pieces).await;
    }
}

/// At most half of the queue's capacity of sliced searches are in progress, and shutdown aborts them.
#[tokio::test(flavor = "multi_thread")]
async fn searches_are_bounded_and_do_not_outlast_the_planner() {
    let fixture = Fixture::start(&[], |config| config.queue_capacity = 3.try_into().unwrap()).await;
    let pieces = Arc::new(AtomicU64::new(0));
    serve(&fixture.planner.core(), "endless", Box::new(Endless(Arc::clone(&pieces)))).await;
    let endless = proto::PlanRequest { search: search(Solver::Gradient, 1000, false), ..plan_request("endless", 1) };
    let [_, grpc, _] = fixture.clients();
    let ask = |client: Client| {
        let endless = endless.clone();
        tokio::spawn(async move { client.plan(endless).await })
    };
    let mut going_on = vec![ask(grpc.clone()), ask(grpc.clone())];
    let refused = async {
        loop {
            let one_more = ask(grpc.clone());
            match tokio::time::timeout(Duration::from_millis(100), one_more).await {
                Ok(answer) => return answer.unwrap(),
                Err(_) => going_on.push(ask(grpc.clone())),
            }
        }
    };
    is(Code::ResourceExhausted, "queue", soon(refused).await);
    grpc.plan(plan_request(RANDOM, 1)).await.unwrap();
    tokio::time::timeout(PATIENCE, fixture.planner.shutdown()).await.unwrap().unwrap();
    has_ended(&pieces).await;
}

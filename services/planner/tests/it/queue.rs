//! Model thread under load and faults, with a method that waits for the test.

use crate::common::{self, Client, Fixture, Gate, faulty, image, is, method, plan_request, random, soon, timeless};
use cpn::{MethodKind, Model, ModelConfig};
use futures::future::join_all;
use planner::core::PlannerCore;
use planner::model::RANDOM;
use std::future::Future;
use std::pin::Pin;
use std::sync::mpsc;
use std::time::Duration;
use testing::{provenance, small_config};
use wire::planner::{PlanRequest, PlanResponse};
use wire::{Code, Error, proto};

type Answer = Pin<Box<dyn Future<Output = Result<PlanResponse, Error>> + Send>>;

/// Queues a plan; its answer is awaited later, or dropped.
async fn enqueue(core: &PlannerCore, request: proto::PlanRequest) -> Answer {
    let core = core.clone();
    let request = PlanRequest::try_from(request).unwrap();
    let mut answer: Answer = Box::pin(async move { core.plan(request).await });
    tokio::select! {
        biased;
        result = &mut answer => panic!("answered at once: {result:?}"),
        () = async {} => answer,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_queue_refuses_and_recovers() {
    let fixture = Fixture::start(&[], |config| config.queue_capacity = 2.try_into().unwrap()).await;
    let core = fixture.planner.core();
    let gate = Gate::serve(&core).await;
    let running = enqueue(&core, plan_request("gated", 1)).await;
    assert_eq!(gate.entered().await, 1);
    let waiting = [enqueue(&core, plan_request("gated", 2)).await, enqueue(&core, plan_request(RANDOM, 3)).await];
    for client in fixture.clients() {
        let error = client.plan(plan_request(RANDOM, 4)).await.unwrap_err();
        let full = Error::new(Code::ResourceExhausted, "queue", "a free place", "2 waiting");
        assert_eq!(error, full, "{}", client.transport());
        // Requests without a plan are still answered.
        client.register_goal(proto::RegisterGoalRequest { image: Some(image(9)) }).await.unwrap();
        client.list_models().await.unwrap();
    }
    gate.open();
    gate.open();
    running.await.unwrap();
    for answer in waiting {
        answer.await.unwrap();
    }
    for client in fixture.clients() {
        client.plan(plan_request(RANDOM, 4)).await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_queue_does_not_hinder_a_swap() {
    let fixture = Fixture::start(&[], |config| config.queue_capacity = 1.try_into().unwrap()).await;
    let core = fixture.planner.core();
    let gate = Gate::serve(&core).await;
    let running = enqueue(&core, plan_request("gated", 1)).await;
    assert_eq!(gate.entered().await, 1);
    let waiting = enqueue(&core, plan_request(RANDOM, 2)).await;
    let swap = tokio::spawn({
        let core = core.clone();
        async move { common::serve(&core, "new", Box::new(cpn::Random { actions: 2 })).await }
    });
    gate.open();
    soon(swap).await.unwrap();
    running.await.unwrap();
    waiting.await.unwrap();
    let [client, ..] = fixture.clients();
    assert_eq!(client.plan(plan_request("new", 3)).await.unwrap().first_action.len(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deadline_that_passes_in_the_queue_is_answered_without_a_plan() {
    let fixture = Fixture::start(&[], |_| ()).await;
    let core = fixture.planner.core();
    let gate = Gate::serve(&core).await;
    let running = enqueue(&core, plan_request("gated", 1)).await;
    assert_eq!(gate.entered().await, 1);
    for client in fixture.clients() {
        let request = proto::PlanRequest { deadline_ms: 5, ..plan_request("gated", 2) };
        let error = soon(client.plan(request)).await.unwrap_err();
        let late = Error::new(Code::DeadlineExceeded, "deadline_ms", "an answer within 5 ms", "none");
        assert_eq!(error, late, "{}", client.transport());
    }
    let next = enqueue(&core, plan_request("gated", 3)).await;
    gate.open();
    assert_eq!(gate.entered().await, 3, "those in between were not planned");
    gate.open();
    running.await.unwrap();
    next.await.unwrap();
}

/// A deadline also holds during planning.
#[tokio::test(flavor = "multi_thread")]
async fn a_plan_beyond_its_deadline_is_answered_with_an_error() {
    let fixture = Fixture::start(&[], |_| ()).await;
    let core = fixture.planner.core();
    let gate = Gate::serve(&core).await;
    for (client, seed) in fixture.clients().into_iter().zip(1..) {
        let request = proto::PlanRequest { deadline_ms: 300, ..plan_request("gated", seed) };
        let slow = async { is(Code::DeadlineExceeded, "deadline_ms", soon(client.plan(request)).await) };
        let (entered, ()) = tokio::join!(gate.entered(), slow);
        assert_eq!(entered, seed, "{}", client.transport());
        gate.open();
        client.plan(plan_request(RANDOM, 2)).await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn cancelled_requests_do_not_disturb_others() {
    let fixture = Fixture::start(&[], |_| ()).await;
    let core = fixture.planner.core();
    let gate = Gate::serve(&core).await;
    let [_, grpc @ Client::Grpc(_), _] = fixture.clients() else { unreachable!() };
    let gone_while_planning = tokio::spawn(async move { grpc.plan(plan_request("gated", 1)).await });
    assert_eq!(gate.entered().await, 1);
    drop(enqueue(&core, plan_request("gated", 2)).await);
    let next = enqueue(&core, plan_request("gated", 3)).await;
    gone_while_planning.abort();
    assert!(gone_while_planning.await.unwrap_err().is_cancelled());
    gate.open();
    assert_eq!(gate.entered().await, 3, "the one that was dropped in the queue was not planned");
    gate.open();
    next.await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_failing_plan_fails_alone() {
    let fixture = Fixture::start(&[], |_| ()).await;
    common::serve(&fixture.planner.core(), "faulty", faulty()).await;
    for client in fixture.clients() {
        is(Code::Internal, "actions", client.plan(plan_request("faulty", 2)).await);
        is(Code::Internal, "plan", client.plan(plan_request("faulty", 3)).await);
        client.plan(plan_request(RANDOM, 4)).await.unwrap();
    }
}

/// Queues requests while the model is busy, releases it, and returns the batch sizes and the answers.
async fn planned_together(fixture: &Fixture, requests: Vec<proto::PlanRequest>) -> (Vec<usize>, Vec<PlanResponse>) {
    let core = fixture.planner.core();
    let (sender, counts) = mpsc::channel();
    let counting = method(move |queries| {
        sender.send(queries.len()).unwrap();
        random(queries)
    });
    common::serve(&core, "counting", counting).await;
    let gate = Gate::serve(&core).await;
    let running = enqueue(&core, plan_request("gated", 1)).await;
    assert_eq!(gate.entered().await, 1);
    let mut waiting = Vec::new();
    for request in requests {
        waiting.push(enqueue(&core, request).await);
    }
    gate.open();
    running.await.unwrap();
    let answers = join_all(waiting).await.into_iter().map(Result::unwrap).collect();
    (counts.try_iter().collect(), answers)
}

#[tokio::test(flavor = "multi_thread")]
async fn queued_requests_are_planned_in_batches() {
    let fixture = Fixture::start(&[], |config| config.batch_size = 4.try_into().unwrap()).await;
    // Requests for another model in between do not split a batch; one beyond the batch size waits for the next.
    let models = ["counting", RANDOM, "counting", "counting", RANDOM, "counting", "counting"];
    let requests: Vec<_> = models.iter().zip(0..).map(|(model, seed)| plan_request(model, seed)).collect();
    let (counts, together) = planned_together(&fixture, requests.clone()).await;
    assert_eq!(counts, [4, 1]);
    let [client, ..] = fixture.clients();
    for (request, answer) in requests.into_iter().zip(together) {
        let alone = client.plan(proto::PlanRequest { model: RANDOM.into(), ..request }).await.unwrap();
        assert_eq!(alone.actions, answer.actions, "each gets its own plan");
    }
}

/// Requests with different approaches, and one without, share a batch.
#[tokio::test(flavor = "multi_thread")]
async fn each_request_of_a_batch_has_its_approach() {
    let config = ModelConfig { position_dynamics: true, ..small_config(MethodKind::Cpn) };
    let moving = cpn::checkpoint::to_bytes(&Model::new(config, 1), &provenance(&["reach"], 1)).unwrap();
    let fixture = Fixture::start(&[("moving", moving)], |_| ()).await;
    let at = |tried| Some(proto::Approach { tried, position: vec![0.0; 3], plans: 0 });
    let requests = [None, at(0), at(1), at(2), at(4), None]
        .map(|approach| proto::PlanRequest { approach, ..plan_request("moving", 3) });
    let (_, together) = planned_together(&fixture, requests.to_vec()).await;
    let [client, ..] = fixture.clients();
    for (request, answer) in requests.into_iter().zip(&together) {
        assert_eq!(timeless(client.plan(request).await.unwrap()), timeless(answer.clone()));
    }
    assert_eq!(together[0].actions, together[1].actions, "both towards the goal's position");
    for others in together[1..5].windows(2) {
        assert_ne!(others[0].actions, others[1].actions);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn only_the_faulty_request_of_a_batch_fails() {
    let fixture = Fixture::start(&[], |_| ()).await;
    let core = fixture.planner.core();
    common::serve(&core, "faulty", faulty()).await;
    let gate = Gate::serve(&core).await;
    let running = enqueue(&core, plan_request("gated", 1)).await;
    assert_eq!(gate.entered().await, 1);
    let [even, odd] =
        [enqueue(&core, plan_request("faulty", 2)).await, enqueue(&core, plan_request("faulty", 3)).await];
    gate.open();
    running.await.unwrap();
    is(Code::Internal, "actions", even.await);
    is(Code::Internal, "plan", odd.await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_that_would_miss_its_deadline_is_refused_at_once() {
    let fixture = Fixture::start(&[], |_| ()).await;
    let core = fixture.planner.core();
    let gate = Gate::serve(&core).await;
    for seed in [1, 2] {
        let slow = enqueue(&core, plan_request("gated", seed)).await;
        assert_eq!(gate.entered().await, seed);
        if seed == 2 {
            // Below the measured time of the first plan.
            for client in fixture.clients() {
                let request = proto::PlanRequest { deadline_ms: 50, ..plan_request("gated", 3) };
                is(Code::ResourceExhausted, "queue", client.plan(request).await);
                let patient = proto::PlanRequest { deadline_ms: 60_000, ..plan_request(RANDOM, 3) };
                drop(enqueue(&core, patient).await);
            }
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
        gate.open();
        slow.await.unwrap();
    }
}

//! Searches that a request chooses, over every transport.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::{Fixture, checkpoint, is, plan_request, timeless};
use cpn::MethodKind;
use wire::Code;
use wire::planner::PlanResponse;
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
async fn every_solver_repeats_itself_and_starts_where_it_is_told() {
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
            // Its last inner loss is the one that the next search begins with.
            assert_eq!(on.inner_losses[0], plan.inner_losses[3], "{solver:?} over {}", client.transport());
        }
    }
    let [client, ..] = fixture.clients();
    let plain = timeless(client.plan(plan_request("cpn", 3)).await.unwrap());
    let trained = proto::PlanRequest { search: search(Solver::Gradient, None, false), ..plan_request("cpn", 3) };
    assert_eq!(timeless(client.plan(trained).await.unwrap()), plain, "the gradient is the model's own way");
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
async fn what_cannot_be_searched_is_refused() {
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

//! What is served against the reference by autograd, and what searches promise.

#![expect(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{double_agent, encoders, noise_images, position_config, small_config, uniform};
use cpn::encoder::Precision;
use cpn::images;
use cpn::inner_loop::TensorPlan;
use cpn::method::{self, Iterations, Observed, Ongoing, Query, Search, Solver};
use cpn::{Agent, EncoderConfig, Method, MethodKind, ModelConfig, Plan, Planner, Preset, Random};
use proptest::prelude::*;
use tch::{Kind, Tensor};

/// Relative, of float32 against float64.
const TOLERANCE: f64 = 1e-5;
/// What embeddings of about 1 are moved by to see how a plan moves with them: some of float32's last places.
const ROUNDING: f64 = 1e-6;
/// How many ways they are moved.
const DIRECTIONS: u64 = 32;
const SAMPLERS: [Solver; 3] = [Solver::Cem(40), Solver::Mppi(40), Solver::Hybrid(40)];

fn floats(tensor: &Tensor) -> Vec<f64> {
    Vec::try_from(tensor.to_kind(Kind::Double).flatten(0, -1)).unwrap()
}

/// The same weights in float64, to compare with, and laid out for planning.
fn both(config: ModelConfig, step_size: f64, threads: usize) -> (Agent, Planner) {
    let (double, single) = agents(config, step_size);
    (double, Planner::new(single, Precision::Float32, threads))
}

/// The same weights in float64 and in float32.
fn agents(config: ModelConfig, step_size: f64) -> (Agent, Agent) {
    let agent = double_agent(config.clone());
    let _ = tch::no_grad(|| agent.variables().variables()["step_size"].shallow_clone().fill_(step_size));
    let single = Agent::new(config, 0);
    let weights = agent.variables().variables();
    for (name, mut variable) in single.variables().variables() {
        tch::no_grad(|| variable.copy_(&weights[&name]));
    }
    (agent, single)
}

/// Rows `[Z]` of float32, and the same numbers as `[B, Z]`.
fn embeddings(rows: usize, latent: i64, seed: u64) -> (Vec<Vec<f32>>, Tensor) {
    let values = (uniform(&[rows as i64, latent], seed) * 1.5).to_kind(Kind::Float);
    let row = |row| floats(&values.get(row)).into_iter().map(|value| value as f32).collect();
    ((0..rows as i64).map(row).collect(), values.to_kind(Kind::Double))
}

fn queries<'a>(x: &'a [Vec<f32>], x_g: &'a [Vec<f32>], start: &'a [Vec<f32>]) -> Vec<Query<'a>> {
    let seeds = 0..x.len() as u64;
    x.iter().zip(x_g).zip(seeds).map(|((x, x_g), seed)| Query { x, x_g, seed, start }).collect()
}

fn fixed<'a>(solver: Solver, count: usize) -> Search<'a> {
    Search { solver, iterations: Iterations::Fixed(count) }
}

/// As close to the float64 numbers as float32 ones can be, where what they are computed from moves them by `rounding`.
fn assert_close(what: &str, ours: impl Iterator<Item = f32>, reference: &[f64], rounding: f64) {
    let scale = reference.iter().fold(1.0f64, |most, value| most.max(value.abs()));
    let ours: Vec<f32> = ours.collect();
    assert_eq!(ours.len(), reference.len(), "{what}");
    for (ours, reference) in ours.iter().zip(reference) {
        let error = (f64::from(*ours) - reference).abs();
        assert!(error < TOLERANCE * scale + 4.0 * rounding, "{what}: {ours} for {reference}, which {rounding:e} move");
    }
}

fn farthest(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn sizes() -> impl Strategy<Value = ModelConfig> {
    let method =
        prop_oneof![Just(MethodKind::Upn), Just(MethodKind::Cpn), Just(MethodKind::TeBc), Just(MethodKind::Bc)];
    (method, 1i64..70, 1i64..40, 1i64..40, 1i64..6, 1i64..9, 0i64..4).prop_map(
        |(method, latent, hidden, gate_hidden, actions, horizon, updates)| {
            let mut config = position_config(method);
            if let EncoderConfig::Position(encoder) = &mut config.encoder {
                encoder.latent = latent;
            }
            let (horizon, updates) = if method.plans() { (horizon, updates) } else { (1, 0) };
            ModelConfig { hidden, gate_hidden, actions, horizon, updates, ..config }
        },
    )
}

/// The same plans again, `[2 DIRECTIONS B]`, from beginnings that are moved by about what float32 rounds along a computation:
/// how far a plan moves is how far float32 may. A rollout can be steep, and the gradient jumps where a rectified linear unit
/// opens. Each direction is taken both ways, so that one of them opens what rounding may open.
fn moved(agent: &Agent, x: &Tensor, x_g: &Tensor) -> TensorPlan {
    let around = |tensor: &Tensor, seed: u64| {
        let moves = (0..DIRECTIONS).map(|direction| uniform(&tensor.size(), seed + 2 * direction) * ROUNDING);
        Tensor::cat(&moves.flat_map(|by| [tensor + &by, tensor - by]).collect::<Vec<_>>(), 0)
    };
    agent.plan(&around(x, 0), &around(x_g, 1))
}

/// The actions and the inner losses of a plan of a batch.
fn parts(plan: &TensorPlan, row: usize) -> [Vec<f64>; 2] {
    let losses = plan.inner_losses.iter().map(|losses| losses.double_value(&[row as i64]));
    [floats(&plan.actions.get(row as i64)), losses.collect()]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn plans_are_those_of_autograd(config in sizes(), rows in 1usize..40, seed in 0u64..1000) {
        let (latent, updates) = (config.encoder.latent(), config.updates as usize);
        let (agent, single) = agents(config, 0.05);
        let ((x, xs), (x_g, x_gs)) = (embeddings(rows, latent, seed), embeddings(rows, latent, seed + 1));
        let reference = agent.plan(&xs, &x_gs);
        let others = moved(&agent, &xs, &x_gs);
        let mut planner = Planner::new(single, Precision::Float32, 1);
        let plans = planner.plan(&queries(&x, &x_g, &[]), &mut fixed(Solver::Gradient, updates));
        for (row, plan) in plans.iter().enumerate() {
            let [actions, losses] = parts(&reference, row);
            let mut rounding = [0.0f64; 2];
            for other in (row..2 * DIRECTIONS as usize * rows).step_by(rows) {
                let other = parts(&others, other);
                rounding[0] = rounding[0].max(farthest(&other[0], &actions));
                rounding[1] = rounding[1].max(farthest(&other[1], &losses));
            }
            assert_close("actions", plan.actions.iter().flatten().copied(), &actions, rounding[0]);
            assert_close("inner_losses", plan.inner_losses.iter().copied(), &losses, rounding[1]);
            assert_eq!(plan.iterations, updates);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn encoders_of_all_shapes_are_those_of_libtorch(encoder in encoders(), rows in 1usize..8, seed in 0u64..1000) {
        let config = ModelConfig { encoder: EncoderConfig::Image(encoder), ..small_config(MethodKind::Upn) };
        let (agent, single) = agents(config, 1.0);
        let images = noise_images(rows as i64, seed);
        let reference = agent.encode(&images);
        // Where features hardly differ, what normalises them makes much of the last places, libtorch's as ours.
        let rounding = farthest(&floats(&single.encode(&images)), &floats(&reference));
        let mut planner = Planner::new(single, Precision::Float32, 1);
        let bytes: Vec<u8> = Vec::try_from(images.flatten(0, -1)).unwrap();
        let inputs: Vec<_> = bytes.chunks_exact(images::BYTES).map(Observed::Image).collect();
        let together = planner.encode(&inputs);
        for (row, x) in together.iter().enumerate() {
            assert_close("x", x.iter().copied(), &floats(&reference.get(row as i64)), rounding);
            assert_eq!(planner.encode(&inputs[row..=row]), together[row..=row], "alone as among others");
        }
    }
}

#[test]
fn embeddings_are_those_of_libtorch() {
    for method in [MethodKind::Bc, MethodKind::Cpn] {
        for config in [small_config(method), ModelConfig::paper(method)] {
            let (agent, mut planner) = both(config, 1.0, 1);
            let images = noise_images(3, 1);
            let reference = agent.encode(&images);
            let bytes: Vec<u8> = Vec::try_from(images.flatten(0, -1)).unwrap();
            let inputs: Vec<_> = bytes.chunks_exact(images::BYTES).map(Observed::Image).collect();
            for (row, x) in planner.encode(&inputs).into_iter().enumerate() {
                assert_close("x", x.into_iter(), &floats(&reference.get(row as i64)), 0.0);
            }
        }
        let (agent, mut planner) = both(position_config(method), 1.0, 1);
        let positions = [[0.4, -0.2, 0.1], [0.9, 0.3, -0.6]];
        let reference = agent.encode(&cpn::positions::from_metres(&positions));
        for (row, x) in planner.encode(&positions.map(Observed::Position)).into_iter().enumerate() {
            assert_close("x", x.into_iter(), &floats(&reference.get(row as i64)), 0.0);
        }
    }
}

/// And, as others, the same in every bit alone or among others.
#[test]
fn embeddings_in_bfloat16_are_close() {
    let agent = Agent::new(ModelConfig::paper(MethodKind::Cpn), 0);
    let exact = agent.encode(&noise_images(3, 1));
    let bytes: Vec<u8> = Vec::try_from(noise_images(3, 1).flatten(0, -1)).unwrap();
    let inputs: Vec<_> = bytes.chunks_exact(images::BYTES).map(Observed::Image).collect();
    let mut planner = Planner::new(agent, Precision::Bfloat16, 1);
    for (row, x) in planner.encode(&inputs).into_iter().enumerate() {
        assert_eq!(planner.encode(&inputs[row..=row]), std::slice::from_ref(&x));
        let error = farthest(&x.into_iter().map(f64::from).collect::<Vec<_>>(), &floats(&exact.get(row as i64)));
        assert!(error > 0.0 && error < 0.1, "{error}: layer-normalised, so that values are about 1");
    }
}

#[test]
fn positions_stay_whole_in_bfloat16() {
    let [whole, coarse] = [Precision::Float32, Precision::Bfloat16].map(|precision| {
        let agent = Agent::new(Preset::Jenga.recipe().model, 0);
        Planner::new(agent, precision, 1).encode(&[Observed::Position([0.4, -0.2, 0.1])])
    });
    assert_eq!(whole, coarse);
}

/// In every bit, whatever the batch, the threads and the solver.
#[test]
fn a_plan_does_not_depend_on_its_company() {
    for method in [MethodKind::Cpn, MethodKind::Upn, MethodKind::TeBc] {
        let config = ModelConfig { updates: if method.plans() { 2 } else { 0 }, ..ModelConfig::paper(method) };
        let (latent, plans) = (config.encoder.latent(), method.plans());
        let (_, mut one) = both(config.clone(), 0.5, 1);
        let (_, mut three) = both(config, 0.5, 3);
        let ((x, _), (x_g, _)) = (embeddings(45, latent, 1), embeddings(45, latent, 2));
        let together = queries(&x, &x_g, &[]);
        for solver in [Solver::Gradient].into_iter().chain(SAMPLERS.into_iter().filter(|_| plans)) {
            let all = three.plan(&together, &mut fixed(solver, 2));
            assert_eq!(all, one.plan(&together, &mut fixed(solver, 2)), "{method} {solver:?}");
            for (query, plan) in together.iter().zip(&all).step_by(11) {
                assert_eq!(
                    one.plan(&[*query], &mut fixed(solver, 2)),
                    std::slice::from_ref(plan),
                    "{method} {solver:?}"
                );
            }
        }
        let frames = Vec::<u8>::try_from(noise_images(5, 3).flatten(0, -1)).unwrap();
        let frames: Vec<_> = frames.chunks_exact(images::BYTES).map(Observed::Image).collect();
        let all = three.encode(&frames);
        for (frame, x) in frames.iter().zip(&all) {
            assert_eq!(one.encode(&[*frame]), std::slice::from_ref(x));
        }
    }
}

fn search(planner: &mut Planner, solver: Solver, iterations: Iterations<'_>, start: &[Vec<f32>]) -> Plan {
    let ((x, _), (x_g, _)) = (embeddings(1, 6, 1), embeddings(1, 6, 2));
    planner.plan(&queries(&x, &x_g, start), &mut Search { solver, iterations }).remove(0)
}

#[test]
fn samplers_find_better_plans_and_the_same_again() {
    let (_, mut planner) = both(small_config(MethodKind::Cpn), 0.1, 1);
    for solver in SAMPLERS {
        let plan = search(&mut planner, solver, Iterations::Fixed(6), &[]);
        assert!(plan.inner_losses.is_sorted_by(|a, b| a >= b), "{solver:?}: {:?}", plan.inner_losses);
        assert!(plan.inner_losses[6] < plan.inner_losses[0], "{solver:?}: {:?}", plan.inner_losses);
        assert_eq!(search(&mut planner, solver, Iterations::Fixed(6), &[]), plan);
        let again = search(&mut planner, solver, Iterations::Fixed(plan.iterations), &[]);
        assert_eq!(again.actions, plan.actions, "{solver:?}: {} iterations give the same plan", plan.iterations);
    }
}

#[test]
fn a_search_goes_on_while_it_may_and_answers_the_best() {
    // So large a step overshoots, so that the last plan is not the best.
    let (_, mut planner) = both(small_config(MethodKind::Cpn), 40.0, 1);
    for solver in [Solver::Gradient].into_iter().chain(SAMPLERS) {
        let mut left = 7;
        let mut more = || {
            left -= 1;
            left >= 0
        };
        let plan = search(&mut planner, solver, Iterations::While(&mut more), &[]);
        assert_eq!(plan.inner_losses.len(), 8, "{solver:?}");
        assert!(plan.inner_losses.is_sorted_by(|a, b| a >= b), "{solver:?}: {:?}", plan.inner_losses);
        let again = search(&mut planner, solver, Iterations::Fixed(plan.iterations), &[]);
        assert_eq!(again.actions, plan.actions, "{solver:?}: {} iterations give the same plan", plan.iterations);
    }
    let plain = search(&mut planner, Solver::Gradient, Iterations::Fixed(7), &[]);
    assert!(!plain.inner_losses.is_sorted_by(|a, b| a >= b), "the step must overshoot for this test to say anything");
}

/// The same bits, in whatever pieces, on however many threads, with other work in the same memory between any two pieces.
#[test]
fn a_search_in_pieces_is_that_in_one() {
    let config = small_config(MethodKind::Cpn);
    let ((x, _), (x_g, _)) = (embeddings(2, 6, 1), embeddings(2, 6, 2));
    for (threads, start) in [(1, false), (3, true)] {
        let (_, mut planner) = both(config.clone(), 40.0, threads);
        let start =
            if start { search(&mut planner, Solver::Cem(40), Iterations::Fixed(1), &[]).actions } else { vec![] };
        let queries = queries(&x, &x_g, &start);
        for solver in [Solver::Gradient].into_iter().chain(SAMPLERS) {
            let whole = planner.plan(&queries[..1], &mut fixed(solver, 5)).remove(0);
            for pieces in [1, 2, 1000] {
                let mut ongoing = Ongoing::new(solver, 5, false);
                let mut times = 0;
                while !ongoing.is_over() {
                    let mut left = pieces;
                    planner.resume(&queries[..1], &mut ongoing, &mut || {
                        left -= 1;
                        left > 0
                    });
                    if times % 2 == 0 {
                        planner.plan(&queries[1..], &mut fixed(Solver::Hybrid(3), 1));
                    }
                    times += 1;
                }
                assert!(pieces > 2 || times > 2, "{solver:?}: {times} times of {pieces} pieces");
                assert_eq!(ongoing.rollouts(), method::rollouts(solver, 5), "{solver:?}");
                assert_eq!(
                    ongoing.into_plans(),
                    std::slice::from_ref(&whole),
                    "{solver:?} in {pieces} pieces, {threads} threads"
                );
            }
        }
    }
}

/// Those that are searched for together do not notice when one of them is left out.
#[test]
fn a_search_goes_on_without_those_that_have_left() {
    for threads in [1, 3] {
        let (_, mut planner) = both(small_config(MethodKind::Cpn), 0.5, threads);
        let ((x, _), (x_g, _)) = (embeddings(7, 6, 1), embeddings(7, 6, 2));
        let mut queries = queries(&x, &x_g, &[]);
        let mut expected = planner.plan(&queries, &mut fixed(Solver::Gradient, 9));
        let mut ongoing = Ongoing::new(Solver::Gradient, 9, false);
        // One of three threads has nothing left in the end.
        for gone in [6, 2, 4, 0, 0] {
            planner.resume(&queries, &mut ongoing, &mut || false);
            queries.remove(gone);
            expected.remove(gone);
            ongoing.remove(gone);
        }
        while !ongoing.is_over() {
            planner.resume(&queries, &mut ongoing, &mut || true);
        }
        assert_eq!(ongoing.into_plans(), expected, "{threads} threads");
    }
}

/// A search that is left for good answers the best plan of what it has done whole, as one of so many iterations does.
#[test]
fn a_search_that_is_left_answers_the_best_so_far() {
    let (_, mut planner) = both(small_config(MethodKind::Cpn), 40.0, 1);
    let ((x, _), (x_g, _)) = (embeddings(1, 6, 1), embeddings(1, 6, 2));
    let queries = queries(&x, &x_g, &[]);
    for solver in [Solver::Gradient].into_iter().chain(SAMPLERS) {
        let mut ongoing = Ongoing::new(solver, 1000, true);
        for _ in 0..12 {
            planner.resume(&queries, &mut ongoing, &mut || false);
        }
        assert!(!ongoing.is_over());
        let plan = ongoing.into_plans().remove(0);
        assert!(plan.inner_losses.is_sorted_by(|a, b| a >= b), "{solver:?}: {:?}", plan.inner_losses);
        assert!(plan.inner_losses.len() > 2, "{solver:?}: {:?}", plan.inner_losses);
        let again = planner.plan(&queries, &mut fixed(solver, plan.iterations)).remove(0);
        assert_eq!(again.actions, plan.actions, "{solver:?}");
    }
}

#[test]
fn a_search_starts_from_the_actions_it_is_given() {
    let (_, mut planner) = both(small_config(MethodKind::Cpn), 0.1, 1);
    let found = search(&mut planner, Solver::Hybrid(40), Iterations::Fixed(6), &[]);
    for solver in [Solver::Gradient].into_iter().chain(SAMPLERS) {
        let warm = search(&mut planner, solver, Iterations::Fixed(0), &found.actions);
        assert_eq!(warm.actions, found.actions, "{solver:?}");
        assert_eq!(warm.inner_losses, found.inner_losses[6..], "{solver:?}");
        assert_ne!(search(&mut planner, solver, Iterations::Fixed(0), &[]).actions, found.actions, "{solver:?}");
    }
}

#[test]
fn random_actions_follow_the_seed() {
    let mut random = Random { actions: 4 };
    let mut plan = |seed| {
        let query = Query { x: &[], x_g: &[], seed, start: &[] };
        random.plan(&[query], &mut fixed(Solver::Gradient, 0)).remove(0).actions
    };
    assert_eq!(plan(1), plan(1));
    assert_ne!(plan(1), plan(2));
    assert!(plan(1).iter().flatten().all(|value| value.abs() <= 1.0));
}

//! Plans of all engines against the reference by autograd, and properties of searches.

use crate::common::{double_agent, uniform};
use cpn::archive::Tensor as Archived;
use cpn::engine::Native;
use cpn::images;
use cpn::method::{self, Iterations, Observed, Ongoing, Query, Search, Solver};
use cpn::{EncoderConfig, Engine, Method, MethodKind, Model, ModelConfig, Plan, Planner, Precision, Preset, Random};
use cpn_torch::inner_loop::TensorPlan;
use cpn_torch::{Agent, Torch, tensors};
use proptest::prelude::*;
use tch::{Cuda, Device, Kind, Tensor};
use testing::{encoders, noise_images, position_config, small_config};

/// Relative tolerance of float32 against float64.
const TOLERANCE: f64 = 1e-5;
/// Perturbation of embeddings of magnitude 1, a few units in float32's last place, to measure a plan's sensitivity.
const ROUNDING: f64 = 1e-6;
/// Number of directions of perturbation.
const DIRECTIONS: u64 = 32;
const SAMPLERS: [Solver; 3] = [Solver::Cem(40), Solver::Mppi(40), Solver::Hybrid(40)];

/// All engines of this machine; the native one on one thread and on three.
fn engines() -> Vec<Box<dyn Engine>> {
    let native = [1, 3].map(|threads| Box::new(Native { threads }) as Box<dyn Engine>);
    let cuda = if Cuda::is_available() { vec![Some(0)] } else { Vec::new() };
    let torch =
        [None].into_iter().chain(cuda).map(|device| Box::new(Torch::new(device, 1).unwrap()) as Box<dyn Engine>);
    native.into_iter().chain(torch).collect()
}

/// True for the native engine, whose plans and embeddings are bit for bit independent of their position in a batch; libtorch's are
/// so only for sizes that fill its kernels' registers.
fn is_native(engine: &dyn Engine) -> bool {
    format!("{engine:?}").starts_with("Native")
}

fn floats(tensor: &Tensor) -> Vec<f64> {
    Vec::try_from(tensor.to_kind(Kind::Double).flatten(0, -1)).unwrap()
}

/// A model with the inner loop's step size set.
fn model(config: ModelConfig, step_size: f32) -> Model {
    let mut model = Model::new(config, 3);
    model.weights.insert("step_size".to_owned(), Archived::new(&[], &[step_size]));
    model
}

fn planner(engine: &dyn Engine, model: &Model) -> Box<dyn Method> {
    engine.planner(model, Precision::Float32).unwrap()
}

/// Random embeddings: rows `[Z]` in float32, and the same values as a tensor `[B, Z]` in float64.
fn embeddings(rows: usize, latent: i64, seed: u64) -> (Vec<Vec<f32>>, Tensor) {
    let values = (uniform(&[rows as i64, latent], seed) * 1.5).to_kind(Kind::Float);
    let row = |row| floats(&values.get(row)).into_iter().map(|value| value as f32).collect();
    ((0..rows as i64).map(row).collect(), values.to_kind(Kind::Double))
}

/// Numbers of steps left in [`queries`]: some are beyond the longest that is told apart.
fn steps_left(rows: usize) -> impl Iterator<Item = u32> {
    (0..rows as u32).map(|row| 1 + 7 * row)
}

fn queries<'a>(x: &'a [Vec<f32>], x_g: &'a [Vec<f32>], start: &'a [Vec<f32>]) -> Vec<Query<'a>> {
    let rows = x.iter().zip(x_g).zip(steps_left(x.len())).zip(0..);
    rows.map(|(((x, x_g), steps_left), seed)| Query { x, x_g, steps_left, seed, start, keep_initial: false }).collect()
}

fn fixed<'a>(solver: Solver, count: usize) -> Search<'a> {
    Search { solver, iterations: Iterations::Fixed(count) }
}

/// Asserts that float32 values equal the float64 reference within the tolerance and their sensitivity to `rounding`.
fn assert_close(what: &str, ours: impl Iterator<Item = f32>, reference: &[f64], rounding: f64) {
    let scale = reference.iter().fold(1.0f64, |most, value| most.max(value.abs()));
    let ours: Vec<f32> = ours.collect();
    assert_eq!(ours.len(), reference.len(), "{what}");
    for (ours, reference) in ours.iter().zip(reference) {
        let error = (f64::from(*ours) - reference).abs();
        // Float32 rounds at every step of a rollout, the perturbation is of the first state only.
        assert!(error < TOLERANCE * scale + 8.0 * rounding, "{what}: {ours} for {reference}, which {rounding:e} move");
    }
}

fn farthest(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn sizes() -> impl Strategy<Value = ModelConfig> {
    let method = (proptest::sample::select(&MethodKind::ALL[..]), proptest::bool::ANY);
    (method, 1i64..70, 1i64..40, 1i64..40, 1i64..6, 1i64..9, 0i64..4).prop_map(
        |((method, position), latent, hidden, gate_hidden, actions, horizon, updates)| {
            let mut config = position_config(method);
            if let EncoderConfig::Position(encoder) = &mut config.encoder {
                encoder.latent = latent;
            }
            let (horizon, updates) = if method.plans() { (horizon, updates) } else { (1, 0) };
            let position_dynamics = position && method.plans() && latent >= 3;
            ModelConfig { hidden, gate_hidden, actions, horizon, updates, position_dynamics, ..config }
        },
    )
}

/// Plans from perturbed embeddings, `[2 DIRECTIONS B]`: their differences from the plan bound the effect of rounding in float32. A
/// rollout can be steep, and the gradient is discontinuous where a rectified linear unit switches; each direction is taken with
/// both signs, so that one of them switches the units that rounding may switch.
fn perturbed(agent: &Agent, x: &Tensor, x_g: &Tensor, steps_left: &Tensor) -> TensorPlan {
    let around = |tensor: &Tensor, seed: u64| {
        let perturbations = (0..DIRECTIONS).map(|direction| uniform(&tensor.size(), seed + 2 * direction) * ROUNDING);
        Tensor::cat(&perturbations.flat_map(|by| [tensor + &by, tensor - by]).collect::<Vec<_>>(), 0)
    };
    agent.plan(&around(x, 0), &around(x_g, 1), &steps_left.repeat([2 * DIRECTIONS as i64]))
}

/// Actions and inner losses of a batch's plan.
fn parts(plan: &TensorPlan, row: usize) -> [Vec<f64>; 2] {
    let losses = plan.inner_losses.iter().map(|losses| losses.double_value(&[row as i64]));
    [floats(&plan.actions.get(row as i64)), losses.collect()]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn plans_are_those_of_autograd(config in sizes(), rows in 1usize..40, seed in 0u64..1000) {
        let (latent, updates) = (config.encoder.latent(), config.updates as usize);
        let model = model(config, 0.05);
        let agent = double_agent(&model);
        let ((x, xs), (x_g, x_gs)) = (embeddings(rows, latent, seed), embeddings(rows, latent, seed + 1));
        let steps_left = tensors::from_steps_left(steps_left(rows)).to_kind(Kind::Double);
        let reference = agent.plan(&xs, &x_gs, &steps_left);
        let others = perturbed(&agent, &xs, &x_gs, &steps_left);

        for engine in engines() {
            let mut planner = planner(&*engine, &model);
            let plans = planner.plan(&queries(&x, &x_g, &[]), &mut fixed(Solver::Gradient, updates));
            for (row, plan) in plans.iter().enumerate() {
                let [actions, losses] = parts(&reference, row);
                let mut rounding = [0.0f64; 2];
                for other in (row..2 * DIRECTIONS as usize * rows).step_by(rows) {
                    let other = parts(&others, other);
                    rounding[0] = rounding[0].max(farthest(&other[0], &actions));
                    rounding[1] = rounding[1].max(farthest(&other[1], &losses));
                }
                let name = format!("{engine:?}");
                assert_close(&name, plan.actions.iter().flatten().copied(), &actions, rounding[0]);
                assert_close(&name, plan.inner_losses.iter().copied(), &losses, rounding[1]);
                assert_eq!(plan.iterations, updates);
            }
        }
    }
}

fn observed(bytes: &[u8]) -> Vec<Observed<'_>> {
    bytes.chunks_exact(images::BYTES).map(Observed::Image).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn embeddings_of_all_encoders_are_those_of_autograd(encoder in encoders(), rows in 1usize..8, seed in 0u64..1000) {
        let config = ModelConfig { encoder: EncoderConfig::Image(encoder), ..small_config(MethodKind::Upn) };
        let model = model(config, 1.0);
        let images = noise_images(rows, seed);
        let reference = double_agent(&model).encode(&tensors::from_images(&images));
        // Layer normalisation of nearly equal values amplifies rounding errors, in libtorch as in the native engine.
        let single = Agent::new(&model, Device::Cpu).encode(&tensors::from_images(&images));
        let rounding = farthest(&floats(&single), &floats(&reference));
        for engine in engines() {
            let mut planner = planner(&*engine, &model);
            let inputs = observed(&images);
            let together = planner.encode(&inputs);
            for (row, x) in together.iter().enumerate() {
                assert_close("x", x.iter().copied(), &floats(&reference.get(row as i64)), rounding);
                let alone = planner.encode(&inputs[row..=row]).remove(0);
                if is_native(&*engine) {
                    assert_eq!(alone, *x, "{engine:?}: alone as among others");
                }
                assert_close("alone", alone.into_iter(), &floats(&reference.get(row as i64)), rounding);
            }
        }
    }
}

#[test]
fn embeddings_are_those_of_autograd() {
    for engine in engines() {
        for method in [MethodKind::Bc, MethodKind::Cpn] {
            for config in [small_config(method), ModelConfig::paper(method)] {
                let model = model(config, 1.0);
                let images = noise_images(3, 1);
                let reference = double_agent(&model).encode(&tensors::from_images(&images));
                for (row, x) in planner(&*engine, &model).encode(&observed(&images)).into_iter().enumerate() {
                    assert_close("x", x.into_iter(), &floats(&reference.get(row as i64)), 0.0);
                }
            }
            let model = model(position_config(method), 1.0);
            let positions = [[0.4, -0.2, 0.1], [0.9, 0.3, -0.6]];
            let reference = double_agent(&model).encode(&tensors::from_positions(&positions));
            let embeddings = planner(&*engine, &model).encode(&positions.map(Observed::Position));
            for (row, x) in embeddings.into_iter().enumerate() {
                assert_close("x", x.into_iter(), &floats(&reference.get(row as i64)), 0.0);
            }
        }
    }
}

/// They are also bit for bit independent of the rest of the batch.
#[test]
fn embeddings_in_bfloat16_are_close() {
    let model = Model::new(ModelConfig::paper(MethodKind::Cpn), 0);
    let images = noise_images(3, 1);
    let exact = Agent::new(&model, Device::Cpu).encode(&tensors::from_images(&images));
    let inputs = observed(&images);
    let mut planner = Planner::new(&model, Precision::Bfloat16, 1);
    for (row, x) in planner.encode(&inputs).into_iter().enumerate() {
        assert_eq!(planner.encode(&inputs[row..=row]), std::slice::from_ref(&x));
        let error = farthest(&x.into_iter().map(f64::from).collect::<Vec<_>>(), &floats(&exact.get(row as i64)));
        assert!(error > 0.0 && error < 0.1, "{error}: layer-normalised, so that values are about 1");
    }
}

#[test]
fn positions_are_not_rounded_to_bfloat16() {
    let model = Model::new(Preset::Jenga.recipe().model, 0);
    let [whole, coarse] = [Precision::Float32, Precision::Bfloat16]
        .map(|precision| Planner::new(&model, precision, 1).encode(&[Observed::Position([0.4, -0.2, 0.1])]));
    assert_eq!(whole, coarse);
}

/// Bit for bit, for all batches and solvers; for the native engine also for all numbers of threads.
#[test]
fn a_plan_does_not_depend_on_the_rest_of_its_batch() {
    for method in [MethodKind::Cpn, MethodKind::Upn, MethodKind::TeBc, MethodKind::TeBcHorizon] {
        let config = ModelConfig { updates: if method.plans() { 2 } else { 0 }, ..ModelConfig::paper(method) };
        let (latent, plans) = (config.encoder.latent(), method.plans());
        let model = model(config, 0.5);
        let ((x, _), (x_g, _)) = (embeddings(45, latent, 1), embeddings(45, latent, 2));
        let together = queries(&x, &x_g, &[]);
        let images = noise_images(5, 3);

        let mut by_native = planner(&Native { threads: 1 }, &model);
        for engine in engines() {
            let mut planner = planner(&*engine, &model);
            for solver in [Solver::Gradient].into_iter().chain(SAMPLERS.into_iter().filter(|_| plans)) {
                let all = planner.plan(&together, &mut fixed(solver, 2));
                for (query, plan) in together.iter().zip(&all).step_by(11) {
                    let alone = planner.plan(&[*query], &mut fixed(solver, 2));
                    assert_eq!(alone, std::slice::from_ref(plan), "{engine:?} {method} {solver:?}");
                }
                let native = by_native.plan(&together, &mut fixed(solver, 2));
                if is_native(&*engine) {
                    assert_eq!(all, native, "{engine:?} {method} {solver:?}");
                }
            }

            let frames = observed(&images);
            let all = planner.encode(&frames);
            for (frame, x) in frames.iter().zip(&all) {
                assert_eq!(planner.encode(&[*frame]), std::slice::from_ref(x), "{engine:?}");
            }
        }
    }
}

/// In the same batch a familiar goal keeps the policy's plan, and another gets updates: bit for bit as alone, in any number of pieces.
#[test]
fn a_familiar_goal_keeps_the_initial_plan_of_its_row() {
    for position_dynamics in [false, true] {
        let paper = ModelConfig::paper(MethodKind::Cpn);
        let config = ModelConfig { updates: 2, position_dynamics, familiar_goals: 1, ..paper };
        let latent = config.encoder.latent();
        let ((x, _), (x_g, _)) = (embeddings(2, latent, 1), embeddings(2, latent, 2));
        let mut model = model(config, 0.5);
        model.set_familiar_goals(&x_g[..1]);

        for engine in engines() {
            let mut planner = planner(&*engine, &model);
            assert_eq!([&x_g[0], &x_g[1]].map(|x_g| planner.is_familiar(x_g)), [true, false], "{engine:?}");
            assert_eq!(planner.moves_positions(), position_dynamics, "{engine:?}");
            let updated = queries(&x, &x_g, &[]);
            let kept = [Query { keep_initial: true, ..updated[0] }, updated[1]];
            let plans = planner.plan(&kept, &mut fixed(Solver::Gradient, 2));
            for (query, plan) in kept.iter().zip(&plans) {
                assert_eq!(&planner.plan(&[*query], &mut fixed(Solver::Gradient, 2))[0], plan, "{engine:?}");
            }

            let by_policy = planner.plan(&updated[..1], &mut fixed(Solver::Gradient, 0)).remove(0);
            assert_eq!((&plans[0].actions, plans[0].iterations), (&by_policy.actions, 0), "{engine:?}");
            assert_eq!(plans[0].inner_losses, [by_policy.inner_losses[0]; 3], "{engine:?}");
            let by_updates = planner.plan(&updated, &mut fixed(Solver::Gradient, 2));
            assert!(plans[1] == by_updates[1] && plans[0].actions != by_updates[0].actions, "{engine:?}");

            let mut ongoing = Ongoing::new(Solver::Gradient, 2, false);
            while !ongoing.is_over() {
                planner.resume(&kept, &mut ongoing, &mut || false);
            }
            assert_eq!(ongoing.into_plans(), plans, "{engine:?}");
        }
    }
}

#[test]
fn a_method_that_takes_the_steps_left_depends_on_them_and_no_other_does() {
    let ((x, _), (x_g, _)) = (embeddings(1, 6, 1), embeddings(1, 6, 2));
    for engine in engines() {
        for method in MethodKind::ALL {
            let mut planner = planner(&*engine, &model(small_config(method), 0.1));
            let mut actions = |steps_left| {
                let query = Query { x: &x[0], x_g: &x_g[0], steps_left, seed: 0, start: &[], keep_initial: false };
                planner.plan(&[query], &mut fixed(Solver::Gradient, 1)).remove(0).actions
            };
            let changes = actions(3) != actions(4);
            assert_eq!([changes, planner.takes_steps_left()], [method.takes_steps_left(); 2], "{engine:?} {method}");
        }
    }
}

/// With the same samples, and losses equal within rounding errors, searches of all engines find the same plan, except for ties.
#[test]
fn engines_find_the_same_plans() {
    let config = ModelConfig::paper(MethodKind::Cpn);
    let ((x, _), (x_g, _)) = (embeddings(8, config.encoder.latent(), 1), embeddings(8, config.encoder.latent(), 2));
    let model = model(config, 0.01);
    for solver in [Solver::Gradient].into_iter().chain(SAMPLERS) {
        let mut plans = engines()
            .into_iter()
            .map(|engine| planner(&*engine, &model).plan(&queries(&x, &x_g, &[]), &mut fixed(solver, 2)));
        let first = plans.next().unwrap();
        for others in plans {
            for (ours, theirs) in first.iter().zip(others) {
                let numbers = |plan: &Plan| plan.actions.iter().flatten().map(|n| f64::from(*n)).collect::<Vec<_>>();
                let distance = farthest(&numbers(ours), &numbers(&theirs));
                assert!(distance < 1e-4, "{solver:?}: {distance}");
            }
        }
    }
}

fn search(planner: &mut dyn Method, solver: Solver, iterations: Iterations<'_>, start: &[Vec<f32>]) -> Plan {
    let ((x, _), (x_g, _)) = (embeddings(1, 6, 1), embeddings(1, 6, 2));
    planner.plan(&queries(&x, &x_g, start), &mut Search { solver, iterations }).remove(0)
}

/// A planner of a small model by each engine, with the inner loop's step size set.
fn planners(step_size: f32) -> impl Iterator<Item = Box<dyn Method>> {
    let model = model(small_config(MethodKind::Cpn), step_size);
    engines().into_iter().map(move |engine| planner(&*engine, &model))
}

#[test]
fn samplers_improve_plans_and_are_reproducible() {
    for mut planner in planners(0.1) {
        let planner = &mut *planner;
        for solver in SAMPLERS {
            let plan = search(planner, solver, Iterations::Fixed(6), &[]);
            assert!(plan.inner_losses.is_sorted_by(|a, b| a >= b), "{solver:?}: {:?}", plan.inner_losses);
            assert!(plan.inner_losses[6] < plan.inner_losses[0], "{solver:?}: {:?}", plan.inner_losses);
            assert_eq!(search(planner, solver, Iterations::Fixed(6), &[]), plan);
            let again = search(planner, solver, Iterations::Fixed(plan.iterations), &[]);
            assert_eq!(again.actions, plan.actions, "{solver:?}: {} iterations give the same plan", plan.iterations);
        }
    }
}

#[test]
fn an_open_ended_search_returns_the_best_plan() {
    for mut planner in planners(40.0) {
        let planner = &mut *planner;
        for solver in [Solver::Gradient].into_iter().chain(SAMPLERS) {
            let mut left = 7;
            let mut more = || {
                left -= 1;
                left >= 0
            };
            let plan = search(planner, solver, Iterations::While(&mut more), &[]);
            assert_eq!(plan.inner_losses.len(), 8, "{solver:?}");
            assert!(plan.inner_losses.is_sorted_by(|a, b| a >= b), "{solver:?}: {:?}", plan.inner_losses);
            let again = search(planner, solver, Iterations::Fixed(plan.iterations), &[]);
            assert_eq!(again.actions, plan.actions, "{solver:?}: {} iterations give the same plan", plan.iterations);
        }
        let plain = search(planner, Solver::Gradient, Iterations::Fixed(7), &[]);
        assert!(
            !plain.inner_losses.is_sorted_by(|a, b| a >= b),
            "the step must overshoot for this test to say anything"
        );
    }
}

/// Bit for bit, for all divisions into pieces and numbers of threads, with other searches in the same memory between pieces.
#[test]
fn a_search_in_pieces_equals_one_in_a_single_piece() {
    let ((x, _), (x_g, _)) = (embeddings(2, 6, 1), embeddings(2, 6, 2));
    for (mut planner, start) in planners(40.0).zip([false, true, true, false]) {
        let planner = &mut *planner;
        let start = if start { search(planner, Solver::Cem(40), Iterations::Fixed(1), &[]).actions } else { vec![] };
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
                assert_eq!(ongoing.into_plans(), std::slice::from_ref(&whole), "{solver:?} in {pieces} pieces");
            }
        }
    }
}

/// Removal of a query from a search does not affect the others.
#[test]
fn a_search_continues_without_removed_queries() {
    for (engine, mut planner) in engines().into_iter().zip(planners(0.5)) {
        let is_native = is_native(&*engine);
        let ((x, _), (x_g, _)) = (embeddings(7, 6, 1), embeddings(7, 6, 2));
        let mut queries = queries(&x, &x_g, &[]);
        let mut expected = planner.plan(&queries, &mut fixed(Solver::Gradient, 9));

        let mut ongoing = Ongoing::new(Solver::Gradient, 9, false);
        // In the end one of three threads has no query left.
        for gone in [6, 2, 4, 0, 0] {
            planner.resume(&queries, &mut ongoing, &mut || false);
            queries.remove(gone);
            expected.remove(gone);
            ongoing.remove(gone);
        }
        while !ongoing.is_over() {
            planner.resume(&queries, &mut ongoing, &mut || true);
        }

        let numbers = |plans: &[Plan]| {
            let all = plans.iter().flat_map(|plan| plan.actions.iter().flatten());
            all.map(|number| f64::from(*number)).collect::<Vec<_>>()
        };
        let plans = ongoing.into_plans();
        assert!(farthest(&numbers(&plans), &numbers(&expected)) < 1e-4, "{plans:?} {expected:?}");
        assert_eq!(plans.len(), expected.len());
        if is_native {
            assert_eq!(plans, expected);
        }
    }
}

/// An abandoned search returns the best plan of its complete iterations, equal to that of a search with as many iterations.
#[test]
fn an_abandoned_search_returns_the_best_plan_so_far() {
    for mut planner in planners(40.0) {
        let planner = &mut *planner;
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
}

#[test]
fn a_search_starts_from_the_actions_it_is_given() {
    for mut planner in planners(0.1) {
        let planner = &mut *planner;
        let found = search(planner, Solver::Hybrid(40), Iterations::Fixed(6), &[]);
        for solver in [Solver::Gradient].into_iter().chain(SAMPLERS) {
            let warm = search(planner, solver, Iterations::Fixed(0), &found.actions);
            assert_eq!(warm.actions, found.actions, "{solver:?}");
            assert_eq!(warm.inner_losses, found.inner_losses[6..], "{solver:?}");
            assert_ne!(search(planner, solver, Iterations::Fixed(0), &[]).actions, found.actions, "{solver:?}");
        }
    }
}

#[test]
fn random_actions_follow_the_seed() {
    let mut random = Random { actions: 4 };
    let mut plan = |seed| {
        let query = Query { x: &[], x_g: &[], steps_left: 0, seed, start: &[], keep_initial: false };
        random.plan(&[query], &mut fixed(Solver::Gradient, 0)).remove(0).actions
    };
    assert_eq!(plan(1), plan(1));
    assert_ne!(plan(1), plan(2));
    assert!(plan(1).iter().flatten().all(|value| value.abs() <= 1.0));
}

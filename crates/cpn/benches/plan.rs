//! Our side of `make bench-plan`: writes the model and the images that everybody plans with, and plans when asked to.
//!
//! Numbers of batches come in on stdin, one a line; what they took goes out as a line of JSON. `stages` asks where the time of
//! a batch went, on average over all so far; `plans` asks for those of the first batch.

#![expect(clippy::unwrap_used, reason = "a bench")]

use clap::Parser;
use cpn::archive::{self, Tensors};
use cpn::encoder::Precision;
use cpn::method::{Iterations, Observed, Query, Search, Solver};
use cpn::{Agent, EncoderConfig, Method, MethodKind, ModelConfig, Planner, checkpoint, images};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use std::io::{self, BufRead};
use std::path::PathBuf;
use std::time::Instant;

/// Distinct observations, over and over.
const FRAMES: usize = 64;
const SEED: u64 = 0;
const DAMPING: f64 = 0.1;

#[derive(Parser)]
struct Args {
    /// Plan with this model.
    #[arg(long, required_unless_present = "write_model")]
    model: Option<PathBuf>,
    /// Write a model, and images beside its weights.
    #[arg(long)]
    write_model: Option<PathBuf>,
    /// Of this checkpoint, instead of a new one.
    #[arg(long)]
    checkpoint: Option<PathBuf>,
    #[arg(long, default_value = "cpn")]
    method: String,
    #[arg(long)]
    latent: Option<i64>,
    #[arg(long)]
    horizon: Option<i64>,
    #[arg(long)]
    updates: Option<i64>,
    #[arg(long, default_value_t = 1)]
    batch: usize,
    #[arg(long, default_value_t = 1)]
    threads: usize,
    /// Encode in bfloat16, where the processor has instructions for it.
    #[arg(long)]
    bfloat16: bool,
    /// What `cargo bench` says.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() {
    let args = Args::parse();
    match (&args.write_model, &args.model) {
        (Some(path), _) => write(path, &args),
        (None, Some(path)) => plan(path, &args),
        (None, None) => unreachable!("clap wants one"),
    }
}

fn write(path: &PathBuf, args: &Args) {
    let method = MethodKind::ALL.into_iter().find(|method| method.name() == args.method).expect("a learned method");
    let mut config = ModelConfig::paper(method);
    config.horizon = args.horizon.unwrap_or(config.horizon);
    config.updates = args.updates.unwrap_or(config.updates);
    if let EncoderConfig::Image(encoder) = &mut config.encoder {
        encoder.latent = args.latent.unwrap_or(encoder.latent);
    }
    config.validate().unwrap();
    let agent = match &args.checkpoint {
        Some(path) => checkpoint::from_bytes(&std::fs::read(path).unwrap()).unwrap().agent,
        None => Agent::new(config, SEED),
    };
    if args.checkpoint.is_none() {
        // The steps that an untrained model predicts are so large that a plan longer than the paper's would be chaos, in which
        // no two programs agree.
        for (name, mut weight) in agent.variables().variables() {
            if name.starts_with("network.dynamics_1.") {
                let _ = tch::no_grad(|| weight.g_mul_scalar_(DAMPING));
            }
        }
    }
    let noise = |seed| {
        let mut bytes = vec![0; FRAMES * images::BYTES];
        ChaCha8Rng::seed_from_u64(seed).fill(bytes.as_mut_slice());
        images::from_bytes(&bytes).unwrap()
    };
    let mut tensors = Tensors::from([("frames".to_owned(), noise(1)), ("goals".to_owned(), noise(2))]);
    let weights = agent.variables().variables().into_iter();
    tensors.extend(weights.map(|(name, weight)| (format!("weight.{name}"), weight)));
    std::fs::write(path, archive::to_bytes(&tensors, agent.config()).unwrap()).unwrap();
}

fn plan(path: &PathBuf, &Args { batch, threads, bfloat16, .. }: &Args) {
    tch::set_num_threads(threads as i32);
    let (tensors, config): (Tensors, ModelConfig) = archive::from_bytes(&std::fs::read(path).unwrap()).unwrap();
    let bytes = |name: &str| Vec::<u8>::try_from(tensors[name].flatten(0, -1)).unwrap();
    let (frames, goals) = (bytes("frames"), bytes("goals"));
    let weights = tensors.into_iter().filter_map(|(name, t)| Some((name.strip_prefix("weight.")?.to_owned(), t)));
    let agent = Agent::new(config.clone(), SEED);
    checkpoint::copy_weights(&weights.collect(), &agent).unwrap();
    let precision = if bfloat16 { Precision::Bfloat16.where_faster() } else { Precision::Float32 };
    let mut planner = Planner::new(agent, precision, threads);
    let observed = |bytes| -> Vec<_> { <[u8]>::chunks_exact(bytes, images::BYTES).map(Observed::Image).collect() };
    let (frames, x_gs) = (observed(&frames), planner.encode(&observed(&goals)));
    let (mut encoding, mut planning, mut batches) = (0.0, 0.0, 0);
    let mut run = |index: usize| {
        let places: Vec<_> = (0..batch).map(|row| (index * batch + row) % FRAMES).collect();
        let started = Instant::now();
        let xs = planner.encode(&places.iter().map(|place| frames[*place]).collect::<Vec<_>>());
        let encoded = Instant::now();
        let ends = xs.iter().zip(places.iter().map(|place| &x_gs[*place]));
        let queries: Vec<_> = ends.map(|(x, x_g)| Query { x, x_g, seed: 0, start: &[] }).collect();
        let iterations = Iterations::Fixed(config.updates as usize);
        let plans = planner.plan(&queries, &mut Search { solver: Solver::Gradient, iterations });
        encoding += (encoded - started).as_secs_f64();
        planning += encoded.elapsed().as_secs_f64();
        batches += 1;
        (plans, json!({"encoder": encoding / f64::from(batches), "planner": planning / f64::from(batches)}))
    };
    let plans = run(0).0;
    println!("{}", json!({"ready": true, "actions": plans[0].actions}));
    for line in io::stdin().lock().lines() {
        let line = line.unwrap();
        if line.trim() == "stages" {
            println!("{}", json!({"stages": run(0).1}));
            continue;
        }
        if line.trim() == "plans" {
            println!("{}", json!({"plans": plans.iter().map(|plan| &plan.actions).collect::<Vec<_>>()}));
            continue;
        }
        let (count, started): (usize, _) = (line.trim().parse().unwrap(), Instant::now());
        (0..count).for_each(|index| drop(run(index)));
        println!("{}", json!({"seconds": started.elapsed().as_secs_f64()}));
    }
}

//! CPN's contender of `make bench-plan`: writes the model and the images shared by all contenders, and plans on request.
//!
//! Requests are lines on standard input, answers lines of JSON on standard output. A number plans so many batches, and gives their
//! time; `stages` gives the mean time of a batch's stages so far; `plans` gives the plans of the first batch.

#![expect(clippy::unwrap_used, reason = "a bench")]

use clap::Parser;
use cpn::archive::{self, Tensor, Tensors};
use cpn::method::{Iterations, Observed, Query, Search, Solver};
use cpn::{EncoderConfig, MethodKind, Model, ModelConfig, Precision, checkpoint, images};
use engines::{Device, EngineKind};
use serde_json::json;
use std::io::{self, BufRead};
use std::path::PathBuf;
use std::time::Instant;

/// Number of distinct observations, which are used cyclically.
const FRAMES: usize = 64;
const SEED: u64 = 0;
/// Factor on the weights of the predicted change of state.
const DAMPING: f32 = 0.1;

#[derive(Parser)]
struct Args {
    /// Model to plan with.
    #[arg(long, required_unless_present = "write_model")]
    model: Option<PathBuf>,
    /// File to write a model and images to.
    #[arg(long)]
    write_model: Option<PathBuf>,
    /// Checkpoint of the written model; default: an untrained model.
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
    /// Engine.
    #[arg(long, value_enum, default_value = "native")]
    engine: EngineKind,
    /// Device.
    #[arg(long, default_value_t)]
    device: Device,
    #[arg(long, default_value_t = 1)]
    threads: usize,
    /// Encode images in bfloat16, on processors with instructions for it.
    #[arg(long)]
    bfloat16: bool,
    /// Flag passed by `cargo bench`, ignored.
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

    let mut model = match &args.checkpoint {
        Some(path) => checkpoint::from_bytes(&std::fs::read(path).unwrap()).unwrap().model,
        None => Model::new(config, SEED),
    };
    if args.checkpoint.is_none() {
        // An untrained model predicts such large changes of state that plans longer than the paper's are chaotic: rounding errors
        // would make the contenders differ.
        for (_, weight) in model.weights.iter_mut().filter(|(name, _)| name.starts_with("network.dynamics_1.")) {
            let damped: Vec<f32> = weight.elements::<f32>().unwrap().iter().map(|value| value * DAMPING).collect();
            *weight = Tensor::new(weight.shape(), &damped);
        }
    }

    let size = images::SIZE as usize;
    let noise = |seed| Tensor::new(&[FRAMES, size, size, 3], &testing::noise_images(FRAMES, seed));
    let mut tensors = Tensors::from([("frames".to_owned(), noise(1)), ("goals".to_owned(), noise(2))]);
    tensors.extend(model.weights.into_iter().map(|(name, weight)| (format!("weight.{name}"), weight)));
    std::fs::write(path, archive::to_bytes(&tensors, &model.config).unwrap()).unwrap();
}

fn plan(path: &PathBuf, &Args { batch, engine, device, threads, bfloat16, .. }: &Args) {
    let (tensors, config): (Tensors, ModelConfig) = archive::from_bytes(&std::fs::read(path).unwrap()).unwrap();
    let bytes = |name: &str| tensors[name].elements::<u8>().unwrap();
    let (frames, goals) = (bytes("frames"), bytes("goals"));
    let weights = tensors.into_iter().filter_map(|(name, t)| Some((name.strip_prefix("weight.")?.to_owned(), t)));
    let model = Model { config, weights: weights.collect(), familiar: None };
    let precision = if bfloat16 { Precision::Bfloat16.where_faster() } else { Precision::Float32 };

    let engine = engines::build(Some(engine), device, threads).unwrap();
    let mut planner = engine.planner(&model, precision).unwrap();
    let observed = |bytes| -> Vec<_> { <[u8]>::chunks_exact(bytes, images::BYTES).map(Observed::Image).collect() };
    let (frames, x_gs) = (observed(&frames), planner.encode(&observed(&goals)));

    let (mut encoding, mut planning, mut batches) = (0.0, 0.0, 0);
    let mut run = |index: usize| {
        let indices: Vec<_> = (0..batch).map(|row| (index * batch + row) % FRAMES).collect();
        let started = Instant::now();
        let xs = planner.encode(&indices.iter().map(|index| frames[*index]).collect::<Vec<_>>());
        let encoded = Instant::now();
        let ends = xs.iter().zip(indices.iter().map(|index| &x_gs[*index]));
        let queries: Vec<_> =
            ends.map(|(x, x_g)| Query { x, x_g, steps_left: 1, seed: 0, start: &[], keep_initial: false }).collect();
        let iterations = Iterations::Fixed(model.config.updates as usize);
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

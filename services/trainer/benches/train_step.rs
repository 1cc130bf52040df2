//! CPN's contender of `make bench-train`: writes the batches shared by all contenders, and trains on them on request.
//!
//! Requests are lines on standard input, answers lines of JSON on standard output. A number trains so many steps, and gives their
//! time; `stages` gives the mean time of a step's stages so far.

#![expect(clippy::unwrap_used, reason = "a bench")]

#[path = "../tests/it/common/episodes.rs"]
mod episodes;

use clap::Parser;
use cpn::archive::{self, Tensor, Tensors};
use cpn::learner::StageTimes;
use cpn::{Frames, Input, MethodKind, Model, ModelConfig, Precision, Preset, Recipe, Training, images};
use engines::{Device, EngineKind};
use serde_json::json;
use std::io::{self, BufRead};
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread;
use std::time::Instant;
use trainer::training::dataset::Dataset;
use trainer::training::sampler::Sampler;

/// Number of distinct batches, which are used cyclically.
const BATCHES: usize = 8;
/// Number of demonstrations, with random frames.
const EPISODES: u64 = 32;
/// Number of steps of a demonstration; those of Meta-World's experts have 35 to 110.
const STEPS: u32 = 65;
const LEARNING_RATE: f64 = 1e-3;
const SEED: u64 = 0;

#[derive(Parser)]
struct Args {
    /// File of batches to train on.
    #[arg(long, required_unless_present = "write_batches")]
    batches: Option<PathBuf>,
    /// File to write batches to, with their recordings beside it.
    #[arg(long)]
    write_batches: Option<PathBuf>,
    #[arg(long)]
    method: String,
    /// Engine.
    #[arg(long, value_enum, default_value = "native")]
    engine: EngineKind,
    /// Device.
    #[arg(long, default_value_t)]
    device: Device,
    #[arg(long, default_value_t = 1)]
    threads: usize,
    #[arg(long)]
    latent: Option<i64>,
    #[arg(long)]
    horizon: Option<i64>,
    #[arg(long)]
    updates: Option<i64>,
    #[arg(long)]
    batch: Option<usize>,
    /// Flag passed by `cargo bench`, ignored.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() {
    let args = Args::parse();
    match (&args.write_batches, &args.batches) {
        (Some(path), _) => write(path, &args),
        (None, Some(path)) => train(path, &args),
        (None, None) => unreachable!("clap wants one"),
    }
}

/// The recipe of the preset `cpn`, with another method and other sizes.
fn recipe(args: &Args) -> Recipe {
    let method = MethodKind::ALL.into_iter().find(|method| method.name() == args.method).expect("a learned method");
    let Recipe { mut training, .. } = Preset::Cpn.recipe();
    training.batch_size = args.batch.unwrap_or(training.batch_size);
    let mut model = ModelConfig::paper(method);
    model.horizon = args.horizon.unwrap_or(model.horizon);
    model.updates = args.updates.unwrap_or(model.updates);
    if let cpn::EncoderConfig::Image(encoder) = &mut model.encoder {
        encoder.latent = args.latent.unwrap_or(encoder.latent);
    }
    let recipe = Recipe { model, training };
    recipe.validate().unwrap();
    recipe
}

fn recordings(batches: &Path) -> PathBuf {
    batches.with_extension("recordings")
}

fn write(path: &Path, args: &Args) {
    let recipe = recipe(args);
    let folder = recordings(path);
    for seed in 0..EPISODES {
        episodes::keep(&folder, &episodes::episode("noise", seed, STEPS));
    }
    let dataset = Dataset::load(&folder, &[], Input::Image).unwrap();

    let sampler = Sampler::new(&dataset, &recipe, SEED);
    let Frames::Images(pixels) = dataset.frames() else { panic!("expected images") };
    let samples: Vec<_> =
        (0..).flat_map(|epoch| sampler.epoch(epoch)).take(BATCHES * recipe.training.batch_size).collect();
    let index = |step: fn(&trainer::training::sampler::Sample) -> u32| {
        let frame = |sample| dataset.episodes()[sample_episode(sample)].first_frame + step(sample) as usize;
        let indices: Vec<i64> = samples.iter().map(|sample| frame(sample) as i64).collect();
        Tensor::new(&[BATCHES, recipe.training.batch_size], &indices)
    };
    let (horizon, actions) = (recipe.model.horizon as usize, recipe.model.actions as usize);
    let made: Vec<_> = samples.chunks(recipe.training.batch_size).map(|samples| sampler.batch(0, samples)).collect();
    let stack = |shape: &[usize], part: fn(&cpn::Batch) -> &Vec<f32>| {
        let shape = [&[BATCHES, recipe.training.batch_size, horizon], shape].concat();
        Tensor::new(&shape, &made.iter().flat_map(part).copied().collect::<Vec<f32>>())
    };

    let size = images::SIZE as usize;
    let mut tensors = Tensors::from([
        ("frames".to_owned(), Tensor::new(&[pixels.len() / images::BYTES, size, size, 3], pixels)),
        ("observation_index".to_owned(), index(|sample| sample.step)),
        ("goal_index".to_owned(), index(|sample| sample.goal)),
        ("actions".to_owned(), stack(&[actions], |batch| &batch.actions)),
        ("mask".to_owned(), stack(&[], |batch| &batch.mask)),
    ]);
    let weights = Model::new(recipe.model.clone(), SEED).weights.into_iter();
    tensors.extend(weights.map(|(name, weight)| (format!("weight.{name}"), weight)));
    std::fs::write(path, archive::to_bytes(&tensors, &recipe.model).unwrap()).unwrap();
    std::fs::write(path.with_extension("recipe.json"), serde_json::to_string(&recipe).unwrap()).unwrap();
}

fn sample_episode(sample: &trainer::training::sampler::Sample) -> usize {
    sample.episode as usize
}

fn train(path: &Path, args: &Args) {
    let engine = engines::build(Some(args.engine), args.device, args.threads).unwrap();
    let recipe: Recipe =
        serde_json::from_str(&std::fs::read_to_string(path.with_extension("recipe.json")).unwrap()).unwrap();
    let (tensors, _): (Tensors, ModelConfig) = archive::from_bytes(&std::fs::read(path).unwrap()).unwrap();
    let weights: Tensors =
        tensors.into_iter().filter_map(|(name, t)| Some((name.strip_prefix("weight.")?.to_owned(), t))).collect();
    let learner = |precision| {
        let training = Training { precision, ..recipe.training.clone() };
        let model = Model { config: recipe.model.clone(), weights: weights.clone(), familiar: None };
        engine.learner(model, &training).unwrap()
    };
    let dataset = Dataset::load(&recordings(path), &[], Input::Image).unwrap();
    let sampler = Sampler::new(&dataset, &recipe, SEED);
    thread::scope(|scope| {
        let (sender, batches) = mpsc::sync_channel(1);
        // As in a run, the next batch is prepared during a step.
        scope.spawn(move || {
            let over_and_over = std::iter::repeat_with(|| sampler.batches(0).take(BATCHES)).flatten();
            let _ = { over_and_over }.try_for_each(|batch| sender.send(batch).ok());
        });

        // The first loss in float32, for comparison with the other contenders; then the warm-up.
        let first = batches.recv().unwrap();
        let loss = learner(Precision::Float32).step(&first, LEARNING_RATE).unwrap().loss;
        let mut learner = learner(recipe.training.precision);
        for batch in batches.iter().take(BATCHES - 1) {
            learner.step(&batch, LEARNING_RATE).unwrap();
        }
        println!("{}", json!({"ready": true, "loss": loss}));

        let (mut stages, mut steps) = (StageTimes::default(), 0);
        for line in io::stdin().lock().lines() {
            let line = line.unwrap();
            if line.trim() == "stages" {
                let mean = |seconds: f64| seconds / f64::from(steps);
                println!(
                    "{}",
                    json!({"stages": {
                        "encoder": mean(stages.encoder_seconds),
                        "inner and outer loop": mean(stages.outer_loop_seconds),
                        "optimiser": mean(stages.optimiser_seconds),
                    }})
                );
                continue;
            }
            let (count, started, mut loss) = (line.trim().parse().unwrap(), Instant::now(), f64::NAN);
            for batch in batches.iter().take(count) {
                let step = learner.step(&batch, LEARNING_RATE).unwrap();
                loss = step.loss;
                stages.encoder_seconds += step.times.encoder_seconds;
                stages.outer_loop_seconds += step.times.outer_loop_seconds;
                stages.optimiser_seconds += step.times.optimiser_seconds;
            }
            steps += count as u32;
            println!("{}", json!({"seconds": started.elapsed().as_secs_f64(), "loss": loss}));
        }
        drop(batches);
    });
}

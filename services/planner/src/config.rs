//! Settings and command line of the planner.

use clap::builder::{PossibleValuesParser, TypedValueParser};
use cpn::Precision;
use engines::{Device, EngineKind};
use serde::{Deserialize, Deserializer, Serialize};
use service_kit::{SessionConfig, config};
use signing::Trust;
use std::net::SocketAddr;
use std::num::NonZeroU16;
use std::path::PathBuf;

/// Settings of a planner: options of its command line, and keys of its configuration file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Name of the planner in its zenoh keys.
    #[arg(long, default_value = "planner")]
    pub name: String,
    /// Folder of the checkpoints: each `*.safetensors` is served under its file stem from the start.
    #[arg(long, value_name = "FOLDER", default_value = "models")]
    pub models_dir: PathBuf,
    /// Listening address of gRPC; port 0 takes a free one.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:50051")]
    pub grpc_listen: SocketAddr,
    /// Listening address for clients of openpi [default: none].
    #[arg(long, value_name = "ADDRESS")]
    pub openpi_listen: Option<SocketAddr>,
    /// Maximum number of plan requests that wait for the model; one more is refused.
    #[arg(long, value_name = "COUNT", default_value = "64")]
    pub queue_capacity: NonZeroU16,
    /// Maximum number of goal images, and of goal embeddings, kept; the least recently used are evicted.
    #[arg(long, value_name = "COUNT", default_value = "1024")]
    pub goal_capacity: NonZeroU16,
    /// Maximum number of models served, `random` among them; one more is refused.
    #[arg(long, value_name = "COUNT", default_value = "32")]
    pub model_capacity: NonZeroU16,
    /// Maximum number of a model's checkpoints kept after they were swapped out, for episodes that began with them; the least
    /// recently used are evicted.
    #[arg(long, value_name = "COUNT", default_value = "3")]
    pub retired_capacity: NonZeroU16,
    /// Maximum batch size.
    #[arg(long, value_name = "COUNT", default_value = "64")]
    pub batch_size: NonZeroU16,
    /// Batching delay, in milliseconds.
    #[arg(long, value_name = "MS", default_value = "0")]
    pub batch_delay_ms: u16,
    /// Engine that computes plans [default: native on the CPU, torch on a CUDA device].
    #[arg(long, value_parser = named::<EngineKind>(&["native", "torch"]))]
    pub engine: Option<EngineKind>,
    /// Device that computes plans: cpu, cuda or cuda:N.
    #[arg(long, default_value_t)]
    pub device: Device,
    /// Number of threads that compute a batch on the CPU.
    #[arg(long, value_name = "COUNT", default_value = "1")]
    pub threads: NonZeroU16,
    /// Precision of the image encoder's products. bfloat16 is faster where the processor has AVX512-BF16, and float32 elsewhere
    /// and with the engine torch.
    #[arg(long, default_value = "float32", value_parser = named::<Precision>(&["float32", "bfloat16"]))]
    pub precision: Precision,
    /// Policy towards checkpoints without a signature by a trusted key [default: warn if there are trusted keys, else off].
    #[arg(long, value_parser = named::<Trust>(&["off", "warn", "enforce"]))]
    pub trust: Option<Trust>,
    /// Public keys, in PEM, that checkpoints may be signed with.
    #[arg(long, value_name = "FILE", value_delimiter = ',')]
    #[serde(deserialize_with = "listed")]
    pub trusted_keys: Vec<PathBuf>,
    /// Listening address for Prometheus, for example 127.0.0.1:9465 [default: none].
    #[arg(long, value_name = "ADDRESS")]
    pub metrics_listen: Option<SocketAddr>,
    /// File of tokens that clients of gRPC, openpi and metrics may send instead of a certificate [default: none].
    #[arg(long, env = "CPN_TOKENS", value_name = "FILE")]
    pub tokens: Option<PathBuf>,
    /// Connection to the zenoh network.
    #[command(flatten)]
    pub session: SessionConfig,
}

impl Default for Config {
    fn default() -> Self {
        config::defaults()
    }
}

/// Parser of an option with named values.
fn named<T>(names: &'static [&'static str]) -> impl TypedValueParser<Value = T>
where
    T: serde::de::DeserializeOwned + Clone + Send + Sync + 'static,
{
    PossibleValuesParser::new(names).try_map(|name| config::from_name(&name))
}

/// Deserialises a list of paths or, as from the environment, one string of paths separated by commas.
fn listed<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<PathBuf>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "expected a list of files, or their names with commas between them")]
    enum Paths {
        List(Vec<PathBuf>),
        Text(String),
    }
    Ok(match Paths::deserialize(deserializer)? {
        Paths::List(paths) => paths,
        Paths::Text(text) => text.split(',').filter(|path| !path.is_empty()).map(Into::into).collect(),
    })
}

/// Serves plans from trained weights over zenoh and gRPC.
///
/// Each option is also read from the environment (CPN_PLANNER_QUEUE_CAPACITY) and from the file; the command line wins
/// over the environment, the environment over the file.
#[derive(Debug, clap::Parser)]
#[command(version)]
pub struct Args {
    /// TOML file with settings.
    #[arg(long = "config", value_name = "FILE")]
    pub file: Option<PathBuf>,
    /// Settings on the command line, or their defaults.
    #[command(flatten)]
    pub config: Config,
}

//! What the planner can be told: what was typed, and what came of it.

use cpn::encoder::Precision;
use serde::{Deserialize, Deserializer, Serialize};
use service_kit::SessionConfig;
use signing::Trust;
use std::net::{Ipv4Addr, SocketAddr};
use std::num::NonZeroU16;
use std::path::PathBuf;

/// Valid settings of a planner.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Names the planner in its zenoh keys.
    pub name: String,
    /// Folder of the checkpoints: each `*.safetensors` is served under its file stem from the start.
    pub models_dir: PathBuf,
    /// Where gRPC listens; port 0 takes a free one.
    pub grpc_listen: SocketAddr,
    /// Where clients of openpi are listened to; nowhere if none.
    pub openpi_listen: Option<SocketAddr>,
    /// Most plan requests that wait for the model; one more is refused.
    pub queue_capacity: NonZeroU16,
    /// Most goal images, and most embeddings of them, that are kept; the least recently used go first.
    pub goal_capacity: NonZeroU16,
    /// Most models that are served, `random` among them; one more is refused.
    pub model_capacity: NonZeroU16,
    /// Most checkpoints of a model that are kept after they were swapped out, for episodes that began with them; the least
    /// recently used go first.
    pub retired_capacity: NonZeroU16,
    /// Most plans that are made together.
    pub batch_size: NonZeroU16,
    /// How long a plan waits for company, in milliseconds.
    pub batch_delay_ms: u16,
    /// Threads that plans which are made together are spread over.
    pub threads: NonZeroU16,
    /// What images are embedded in: bfloat16, where the processor has instructions for it (AVX512-BF16), is faster,
    /// and close.
    pub precision: Precision,
    /// Policy towards checkpoints that no trusted key signed; if none is given, `warn` where there are trusted keys, else `off`.
    pub trust: Option<Trust>,
    /// Files of public keys, in PEM, whose signatures of checkpoints count.
    #[serde(deserialize_with = "listed")]
    pub trusted_keys: Vec<PathBuf>,
    /// Where Prometheus finds metrics; none are served if it is not given.
    pub metrics_listen: Option<SocketAddr>,
    /// File of the tokens that clients of gRPC, openpi and metrics may bear instead of a certificate.
    pub tokens: Option<PathBuf>,
    /// How the planner joins the others over zenoh.
    pub session: SessionConfig,
}

impl Default for Config {
    fn default() -> Self {
        const fn count(value: u16) -> NonZeroU16 {
            NonZeroU16::new(value).expect("not zero")
        }
        Self {
            name: "planner".into(),
            models_dir: "models".into(),
            grpc_listen: (Ipv4Addr::LOCALHOST, 50051).into(),
            openpi_listen: None,
            queue_capacity: count(64),
            goal_capacity: count(1024),
            model_capacity: count(32),
            retired_capacity: count(3),
            batch_size: count(64),
            batch_delay_ms: 0,
            threads: count(1),
            precision: Precision::Float32,
            trust: None,
            trusted_keys: Vec::new(),
            metrics_listen: None,
            tokens: None,
            session: SessionConfig::default(),
        }
    }
}

/// Paths in a list or, as in the environment, in one text with commas between them.
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
#[derive(Debug, clap::Parser, Serialize)]
#[command(version)]
pub struct Args {
    /// TOML file with settings.
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub config: Option<PathBuf>,
    /// Name of the planner in its zenoh keys [default: planner].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Folder of the checkpoints [default: models].
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub models_dir: Option<PathBuf>,
    /// Where gRPC listens [default: 127.0.0.1:50051].
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grpc_listen: Option<SocketAddr>,
    /// Where clients of openpi are listened to [default: nowhere].
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub openpi_listen: Option<SocketAddr>,
    /// Most plan requests that wait for the model [default: 64].
    #[arg(long, value_name = "COUNT")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub queue_capacity: Option<NonZeroU16>,
    /// Most goal images that are kept [default: 1024].
    #[arg(long, value_name = "COUNT")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub goal_capacity: Option<NonZeroU16>,
    /// Most models that are served, `random` among them [default: 32].
    #[arg(long, value_name = "COUNT")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model_capacity: Option<NonZeroU16>,
    /// Most checkpoints of a model that are kept after they were swapped out [default: 3].
    #[arg(long, value_name = "COUNT")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub retired_capacity: Option<NonZeroU16>,
    /// Most plans that are made together [default: 64].
    #[arg(long, value_name = "COUNT")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batch_size: Option<NonZeroU16>,
    /// How long a plan waits for company, in milliseconds [default: 0].
    #[arg(long, value_name = "MS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batch_delay_ms: Option<u16>,
    /// Threads that plans which are made together are spread over [default: 1].
    #[arg(long, value_name = "COUNT")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threads: Option<NonZeroU16>,
    /// What images are embedded in: float32 or, where the processor has AVX512-BF16, bfloat16 [default: float32].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub precision: Option<String>,
    /// Policy towards checkpoints that no trusted key signed [default: warn if there are trusted keys, else off].
    #[arg(long, value_parser = ["off", "warn", "enforce"])]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trust: Option<String>,
    /// Files of public keys, in PEM, whose signatures of checkpoints count.
    #[arg(long, value_name = "FILE", value_delimiter = ',')]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub trusted_keys: Vec<PathBuf>,
    /// Where Prometheus finds metrics, for example 127.0.0.1:9465 [default: nowhere].
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metrics_listen: Option<SocketAddr>,
    /// File of the tokens that clients of gRPC, openpi and metrics may bear instead of a certificate [default: none].
    #[arg(long, env = "CPN_TOKENS", value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tokens: Option<PathBuf>,
    /// How to join the others.
    #[command(flatten)]
    pub session: SessionConfig,
}

//! The planner's process.

use planner::config::{Args, Config};
use service_kit::{config, shutdown, telemetry};

fn main() -> anyhow::Result<()> {
    service_kit::process::run(program())
}

async fn program() -> anyhow::Result<()> {
    let args: Args = config::parse();
    let _telemetry = telemetry::init("cpn-planner")?;
    let config: Config = config::load("CPN_PLANNER_", args.config.as_deref(), &args)?;
    let planner = planner::start(config).await?;
    shutdown::requested().await?;
    planner.shutdown().await
}

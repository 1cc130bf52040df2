//! Process of the planner service.

use planner::config::Args;
use service_kit::{config, shutdown, telemetry};

fn main() -> anyhow::Result<()> {
    service_kit::process::run(program())
}

async fn program() -> anyhow::Result<()> {
    let (Args { file, config }, sources) = config::parse_with_sources();
    let _telemetry = telemetry::init("cpn-planner")?;
    let config = config::load("CPN_PLANNER_", file.as_deref(), &config, &sources)?;
    let planner = planner::start(config).await?;
    shutdown::requested().await?;
    planner.shutdown().await
}

//! `cpn-eval`: measures first-attempt success, and reports it.

use anyhow::Context;
use clap::Parser;
use evaluator::{Cli, Command, Summary};
use std::process::ExitCode;

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let _telemetry = service_kit::telemetry::init("cpn-eval")?;
    let (summary, json) = match Cli::parse().command {
        Command::Run(args) => (evaluator::run(&args).await?, args.json),
        Command::Report(args) => (evaluator::report(&args.out)?, args.json),
    };
    print(&summary, json)?;
    let errors = summary.errors();
    if errors > 0 {
        tracing::error!("{errors} trials could not be brought to an end; run the same command again for these");
        return Ok(ExitCode::FAILURE);
    }
    Ok(ExitCode::SUCCESS)
}

fn print(summary: &Summary, json: bool) -> anyhow::Result<()> {
    if json {
        println!("{}", serde_json::to_string_pretty(summary).context("printing the summary")?);
    } else {
        println!("{}", evaluator::table(summary));
    }
    Ok(())
}

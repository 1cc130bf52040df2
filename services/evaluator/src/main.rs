//! `cpn-eval`: measures first-attempt success, reports it, compares models, and replays episodes.

use anyhow::Context;
use evaluator::{Cli, Command, Summary};
use service_kit::output;
use std::process::ExitCode;

fn main() -> anyhow::Result<ExitCode> {
    service_kit::process::run(program())
}

async fn program() -> anyhow::Result<ExitCode> {
    let _telemetry = service_kit::telemetry::init("cpn-eval")?;
    match service_kit::config::parse::<Cli>().command {
        Command::Run(args) => tell(&evaluator::run(&args).await?, args.json),
        Command::Report(args) => tell(&evaluator::report(&args.out)?, args.json),
        Command::Compare(args) => {
            let comparison = evaluator::compare(&args.a.0, &args.b.0)?;
            output::print_line(if args.json {
                serde_json::to_string_pretty(&comparison).context("printing the comparison")?
            } else {
                evaluator::comparison_table(&comparison)
            })?;
            Ok(ExitCode::SUCCESS)
        }
        Command::Replay(args) => {
            let replay = evaluator::replay(&args).await?;
            output::print_line(&replay)?;
            Ok(if replay.difference.is_none() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
        }
    }
}

fn tell(summary: &Summary, json: bool) -> anyhow::Result<ExitCode> {
    if json {
        output::print_line(serde_json::to_string_pretty(summary).context("printing the summary")?)?;
    } else {
        output::print_line(evaluator::table(summary))?;
    }
    let errors = summary.errors();
    if errors > 0 {
        tracing::error!("{errors} trials could not be brought to an end; run the same command again for these");
        return Ok(ExitCode::FAILURE);
    }
    Ok(ExitCode::SUCCESS)
}

//! Process of a training run: start, progress, stop.

use crate::training::progress::Progress;
use crate::training::run::Outcome;
use futures::StreamExt;
use rustix::process::{Pid, Signal, kill_process};
use serde::Deserialize;
use std::fs::OpenOptions;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;
use tokio::process::Command;
use tokio_util::codec::{FramedRead, LinesCodec, LinesCodecError};
use tokio_util::sync::CancellationToken;
use tracing::warn;
use wire::training::MAX_REASON_BYTES;

/// Grace period in which a stopped run saves its state.
const GRACE: Duration = Duration::from_secs(30);
/// Longest output line of a run, in bytes.
const MAX_LINE_BYTES: usize = 4096;
/// Prefix of environment variables that would override a run's settings.
const VARIABLES: &str = "CPN_TRAIN_";

/// End of a process.
#[derive(Debug)]
pub(crate) enum End {
    /// Finished; the checkpoint of this SHA-256 is written.
    Finished { digest: String },
    /// Stopped with its state saved.
    Saved,
    /// Killed, since it did not save its state in time.
    Killed,
    /// Failed by itself.
    Failed { reason: String },
}

/// Output line of a run.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Line {
    Progress(Progress),
    Outcome(Outcome),
}

/// Runs `cpn-trainer train` with the settings of a file until it ends or `stop` is cancelled. Its log is appended to `log`;
/// `on_progress` is called with each progress that it prints.
pub(crate) async fn run(
    program: &Path,
    settings: &Path,
    log: &Path,
    stop: &CancellationToken,
    on_progress: impl FnMut(Progress),
) -> End {
    let run = async {
        let stderr = OpenOptions::new().create(true).append(true).open(log)?;
        let mut command = Command::new(program);
        for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with(VARIABLES)) {
            command.env_remove(name);
        }
        // The end of the log is reported as the reason of a failure, and should be the error, not a backtrace.
        command.env("RUST_LIB_BACKTRACE", "0");
        command.arg("train").arg("--json").arg("--config").arg(settings);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(stderr).kill_on_drop(true);
        supervise(command, stop, on_progress).await
    };

    match run.await {
        Ok((_, Some(Outcome::Finished { digest }), _)) => End::Finished { digest },
        Ok((status, Some(Outcome::Interrupted { .. }), _)) if status.success() => End::Saved,
        Ok((_, _, true)) => End::Killed,
        Ok((status, ..)) => End::Failed { reason: reason(status, log) },
        Err(error) => End::Failed { reason: format!("{}: {error}", program.display()) },
    }
}

/// Supervises a process to its end; returns its exit status, the outcome that it printed, and whether it was killed.
async fn supervise(
    mut command: Command,
    stop: &CancellationToken,
    mut on_progress: impl FnMut(Progress),
) -> std::io::Result<(ExitStatus, Option<Outcome>, bool)> {
    let mut child = command.spawn()?;
    let id = child.id().and_then(|id| Pid::from_raw(id.cast_signed()));
    let mut lines =
        child.stdout.take().map(|out| FramedRead::new(out, LinesCodec::new_with_max_length(MAX_LINE_BYTES)));
    let ended = async {
        let (mut outcome, mut too_long) = (None, false);
        while let Some(lines) = &mut lines {
            let line = match lines.next().await {
                Some(Ok(line)) => line,
                Some(Err(LinesCodecError::MaxLineLengthExceeded)) => {
                    warn!(max_bytes = MAX_LINE_BYTES, "line of a run passed over: it is too long");
                    too_long = true;
                    continue;
                }
                // After an error, `FramedRead` returns none once before it continues.
                None if std::mem::take(&mut too_long) => continue,
                Some(Err(LinesCodecError::Io(_))) | None => break,
            };
            match serde_json::from_str(&line) {
                Ok(Line::Progress(progress)) => on_progress(progress),
                Ok(Line::Outcome(printed)) => outcome = Some(printed),
                Err(error) => warn!(line, %error, "line of a run passed over"),
            }
        }
        child.wait().await.map(|status| (status, outcome))
    };
    tokio::pin!(ended);

    // The process id is not reused before the child is waited for.
    let send = |signal| {
        if let Some(Err(error)) = id.map(|id| kill_process(id, signal)) {
            warn!(%error, "signal not sent to a run");
        }
    };

    let mut killed = false;
    let ended = tokio::select! {
        ended = &mut ended => ended,
        () = stop.cancelled() => {
            send(Signal::TERM);
            match tokio::time::timeout(GRACE, &mut ended).await {
                Ok(ended) => ended,
                Err(_) => {
                    killed = true;
                    send(Signal::KILL);
                    ended.await
                }
            }
        }
    };
    ended.map(|(status, outcome)| (status, outcome, killed))
}

/// Reason of a failure: the exit status, and the end of the log.
fn reason(status: ExitStatus, log: &Path) -> String {
    let tail = || {
        let mut file = std::fs::File::open(log)?;
        let start = file.metadata()?.len().saturating_sub(MAX_REASON_BYTES as u64 / 2);
        file.seek(SeekFrom::Start(start))?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        std::io::Result::Ok(bytes)
    };
    let tail = tail().unwrap_or_default();
    let mut reason = format!("{status}\n{}", String::from_utf8_lossy(&tail).trim());
    reason.truncate(reason.floor_char_boundary(MAX_REASON_BYTES));
    reason
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[tokio::test]
    async fn an_overlong_line_is_skipped() -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        let [program, log] = ["program", "log"].map(|name| folder.path().join(name));
        let script =
            "#!/bin/sh\nhead -c 200000 /dev/zero | tr '\\0' x\necho\necho '{\"finished\": {\"digest\": \"d\"}}'\n";
        std::fs::write(&program, script)?;
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755))?;
        let end = run(&program, Path::new("settings"), &log, &CancellationToken::new(), |_| {}).await;
        assert!(matches!(&end, End::Finished { digest } if digest == "d"), "{end:?}");
        Ok(())
    }
}

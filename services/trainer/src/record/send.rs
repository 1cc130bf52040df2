//! Sends recordings: the steps that a worker sent, as far as a recorder lacks them.

use crate::record::folder;
use anyhow::{Context, bail, ensure};
use backon::{ExponentialBuilder, Retryable};
use recording::Episode;
use std::path::Path;
use std::time::Duration;
use tracing::info;
use wire::demonstration::{CommitEpisodeRequest, CommitEpisodeResponse};
use wire::{Code, Error, encode, key, query};
use zenoh::Session;
use zenoh::qos::CongestionControl;

/// How long one answer may take.
const COMMIT_TIMEOUT: Duration = Duration::from_secs(10);

/// Sends every recording of `folder`, or those of some tasks, until all are kept.
///
/// # Errors
/// If a recording is damaged, two have one id, a task has none, a recorder refuses one, or none answers for two minutes.
pub async fn run(session: &Session, folder: &Path, tasks: &[String]) -> anyhow::Result<()> {
    let all_tasks = folder::tasks(folder)?;
    for task in tasks {
        ensure!(all_tasks.contains(task), "tasks: expected some of {all_tasks:?}, got {task:?}");
    }
    let selected = |path: &Path| {
        tasks.is_empty()
            || path.parent().and_then(Path::file_name).is_some_and(|name| tasks.iter().any(|t| name == &**t))
    };
    let paths: Vec<_> = folder::paths(folder)?.into_iter().filter(|path| selected(path)).collect();
    if let Some(duplicate) = folder::duplicates(&paths).into_iter().next() {
        bail!(duplicate);
    }
    let mut sent = 0;
    for path in paths {
        let (place, reading) = (folder.to_owned(), path.clone());
        let episode = tokio::task::spawn_blocking(move || folder::read(&place, &reading)).await??;
        send(session, &episode).await.with_context(|| path.display().to_string())?;
        sent += 1;
    }
    info!(episodes = sent, "replayed");
    Ok(())
}

/// Sends an episode until a recorder keeps it: begins with the commit, which tells which steps are missing.
///
/// # Errors
/// If the recorder refuses the episode, or nobody takes it for two minutes.
pub async fn send(session: &Session, episode: &Episode) -> Result<(), Error> {
    let round = || async {
        let missing = commit(session, episode).await?;
        if missing.is_empty() {
            return Ok(());
        }
        for step in episode.steps().iter().filter(|step| missing.contains(&step.step)) {
            let key = key::demonstration_step(&step.episode_id, &step.step.to_string())?;
            // The commit tells which steps are missing, and they are sent again: a router never has to wait for them.
            let put = session.put(key, encode(step.clone())).congestion_control(CongestionControl::Drop);
            put.await.map_err(|e| Error::new(Code::Unavailable, "transport", "a step sent", e))?;
        }
        match commit(session, episode).await?.len() {
            0 => Ok(()),
            missing => {
                Err(Error::new(Code::Unavailable, "steps", "every step to arrive", format!("{missing} missing")))
            }
        }
    };
    round.retry(patience()).when(is_passing).await
}

async fn commit(session: &Session, episode: &Episode) -> Result<Vec<u32>, Error> {
    let key = key::demonstration_commit(&episode.info().episode_id)?;
    let request = CommitEpisodeRequest { episode: episode.info().clone() };
    let response: CommitEpisodeResponse = query::call(session, &key, request, COMMIT_TIMEOUT).await?;
    Ok(response.missing_steps)
}

/// Whether an error may be gone the next time.
pub(crate) fn is_passing(error: &Error) -> bool {
    matches!(error.code, Code::Unavailable | Code::DeadlineExceeded | Code::ResourceExhausted)
}

/// When to try again: the recorder may be starting, or busy with the episodes of others.
pub(crate) fn patience() -> ExponentialBuilder {
    ExponentialBuilder::default()
        .with_min_delay(Duration::from_millis(20))
        .with_max_delay(Duration::from_secs(1))
        .with_max_times(125)
        .with_jitter()
}

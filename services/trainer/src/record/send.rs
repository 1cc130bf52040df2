//! Sender of recordings, with the protocol of workers: only the steps that a recorder lacks are sent.

use crate::record::folder;
use anyhow::{Context, bail, ensure};
use recording::Episode;
use service_kit::network::{Retry, is_outage};
use std::path::Path;
use std::time::Duration;
use tracing::info;
use wire::demonstration::{CommitEpisodeRequest, CommitEpisodeResponse};
use wire::{Code, Error, encode, key, query};
use zenoh::Session;
use zenoh::qos::CongestionControl;

/// Timeout of the answer to a commit.
const COMMIT_TIMEOUT: Duration = Duration::from_secs(10);
/// Retries for two minutes: the recorder may be starting, or busy with other episodes.
pub(crate) const RETRY: Retry = Retry {
    delays: [Duration::from_millis(20), Duration::from_secs(1)],
    patience: Duration::from_secs(120),
    when: is_outage,
};

/// Sends all recordings of `folder`, or those of some tasks, until a recorder has stored them.
///
/// # Errors
/// If a recording is damaged, two have the same id, a task is unknown, a recorder refuses one, or none answers for two minutes.
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

/// Sends an episode until a recorder has stored it: begins with a commit, whose answer lists the missing steps.
///
/// # Errors
/// If a recorder refuses the episode, or none stores it within two minutes.
pub async fn send(session: &Session, episode: &Episode) -> Result<(), Error> {
    let round = || async {
        let missing = commit(session, episode).await?;
        if missing.is_empty() {
            return Ok(());
        }
        for step in episode.steps().iter().filter(|step| missing.contains(&step.step)) {
            let key = key::demonstration_step(&step.episode_id, &step.step.to_string())?;
            // Dropped under congestion instead of blocking a router: the next commit lists the missing steps.
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
    RETRY.run(round).await
}

async fn commit(session: &Session, episode: &Episode) -> Result<Vec<u32>, Error> {
    let key = key::demonstration_commit(&episode.info().episode_id)?;
    let request = CommitEpisodeRequest { episode: episode.info().clone() };
    let response: CommitEpisodeResponse = query::call(session, &key, request, COMMIT_TIMEOUT).await?;
    Ok(response.missing_steps)
}

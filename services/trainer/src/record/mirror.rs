//! A late joiner: fetches what other recorders keep, then follows them, for good or until there is enough to train on.

use crate::record::folder::Recordings;
use crate::record::send::{is_passing, patience};
use backon::Retryable;
use recording::Episode;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;
use tracing::{info, warn};
use wire::demonstration::{DemonstrationStep, MAX_STEPS, RecordedEpisode};
use wire::{Code, Error, key, query};
use zenoh::Session;
use zenoh::handlers::RingChannel;

/// Most episodes that a network may hold.
const MAX_EPISODES: usize = 100_000;
/// How long an answer may take: a list, or the steps of an episode.
const TIMEOUT: Duration = Duration::from_secs(30);
/// How often everything is asked for anew, should an announcement be lost.
const POLL_INTERVAL: Duration = Duration::from_secs(30);
/// Announcements that may wait; of more, the oldest are lost.
const ANNOUNCEMENTS: usize = 256;

/// Fetches every episode that others keep and `recordings` lacks.
///
/// # Errors
/// If nobody tells of any episode for two minutes, or one cannot be fetched, or differs from what is kept here.
pub async fn once(session: &Session, recordings: &Arc<Recordings>) -> Result<(), Error> {
    let attempt = || async {
        match pass(session, recordings).await?.offered {
            0 => Err(Error::new(Code::Unavailable, "episodes", "a recorder that keeps some", "none")),
            _ => Ok(()),
        }
    };
    attempt.retry(patience()).when(is_passing).await
}

/// Does the same, and then fetches each episode as it is announced, until `enough` are kept.
///
/// # Errors
/// If zenoh refuses a declaration.
pub async fn follow(session: &Session, recordings: &Arc<Recordings>, enough: usize) -> zenoh::Result<()> {
    let announcements =
        session.declare_subscriber(key::demonstration_recorded("*")?).with(RingChannel::new(ANNOUNCEMENTS)).await?;
    while recordings.count() < enough {
        match pass(session, recordings).await {
            Ok(Pass { offered, fetched }) if fetched > 0 => info!(offered, fetched, "mirrored"),
            Ok(_) => {}
            Err(error) => warn!(%error, "not mirrored; tried again"),
        }
        let next_pass = Instant::now() + POLL_INTERVAL;
        while recordings.count() < enough
            && let Ok(announcement) = tokio::time::timeout_at(next_pass, announcements.recv_async()).await
        {
            let episode = wire::decode(&announcement?.payload().to_bytes());
            let taken = async { take(session, recordings, episode?).await };
            if let Err(error) = taken.await {
                warn!(%error, "not mirrored; tried again");
            }
        }
    }
    Ok(())
}

struct Pass {
    offered: usize,
    fetched: usize,
}

/// Asks what is kept and fetches what is lacking; one episode that fails does not keep the others away.
async fn pass(session: &Session, recordings: &Arc<Recordings>) -> Result<Pass, Error> {
    let key = key::demonstration_recorded("*")?;
    let offered: Vec<RecordedEpisode> = query::collect(session, &key, MAX_EPISODES, TIMEOUT).await?;
    let mut failed = None;
    let mut pass = Pass { offered: offered.len(), fetched: 0 };
    for episode in offered {
        match take(session, recordings, episode).await {
            Ok(fetched) => pass.fetched += usize::from(fetched),
            Err(error) => failed = Some(error),
        }
    }
    failed.map_or(Ok(pass), Err)
}

/// Fetches an episode that is offered, if it is lacking; answers whether it was.
async fn take(session: &Session, recordings: &Arc<Recordings>, offered: RecordedEpisode) -> Result<bool, Error> {
    let id = offered.episode_id.clone();
    let lacking = recordings.lacks(&offered).map_err(|e| e.within(&id))?;
    if lacking {
        fetch(session, recordings, offered).await.map_err(|e| e.within(&id))?;
    }
    Ok(lacking)
}

/// Fetches one episode; it is kept only if it has the digest that was announced.
async fn fetch(session: &Session, recordings: &Arc<Recordings>, info: RecordedEpisode) -> Result<(), Error> {
    let key = key::demonstration_step(&info.episode_id, "*")?;
    let steps: Vec<DemonstrationStep> = query::collect(session, &key, 4 * MAX_STEPS as usize, TIMEOUT).await?;
    // Several recorders may have answered.
    let steps: BTreeMap<u32, DemonstrationStep> = steps.into_iter().map(|step| (step.step, step)).collect();
    let recordings = Arc::clone(recordings);
    let keeping =
        tokio::task::spawn_blocking(move || recordings.keep(&Episode::new(info, steps.into_values().collect())?));
    keeping.await.map_err(|e| Error::new(Code::Internal, "episode_id", "a kept episode", e))?
}

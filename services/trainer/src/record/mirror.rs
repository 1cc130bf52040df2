//! Mirror of other recorders: fetches their episodes, then follows their announcements, for ever or up to a number of episodes.

use crate::record::folder::Recordings;
use crate::record::send::RETRY;
use recording::Episode;
use service_kit::session::IntoAnyhow;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;
use tracing::{info, warn};
use wire::demonstration::{DemonstrationStep, MAX_STEPS, RecordedEpisode};
use wire::{Code, Error, key, query};
use zenoh::Session;
use zenoh::handlers::RingChannel;

/// Largest number of episodes in a network.
const MAX_EPISODES: usize = 100_000;
/// Timeout of an answer: a list, or the steps of an episode.
const TIMEOUT: Duration = Duration::from_secs(30);
/// Interval of full passes, which find episodes whose announcements were lost.
const POLL_INTERVAL: Duration = Duration::from_secs(30);
/// Capacity for announcements; the oldest are dropped.
const ANNOUNCEMENTS: usize = 256;

/// Fetches all episodes of other recorders that `recordings` lacks.
///
/// # Errors
/// If no recorder offers an episode within two minutes, or an episode cannot be fetched, or differs from the one stored here.
pub async fn once(session: &Session, recordings: &Arc<Recordings>) -> Result<(), Error> {
    let attempt = || async {
        match pass(session, recordings).await?.offered {
            0 => Err(Error::new(Code::Unavailable, "episodes", "a recorder that keeps some", "none")),
            _ => Ok(()),
        }
    };
    RETRY.run(attempt).await
}

/// Fetches all episodes that `recordings` lacks, and then each announced one, until `enough` are stored.
///
/// # Errors
/// If zenoh refuses a declaration.
pub async fn follow(session: &Session, recordings: &Arc<Recordings>, enough: usize) -> anyhow::Result<()> {
    let announcements =
        session.declare_subscriber(key::demonstration_recorded("*")?).with(RingChannel::new(ANNOUNCEMENTS));
    let announcements = announcements.await.into_anyhow()?;
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
            let episode = wire::decode(&announcement.into_anyhow()?.payload().to_bytes());
            let taken = async { take(session, recordings, episode?).await };
            if let Err(error) = taken.await {
                warn!(%error, "not mirrored; tried again");
            }
        }
    }
    Ok(())
}

/// Numbers of episodes offered and fetched in a full pass.
struct Pass {
    offered: usize,
    fetched: usize,
}

/// Full pass: lists the episodes of all recorders and fetches the missing ones. A failed episode does not stop the others; the
/// last error is returned.
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

/// Fetches an offered episode if it is missing; returns whether it was.
async fn take(session: &Session, recordings: &Arc<Recordings>, offered: RecordedEpisode) -> Result<bool, Error> {
    let id = offered.episode_id.clone();
    let lacking = recordings.lacks(&offered).map_err(|e| e.within(&id))?;
    if lacking {
        fetch(session, recordings, offered).await.map_err(|e| e.within(&id))?;
    }
    Ok(lacking)
}

/// Fetches one episode, which is stored only if it has the announced digest.
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

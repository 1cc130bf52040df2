//! Zenoh transport of the recorder: receives streams, lists stored episodes, and serves their steps.

use crate::record::folder::Recordings;
use crate::record::ingest::{Commit, Ingest};
use crate::service::PLACES;
use service_kit::network::{Places, Server};
use service_kit::session::IntoAnyhow;
use std::sync::Arc;
use tracing::warn;
use wire::demonstration::{CommitEpisodeRequest, CommitEpisodeResponse};
use wire::{Error, encode, key, query};
use zenoh::pubsub::Subscriber;
use zenoh::query::Query;
use zenoh::{Session, Wait};

/// Subscriber and queryables of a recorder, undeclared when dropped.
#[derive(Debug)]
pub struct Recorder {
    _steps: Subscriber<()>,
    _server: Server<Parts>,
}

/// Starts a recorder, which stores streamed episodes and offers stored ones.
///
/// # Errors
/// If zenoh refuses a declaration.
pub async fn start(session: &Session, recordings: Arc<Recordings>, ingest: Arc<Ingest>) -> anyhow::Result<Recorder> {
    let parts = Parts { session: session.clone(), recordings, ingest: Arc::clone(&ingest) };
    let mut server = Server::new(session, parts);
    server.serve_many(key::demonstration_recorded("*")?, &Places::new(PLACES), Parts::list).await?;
    server.serve_many(key::demonstration_step("*", "*")?, &Places::new(PLACES), Parts::send).await?;

    // In the callback, which only copies a frame, so that steps are ingested before the commit that follows them.
    let steps = session
        .declare_subscriber(key::demonstration_step("*", "*")?)
        .callback(move |sample| match wire::decode(&sample.payload().to_bytes()) {
            Ok(step) => ingest.step(step),
            Err(error) => warn!(key = %sample.key_expr(), %error, "step refused"),
        })
        .await
        .into_anyhow()?;

    server.serve_many(key::demonstration_commit("*")?, &Places::new(PLACES), Parts::commit).await?;
    Ok(Recorder { _steps: steps, _server: server })
}

/// State of the queryables.
#[derive(Debug)]
struct Parts {
    session: Session,
    recordings: Arc<Recordings>,
    ingest: Arc<Ingest>,
}

impl Parts {
    fn commit(&self, query: &Query) -> zenoh::Result<()> {
        let request: Result<CommitEpisodeRequest, Error> = query::request(query);
        let commit = request.and_then(|request| Ok((self.ingest.commit(&request)?, request)));
        let missing_steps = match commit {
            Ok((Commit::Missing(steps), _)) => steps,
            Ok((Commit::KeptBefore, _)) => Vec::new(),
            Ok((Commit::Kept, CommitEpisodeRequest { episode })) => {
                self.session.put(key::demonstration_recorded(&episode.episode_id)?, encode(episode)).wait()?;
                Vec::new()
            }
            Err(error) => {
                warn!(key = %query.key_expr(), %error, "commit refused");
                return query::refuse(query, error);
            }
        };
        query::reply(query, Ok(CommitEpisodeResponse { missing_steps }))
    }

    /// Answers a query with the metadata of all matching stored episodes.
    fn list(&self, query: &Query) -> zenoh::Result<()> {
        let asked = query.key_expr();
        let episodes = match key::episode_of_demonstration_recorded(asked).filter(|episode| !episode.contains('*')) {
            Some(episode_id) => self.recordings.get(&episode_id).into_iter().collect(),
            None => self.recordings.all(),
        };
        for episode in episodes {
            let key = key::demonstration_recorded(&episode.episode_id)?;
            if asked.intersects(&key) {
                query::reply_at(query, &key, episode)?;
            }
        }
        Ok(())
    }

    /// Answers a query with the matching steps of one stored episode.
    fn send(&self, query: &Query) -> zenoh::Result<()> {
        let asked = query.key_expr();
        let Some(episode_id) = key::episode_of_demonstration_step(asked).filter(|episode| !episode.contains('*'))
        else {
            return query::refuse(query, Error::invalid("key", "the steps of one episode", asked));
        };
        let episode = match self.recordings.read(&episode_id) {
            Ok(episode) => episode,
            Err(error) => return query::refuse(query, error),
        };
        // An unknown episode gets no answer, since another recorder may have it.
        for step in episode.into_iter().flat_map(recording::Episode::into_steps) {
            let key = key::demonstration_step(&episode_id, &step.step.to_string())?;
            if asked.intersects(&key) {
                query::reply_at(query, &key, step)?;
            }
        }
        Ok(())
    }
}

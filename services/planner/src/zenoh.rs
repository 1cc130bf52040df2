//! The planner over zenoh: queryables, announced checkpoints, a liveliness token.

use crate::config::Config;
use crate::core::PlannerCore;
use crate::model_thread::queue_full;
use anyhow::{anyhow, ensure};
use backon::{ConstantBuilder, Retryable};
use std::future::{Future, ready};
use std::sync::Arc;
use std::time::Duration;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio_util::task::{AbortOnDropHandle, TaskTracker};
use tracing::{info, warn};
use wire::checkpoint::{CheckpointAnnouncement, CheckpointChunkRequest, CheckpointChunkResponse, MAX_CHUNK_BYTES};
use wire::planner::{CheckpointSource, ListModelsRequest, LoadModelRequest};
use wire::{Code, Error, Message, key, query};
use zenoh::Session;
use zenoh::handlers::RingChannel;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::{Query, Queryable};

/// Announcements that wait while a checkpoint is fetched; the oldest go first.
const ANNOUNCEMENTS: usize = 64;
/// How long one piece of a checkpoint may take.
const CHUNK_TIMEOUT: Duration = Duration::from_secs(5);

/// The planner's place in the zenoh network.
#[derive(Debug)]
pub(crate) struct ZenohServer {
    session: Session,
    alive: Option<LivelinessToken>,
    queryables: Vec<Queryable<()>>,
    announcements: AbortOnDropHandle<()>,
    requests: TaskTracker,
}

impl ZenohServer {
    /// Joins the others, declares the queryables, follows announcements and, with everything in place, says it is alive.
    ///
    /// # Errors
    /// If the session cannot be opened, or the name cannot stand in a key.
    pub(crate) async fn start(core: PlannerCore, config: &Config) -> anyhow::Result<Self> {
        let plan = key::planner_plan(&config.name)?;
        ensure!(!plan.is_wild(), "name: expected that of one planner, got {:?}", config.name);
        let session = service_kit::session::open(&config.session).await?;
        let capacity = config.queue_capacity.get();
        let requests = Requests {
            session: session.clone(),
            core: core.clone(),
            // More than can wait for the model, so that what clients see is the core's own limit.
            places: Arc::new(Semaphore::new(2 * usize::from(capacity))),
            capacity,
            tasks: TaskTracker::new(),
            runtime: Handle::current(),
        };
        let queryables = vec![
            requests.serve(plan, |core, request| async move { core.plan(request).await }).await?,
            requests
                .serve(key::planner_register_goal(&config.name)?, |core, request| ready(core.register_goal(request)))
                .await?,
            requests
                .serve(
                    key::planner_load_model(&config.name)?,
                    |core, request| async move { core.load_model(request).await },
                )
                .await?,
            requests
                .serve(key::planner_list_models(&config.name)?, |core, _: ListModelsRequest| {
                    ready(Ok(core.list_models()))
                })
                .await?,
        ];
        let subscriber = session
            .declare_subscriber(key::checkpoint_announcement("*")?)
            .with(RingChannel::new(ANNOUNCEMENTS))
            .await
            .map_err(|e| anyhow!(e))?;
        let fetching = session.clone();
        let announcements = AbortOnDropHandle::new(tokio::spawn(async move {
            while let Ok(sample) = subscriber.recv_async().await {
                let key = sample.key_expr();
                match follow(&fetching, &core, &sample.payload().to_bytes()).await {
                    Ok(announcement) => info!(%key, digest = announcement.digest, "announced checkpoint is served"),
                    Err(error) => warn!(%key, %error, "announced checkpoint refused; the old one serves on"),
                }
            }
        }));
        let alive = session.liveliness().declare_token(key::planner_alive(&config.name)?);
        let alive = Some(alive.await.map_err(|e| anyhow!(e))?);
        Ok(Self { session, alive, queryables, announcements, requests: requests.tasks })
    }

    /// Takes no more requests and waits for those in flight.
    pub(crate) async fn drain(&mut self) {
        self.announcements.abort();
        if let Some(alive) = self.alive.take()
            && let Err(error) = alive.undeclare().await
        {
            warn!(%error, "liveliness token not undeclared");
        }
        for queryable in self.queryables.drain(..) {
            if let Err(error) = queryable.undeclare().await {
                warn!(%error, "queryable not undeclared");
            }
        }
        self.requests.close();
        self.requests.wait().await;
    }

    /// Leaves the network.
    ///
    /// # Errors
    /// If zenoh cannot close the session.
    pub(crate) async fn close(self) -> anyhow::Result<()> {
        self.session.close().await.map_err(|e| anyhow!(e))
    }
}

/// What every queryable needs.
struct Requests {
    session: Session,
    core: PlannerCore,
    places: Arc<Semaphore>,
    capacity: u16,
    tasks: TaskTracker,
    runtime: Handle,
}

impl Requests {
    /// Declares a queryable. Zenoh's callback only starts a task: it must not block the network thread.
    async fn serve<Q, R, F, S>(&self, key: OwnedKeyExpr, serve: S) -> anyhow::Result<Queryable<()>>
    where
        Q: Message + Send,
        R: Message + Send,
        F: Future<Output = Result<R, Error>> + Send,
        S: Fn(PlannerCore, Q) -> F + Copy + Send + Sync + 'static,
    {
        let Self { core, places, capacity, tasks, runtime, .. } = self;
        let (core, places, capacity) = (core.clone(), Arc::clone(places), *capacity);
        let (tasks, runtime) = (tasks.clone(), runtime.clone());
        let callback = move |query: Query| {
            let (core, place) = (core.clone(), Arc::clone(&places).try_acquire_owned());
            let answer = async move {
                let result = match (&place, query::request(&query)) {
                    (Err(_), _) => Err(queue_full(capacity)),
                    (Ok(_), Err(error)) => Err(error),
                    (Ok(_), Ok(request)) => serve(core, request).await,
                };
                if let Err(error) = query::reply(&query, result) {
                    warn!(%error, key = %query.key_expr(), "answer not sent");
                }
            };
            tasks.spawn_on(answer, &runtime);
        };
        self.session.declare_queryable(key).complete(true).callback(callback).await.map_err(|e| anyhow!(e))
    }
}

/// Fetches and serves what a message announces, unless it is served already.
async fn follow(session: &Session, core: &PlannerCore, message: &[u8]) -> Result<CheckpointAnnouncement, Error> {
    let announcement: CheckpointAnnouncement = wire::decode(message)?;
    let served = core.list_models().models;
    if !served.iter().any(|info| info.name == announcement.model && info.digest == announcement.digest) {
        let bytes = fetch(session, &announcement).await?;
        let source = CheckpointSource::Bytes(bytes);
        core.load_model(LoadModelRequest { model: announcement.model.clone(), source }).await?;
    }
    Ok(announcement)
}

/// An announced checkpoint's bytes, piece by piece.
async fn fetch(session: &Session, announcement: &CheckpointAnnouncement) -> Result<Vec<u8>, Error> {
    let CheckpointAnnouncement { digest, size_bytes, .. } = announcement;
    let size = usize::try_from(*size_bytes).unwrap_or(usize::MAX);
    if size > cpn::checkpoint::MAX_BYTES {
        let limit = format!("at most {}", cpn::checkpoint::MAX_BYTES);
        return Err(Error::invalid("size_bytes", limit, size_bytes));
    }
    let key = key::checkpoint_chunk(digest)?;
    let mut bytes = Vec::with_capacity(size);
    while bytes.len() < size {
        let length_bytes = u32::try_from(size - bytes.len()).unwrap_or(u32::MAX).min(MAX_CHUNK_BYTES);
        let request = CheckpointChunkRequest { offset_bytes: bytes.len() as u64, length_bytes };
        let chunk = fetch_chunk(session, &key, &request).await?;
        if chunk.len() != length_bytes as usize {
            return Err(Error::invalid("data", format!("{length_bytes} bytes"), format!("{} bytes", chunk.len())));
        }
        bytes.extend(chunk);
    }
    let hashing = tokio::task::spawn_blocking(|| (cpn::checkpoint::digest(&bytes), bytes));
    let (got, bytes) = hashing.await.map_err(|e| Error::new(Code::Internal, "digest", "a digest", e))?;
    if got != *digest {
        return Err(Error::invalid("digest", digest, got));
    }
    Ok(bytes)
}

/// When to ask for a piece again: right after a reconnect a query can end without an answer.
fn again() -> ConstantBuilder {
    ConstantBuilder::default().with_delay(Duration::from_millis(200)).with_max_times(2)
}

async fn fetch_chunk(
    session: &Session,
    key: &OwnedKeyExpr,
    request: &CheckpointChunkRequest,
) -> Result<Vec<u8>, Error> {
    let ask = || query::call(session, key, request.clone(), CHUNK_TIMEOUT);
    let answer: CheckpointChunkResponse =
        ask.retry(again()).when(|error: &Error| error.code == Code::Unavailable).await?;
    Ok(answer.data)
}

//! Zenoh transport of the planner: queryables, announced checkpoints, a liveliness token.

use crate::CHANGES;
use crate::config::Config;
use crate::core::PlannerCore;
use crate::follow::Follower;
use crate::task::{Answer, queue_full};
use anyhow::{anyhow, ensure};
use service_kit::session::{self, Connection, SessionConfig};
use std::future::{Future, ready};
use std::sync::Arc;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio_util::task::{AbortOnDropHandle, TaskTracker};
use tracing::{Instrument, Span, debug_span, warn};
use wire::planner::{ListModelsRequest, PlanRequest, PlanResponse};
use wire::{Error, Message, key, query, trace};
use zenoh::Session;
use zenoh::bytes::ZBytes;
use zenoh::handlers::RingChannel;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::{Query, Queryable};

/// Capacity for announcements that arrive while a checkpoint is fetched; the oldest are dropped.
const ANNOUNCEMENTS: usize = 64;

/// Zenoh session of the planner, with everything declared on it.
#[derive(Debug)]
pub(crate) struct ZenohServer {
    session: Session,
    alive: Option<LivelinessToken>,
    queryables: Vec<Queryable<()>>,
    announcements: AbortOnDropHandle<()>,
    requests: TaskTracker,
}

impl ZenohServer {
    /// Opens the session, declares the queryables, subscribes to announcements and, last, declares the liveliness token.
    ///
    /// # Errors
    /// If the session cannot be opened, or the name is not valid in a key or is that of a running planner.
    pub(crate) async fn start(core: PlannerCore, config: &Config) -> anyhow::Result<Self> {
        let plan = key::planner_plan(&config.name)?;
        ensure!(!plan.is_wild(), "name: expected that of one planner, got {:?}", config.name);
        let session = session::open(&config.session).await?;
        session::claim(&session, &config.session, &key::planner_alive(&config.name)?).await?;

        let capacity = config.queue_capacity.get();
        let requests = Requests {
            session: session.clone(),
            core: core.clone(),
            // More than the model thread's queue, so that clients meet the core's own limit.
            places: Arc::new(Semaphore::new(2 * usize::from(capacity))),
            plans: Arc::new(Semaphore::new(2 * usize::from(capacity))),
            capacity,
            tasks: TaskTracker::new(),
            runtime: Handle::current(),
        };
        let queryables = vec![
            requests.serve_plans(plan).await?,
            requests
                .serve(key::planner_register_goal(&config.name)?, None, |core, request| {
                    ready(core.register_goal(request))
                })
                .await?,
            requests
                .serve(key::planner_load_model(&config.name)?, Some("load_model"), |core, request| async move {
                    core.load_model(request).await
                })
                .await?,
            requests
                .serve(key::planner_unload_model(&config.name)?, Some("unload_model"), |core, request| async move {
                    core.unload_model(request).await
                })
                .await?,
            requests
                .serve(key::planner_list_models(&config.name)?, None, |core, _: ListModelsRequest| {
                    ready(Ok(core.list_models()))
                })
                .await?,
        ];

        let subscriber = session
            .declare_subscriber(key::checkpoint_announcement("*")?)
            .with(RingChannel::new(ANNOUNCEMENTS))
            .await
            .map_err(|e| anyhow!(e))?;
        let mut follower = Follower::new(session.clone(), core);
        let announcements = AbortOnDropHandle::new(tokio::spawn(async move {
            while let Ok(sample) = subscriber.recv_async().await {
                if let Err(error) = follower.follow(&sample.payload().to_bytes()).await {
                    let key = sample.key_expr();
                    // The model in service stays.
                    CHANGES.refused("announcement", key, &error);
                }
            }
        }));

        let alive = session.liveliness().declare_token(key::planner_alive(&config.name)?);
        let alive = Some(alive.await.map_err(|e| anyhow!(e))?);
        Ok(Self { session, alive, queryables, announcements, requests: requests.tasks })
    }

    /// Monitor of the session's connection.
    pub(crate) fn connection(&self, config: &SessionConfig) -> Connection {
        Connection::follow(&self.session, config)
    }

    /// Stops accepting requests and waits for those in flight.
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

    /// Closes the session.
    ///
    /// # Errors
    /// If zenoh cannot close the session.
    pub(crate) async fn close(self) -> anyhow::Result<()> {
        self.session.close().await.map_err(|e| anyhow!(e))
    }
}

/// Shared state of all queryables.
struct Requests {
    session: Session,
    core: PlannerCore,
    places: Arc<Semaphore>,
    /// Places of plan requests, held until their answers are sent.
    plans: Arc<Semaphore>,
    capacity: u16,
    tasks: TaskTracker,
    runtime: Handle,
}

impl Requests {
    /// Declares the queryable of plans. Zenoh's callback enqueues the request and, unless another reply is blocked, the model
    /// thread sends the answer itself, since waking another thread costs latency. All other answers are sent by threads that may
    /// block, as zenoh does for clients that do not read.
    async fn serve_plans(&self, key: OwnedKeyExpr) -> anyhow::Result<Queryable<()>> {
        let (core, tasks) = (self.core.clone(), self.tasks.clone());
        let (places, capacity, outbox) = (Arc::clone(&self.plans), self.capacity, core.outbox());
        let own = Arc::new(key.clone());

        let callback = move |mut query: Query| {
            let own = Arc::clone(&own);
            let Ok(place) = Arc::clone(&places).try_acquire_owned() else {
                // Sent here, which may block: backpressure on clients with too many unread answers.
                return reply::<PlanResponse>(&query, &own, Err(queue_full(capacity)));
            };

            let (span, request) = (request_span(&query), query::request::<PlanRequest>(&query));
            // Frees the payload, which an answer that waits to be sent no longer needs.
            query.payload_mut().into_iter().for_each(|payload| *payload = ZBytes::new());
            let in_flight = tasks.token();
            let answer = move |plan: Answer| {
                reply(&query, &own, plan);
                drop((in_flight, place));
            };
            match request {
                Ok(request) => span.in_scope(|| core.plan_then(request, answer)),
                Err(error) => outbox.put(move || answer(Err(error))),
            }
        };
        self.session.declare_queryable(key).complete(true).callback(callback).await.map_err(|e| anyhow!(e))
    }

    /// Declares another queryable, of a state `change` if there is one. Zenoh's callback only starts a task, since it must not
    /// block the network thread.
    async fn serve<Q, R, F, S>(
        &self,
        key: OwnedKeyExpr,
        change: Option<&'static str>,
        serve: S,
    ) -> anyhow::Result<Queryable<()>>
    where
        Q: Message + Send,
        R: Message + Send + 'static,
        F: Future<Output = Result<R, Error>> + Send,
        S: Fn(PlannerCore, Q) -> F + Copy + Send + Sync + 'static,
    {
        let Self { core, places, capacity, tasks, runtime, .. } = self;
        let (core, places, capacity) = (core.clone(), Arc::clone(places), *capacity);
        let (tasks, runtime, outbox) = (tasks.clone(), runtime.clone(), core.outbox());
        let own = Arc::new(key.clone());

        let callback = move |query: Query| {
            let (outbox, in_flight) = (outbox.clone(), tasks.token());
            let (core, place) = (core.clone(), Arc::clone(&places).try_acquire_owned());
            let (span, own) = (request_span(&query), Arc::clone(&own));
            let answer = async move {
                let result = match (&place, query::request(&query)) {
                    (Err(_), _) => Err(queue_full(capacity)),
                    (Ok(_), Err(error)) => Err(error),
                    (Ok(_), Ok(request)) => serve(core, request).await,
                };
                if let (Some(change), Err(error)) = (change, &result) {
                    CHANGES.refused(change, query.key_expr(), error);
                }
                outbox.put(move || {
                    reply(&query, &own, result);
                    drop((place, in_flight));
                });
            };
            tasks.spawn_on(answer.instrument(span), &runtime);
        };

        self.session.declare_queryable(key).complete(true).callback(callback).await.map_err(|e| anyhow!(e))
    }
}

/// Tracing span of a request, a child of its sender's.
fn request_span(query: &Query) -> Span {
    let span = debug_span!("request", otel.kind = "server", key = %query.key_expr());
    trace::follow(&span, query::traceparent(query).as_deref());
    span
}

fn reply<R: Message>(query: &Query, own: &OwnedKeyExpr, answer: Result<R, Error>) {
    if let Err(error) = query::reply_as(query, own, answer) {
        warn!(%error, key = %query.key_expr(), "answer not sent");
    }
}

//! Zenoh transport of the planner: queryables, announced checkpoints, a liveliness token.

use crate::CHANGES;
use crate::config::Config;
use crate::core::PlannerCore;
use crate::follow::Follower;
use anyhow::ensure;
use service_kit::network::{self, Places, Server};
use service_kit::session::{self, Connection, IntoAnyhow, SessionConfig};
use tokio::runtime::Handle;
use tokio_util::task::AbortOnDropHandle;
use wire::key;
use wire::planner::ListModelsRequest;
use zenoh::Session;
use zenoh::handlers::RingChannel;
use zenoh::liveliness::LivelinessToken;

/// Capacity for announcements that arrive while a checkpoint is fetched; the oldest are dropped.
const ANNOUNCEMENTS: usize = 64;

/// Zenoh session of the planner, with everything declared on it.
#[derive(Debug)]
pub(crate) struct ZenohServer {
    session: Session,
    alive: Option<LivelinessToken>,
    server: Server<PlannerCore>,
    announcements: AbortOnDropHandle<()>,
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
        let name = network::claim(&session, &config.session, key::planner_alive(&config.name)?).await?;

        let server = serve(&session, core.clone(), config).await?;
        let announcements = follow(&session, core).await?;
        let alive = Some(name.alive().await?);
        Ok(Self { session, alive, server, announcements })
    }

    /// Monitor of the session's connection.
    pub(crate) fn connection(&self, config: &SessionConfig) -> Connection {
        Connection::follow(&self.session, config)
    }

    /// Stops accepting requests and waits for those in flight.
    pub(crate) async fn drain(&mut self) {
        self.announcements.abort();
        self.alive = None;
        self.server.drain().await;
    }

    /// Closes the session.
    ///
    /// # Errors
    /// If zenoh cannot close the session.
    pub(crate) async fn close(self) -> anyhow::Result<()> {
        self.session.close().await.into_anyhow()
    }
}

/// Declares the queryables. Unless another reply is blocked, the model thread sends the answer to a plan itself, since waking
/// another thread costs latency.
async fn serve(session: &Session, core: PlannerCore, config: &Config) -> anyhow::Result<Server<PlannerCore>> {
    let Config { name, queue_capacity, .. } = config;
    // More than the model thread's queue, so that clients meet the core's own limit.
    let [plans, others] = [(); 2].map(|()| Places::new(2 * usize::from(queue_capacity.get())));
    let mut server = Server::new(session, core);

    let plan = |core: &PlannerCore, request, reply: network::Reply| core.plan_then(request, |plan| reply.send(plan));
    server.serve_then(key::planner_plan(name)?, &plans, plan).await?;

    let register_goal = key::planner_register_goal(name)?;
    server.serve(register_goal, &others, PlannerCore::register_goal).await?;

    let load = |core: &PlannerCore, request| Handle::current().block_on(core.load_model(request));
    server.serve_change(key::planner_load_model(name)?, &others, (CHANGES, "load_model"), load).await?;

    let unload = |core: &PlannerCore, request| Handle::current().block_on(core.unload_model(request));
    server.serve_change(key::planner_unload_model(name)?, &others, (CHANGES, "unload_model"), unload).await?;

    let list = |core: &PlannerCore, _: ListModelsRequest| Ok(core.list_models());
    server.serve(key::planner_list_models(name)?, &others, list).await?;
    Ok(server)
}

/// Follows announcements of checkpoints.
async fn follow(session: &Session, core: PlannerCore) -> anyhow::Result<AbortOnDropHandle<()>> {
    let subscriber = session
        .declare_subscriber(key::checkpoint_announcement("*")?)
        .with(RingChannel::new(ANNOUNCEMENTS))
        .await
        .into_anyhow()?;
    let mut follower = Follower::new(session.clone(), core);
    Ok(AbortOnDropHandle::new(tokio::spawn(async move {
        while let Ok(sample) = subscriber.recv_async().await {
            if let Err(error) = follower.follow(&sample.payload().to_bytes()).await {
                let key = sample.key_expr();
                // The model in service stays.
                CHANGES.refused("announcement", key, &error);
            }
        }
    })))
}

//! Typed queryables, of bounded concurrency. Nothing blocks in zenoh's callbacks: they check and enqueue.

use crate::changes::Changes;
use crate::session::IntoAnyhow;
use std::sync::Arc;
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::task::TaskTracker;
use tokio_util::task::task_tracker::TaskTrackerToken;
use tracing::{Span, debug_span, warn};
use wire::{Code, Error, Message, query, trace};
use zenoh::Session;
use zenoh::bytes::ZBytes;
use zenoh::key_expr::{OwnedKeyExpr, keyexpr};
use zenoh::query::{Query, Queryable};

/// Bounded number of queries in progress, until they are answered; one more is refused. Clones share the places.
#[derive(Debug, Clone)]
pub struct Places {
    free: Arc<Semaphore>,
    count: usize,
}

impl Places {
    /// So many free places.
    pub fn new(count: usize) -> Self {
        Self { free: Arc::new(Semaphore::new(count)), count }
    }

    fn take(&self) -> Result<OwnedSemaphorePermit, Error> {
        Arc::clone(&self.free).try_acquire_owned().map_err(|_| {
            Error::new(Code::ResourceExhausted, "queue", "a free place", format!("{} waiting", self.count))
        })
    }
}

/// Queryables over a shared state, undeclared when dropped.
///
/// A query to a wild key is answered at the queryable's own key, unless that is wild too: zenoh takes answers under one key for
/// versions of one value, and delivers only the last.
#[derive(Debug)]
pub struct Server<S> {
    session: Session,
    state: Arc<S>,
    runtime: Handle,
    queryables: Vec<Queryable<()>>,
    in_flight: TaskTracker,
}

impl<S: Send + Sync + 'static> Server<S> {
    /// Server without queryables, whose handlers run on the current runtime.
    pub fn new(session: &Session, state: impl Into<Arc<S>>) -> Self {
        Self {
            session: session.clone(),
            state: state.into(),
            runtime: Handle::current(),
            queryables: Vec::new(),
            in_flight: TaskTracker::new(),
        }
    }

    /// Declares a queryable of requests `Q` with one answer `R`, computed and sent on a thread that may block.
    ///
    /// # Errors
    /// If zenoh refuses the declaration.
    pub async fn serve<Q: Message, R: Message>(
        &mut self,
        key: OwnedKeyExpr,
        places: &Places,
        handle: impl Fn(&S, Q) -> Result<R, Error> + Send + Sync + 'static,
    ) -> anyhow::Result<()> {
        self.serve_and_report(key, places, handle, |_, _| ()).await
    }

    /// Form of [`Self::serve`] for changes of the service's state: refusals are logged and counted under the change's name.
    ///
    /// # Errors
    /// If zenoh refuses the declaration.
    pub async fn serve_change<Q: Message, R: Message>(
        &mut self,
        key: OwnedKeyExpr,
        places: &Places,
        (changes, name): (Changes, &'static str),
        handle: impl Fn(&S, Q) -> Result<R, Error> + Send + Sync + 'static,
    ) -> anyhow::Result<()> {
        self.serve_and_report(key, places, handle, move |key, error| changes.refused(name, key, error)).await
    }

    async fn serve_and_report<Q: Message, R: Message>(
        &mut self,
        key: OwnedKeyExpr,
        places: &Places,
        handle: impl Fn(&S, Q) -> Result<R, Error> + Send + Sync + 'static,
        refused: impl Fn(&keyexpr, &Error) + Send + Sync + 'static,
    ) -> anyhow::Result<()> {
        let own = key.clone();
        let answer = move |state: &S, query: &Query, place: Result<(), Error>| {
            let result = place.and_then(|()| query::request(query)).and_then(|request| handle(state, request));
            if let Err(error) = &result {
                refused(query.key_expr(), error);
            }
            reply(query, &own, result)
        };
        self.declare_blocking(key, true, places, answer).await
    }

    /// Declares a queryable with any number of answers, sent on a thread that may block. Its queries go to all services with a
    /// matching key, for which no answer is an answer too.
    ///
    /// # Errors
    /// If zenoh refuses the declaration.
    pub async fn serve_many(
        &mut self,
        key: OwnedKeyExpr,
        places: &Places,
        answer: impl Fn(&S, &Query) -> zenoh::Result<()> + Send + Sync + 'static,
    ) -> anyhow::Result<()> {
        let answer = move |state: &S, query: &Query, place| match place {
            Ok(()) => answer(state, query),
            Err(full) => query::refuse(query, full),
        };
        self.declare_blocking(key, false, places, answer).await
    }

    /// Callback form of [`Self::serve`], without a change of threads: the handler runs in zenoh's callback and must not block; it
    /// sends the reply later, from a thread that may.
    ///
    /// # Errors
    /// If zenoh refuses the declaration.
    pub async fn serve_then<Q: Message>(
        &mut self,
        key: OwnedKeyExpr,
        places: &Places,
        handle: impl Fn(&S, Q, Reply) + Send + Sync + 'static,
    ) -> anyhow::Result<()> {
        let (state, runtime, in_flight) = (Arc::clone(&self.state), self.runtime.clone(), self.in_flight.clone());
        let (places, own) = (places.clone(), Arc::new(key.clone()));

        let callback = move |mut query: Query| {
            let place = match places.take() {
                Ok(place) => place,
                // Sent here, which may block: backpressure on clients with too many unread answers.
                Err(full) => return log_unsent(&query, query::refuse(&query, full)),
            };
            let (span, request) = (request_span(&query), query::request(&query));
            // Frees the payload, which an answer that waits to be sent no longer needs.
            query.payload_mut().into_iter().for_each(|payload| *payload = ZBytes::new());
            let reply = Reply { query, own: Arc::clone(&own), _place: place, _in_flight: in_flight.token() };
            match request {
                Ok(request) => span.in_scope(|| handle(&state, request, reply)),
                Err(error) => drop(runtime.spawn_blocking(move || reply.refuse(error))),
            }
        };
        self.declare(key, true, callback).await
    }

    /// Declares a queryable whose callback only starts a blocking thread. The answer gets an error in place of a free place.
    async fn declare_blocking(
        &mut self,
        key: OwnedKeyExpr,
        complete: bool,
        places: &Places,
        answer: impl Fn(&S, &Query, Result<(), Error>) -> zenoh::Result<()> + Send + Sync + 'static,
    ) -> anyhow::Result<()> {
        let (state, runtime, in_flight) = (Arc::clone(&self.state), self.runtime.clone(), self.in_flight.clone());
        let (places, answer) = (places.clone(), Arc::new(answer));

        let callback = move |query: Query| {
            let (state, answer, place) = (Arc::clone(&state), Arc::clone(&answer), places.take());
            let work = move || {
                let is_free = place.as_ref().map(drop).map_err(Error::clone);
                let answered = request_span(&query).in_scope(|| answer(&state, &query, is_free));
                log_unsent(&query, answered);
                drop((query, place));
            };
            in_flight.spawn_blocking_on(work, &runtime);
        };
        self.declare(key, complete, callback).await
    }

    /// Declares a queryable. A query to a `complete` one goes to no other of its keys.
    async fn declare(
        &mut self,
        key: OwnedKeyExpr,
        complete: bool,
        callback: impl Fn(Query) + Send + Sync + 'static,
    ) -> anyhow::Result<()> {
        let queryable = self.session.declare_queryable(key).complete(complete).callback(callback);
        self.queryables.push(queryable.await.into_anyhow()?);
        Ok(())
    }

    /// Stops accepting queries and waits until those in flight are answered.
    pub async fn drain(&mut self) {
        self.queryables.clear();
        self.in_flight.close();
        self.in_flight.wait().await;
    }
}

/// Query that awaits its answer, and keeps its place until then.
#[derive(Debug)]
pub struct Reply {
    query: Query,
    own: Arc<OwnedKeyExpr>,
    _place: OwnedSemaphorePermit,
    _in_flight: TaskTrackerToken,
}

impl Reply {
    /// Sends the answer, which may block.
    pub fn send<R: Message>(self, result: Result<R, Error>) {
        log_unsent(&self.query, reply(&self.query, &self.own, result));
    }

    fn refuse(self, error: Error) {
        log_unsent(&self.query, query::refuse(&self.query, error));
    }
}

/// Tracing span of a request, a child of its sender's.
fn request_span(query: &Query) -> Span {
    let span = debug_span!("request", otel.kind = "server", key = %query.key_expr());
    trace::follow(&span, query::traceparent(query).as_deref());
    span
}

fn reply<R: Message>(query: &Query, own: &keyexpr, result: Result<R, Error>) -> zenoh::Result<()> {
    if own.is_wild() { query::reply(query, result) } else { query::reply_as(query, own, result) }
}

fn log_unsent(query: &Query, answered: zenoh::Result<()>) {
    if let Err(error) = answered {
        warn!(%error, key = %query.key_expr(), "answer not sent");
    }
}

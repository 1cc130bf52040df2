//! Queryables with blocking handlers.

use std::sync::Arc;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tracing::warn;
use wire::{Code, Error, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::query::{Query, Queryable};

/// Maximum number of concurrent queries per queryable; each holds at most one episode in memory.
const PLACES: usize = 16;

/// Declares a queryable whose handler runs on blocking threads; zenoh's callback only starts them. A query to a `complete`
/// queryable goes to no other of its keys.
pub(crate) async fn serve(
    session: &Session,
    key: OwnedKeyExpr,
    complete: bool,
    answer: impl Fn(&Query) -> zenoh::Result<()> + Send + Sync + 'static,
) -> zenoh::Result<Queryable<()>> {
    let (places, runtime, answer) = (Arc::new(Semaphore::new(PLACES)), Handle::current(), Arc::new(answer));
    let callback = move |query: Query| {
        let (place, answer) = (Arc::clone(&places).try_acquire_owned(), Arc::clone(&answer));
        runtime.spawn_blocking(move || {
            let answered = match place {
                Ok(_place) => answer(&query),
                Err(_) => {
                    let got = format!("{PLACES} waiting");
                    query::refuse(&query, Error::new(Code::ResourceExhausted, "queue", "a free place", got))
                }
            };
            if let Err(error) = answered {
                warn!(key = %query.key_expr(), %error, "answer not sent");
            }
        });
    };
    session.declare_queryable(key).complete(complete).callback(callback).await
}
